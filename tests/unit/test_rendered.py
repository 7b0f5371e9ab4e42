"""A flight on rendered pictures: what the pipeline finds in them is what the estimator and the log get."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from deckfix.pipeline import decode
from deckfix.rendered import Companion, fly_rendered, write_rendered
from estimation.config import ConfigError
from estimation.events import Kind
from estimation.frames import Array, quat_to_matrix
from estimation.modes import Mode
from logs import open_flight
from logs.images import images
from simulation.fixes import seen_from
from simulation.mission import parse_mission
from simulation.world import Flown

MISSION = """
description = "from the quay to the tracking altitude"
closed_loop = true
start_m = [-1.0, -0.6, -2.0]
rest_s = 1.0
take_off_s = 1.0
longest_s = 5.5
[sea]
beaufort = 2
[streams]
imu = { rate_hz = 100.0 }
vision = { rate_hz = 10.0, first_s = 0.005, delay_s = 0.04, delay_spread_s = 0.005, clock = "companion" }
[clocks.autopilot]
offset_s = 21.0
[filter.origin]
latitude_deg = 63.4394
longitude_deg = 10.3986
altitude_m = 0.0
[filter.initialisation]
rest_s = 0.5
[filter.platform]
use = true
anchor_radius_m = 2.0
[filter.vision]
latency_s = 0.02
latency_sigma_s = 0.005
[filter.landing]
search_altitude_m = 4.0
"""


@pytest.fixture(scope="module")
def done() -> tuple[Flown, Companion]:
    return fly_rendered(parse_mission(MISSION), 1, engine="filterpy")


def test_the_target_is_found_in_the_pictures_where_it_is(done: tuple[Flown, Companion]) -> None:
    flown, companion = done
    rows, config = flown.batch.rows, flown.mission.drawn
    fixes = rows[rows["kind"] == Kind.VISION]
    assert len(fixes) == companion.pipeline.counts["fixes"] > 20
    assert companion.pipeline.counts["images"] > len(fixes)
    content = np.interp(
        fixes["arrival_ns"],
        flown.place.utc_ns + flown.instruments.arrival_s * 1e9,
        flown.instruments.content_s,
    )
    k = np.clip(np.searchsorted(flown.t_s, content), 1, len(flown.t_s) - 1)
    share = ((content - flown.t_s[k - 1]) / (flown.t_s[k] - flown.t_s[k - 1]))[:, None]

    def then(rows: Array) -> Array:
        """Return the rows of the truth at the moment of each picture, in between two ticks."""
        between: Array = rows[k - 1] + share * (rows[k] - rows[k - 1])
        return between

    R_nb = np.array([quat_to_matrix(q / np.linalg.norm(q)) for q in then(flown.truth[:, 6:10])])
    true = seen_from(
        config.vision, then(flown.truth[:, :3]), R_nb, then(flown.deck[:, :3]), companion.mount_rad
    )
    # What is left is the deck's own tilt, which the drawn fixes do not know of.
    error = np.linalg.norm(fixes["value"][:, :3] - true, axis=1) / np.linalg.norm(true, axis=1)
    assert np.median(error) < 0.002
    assert error.max() < 0.02


def test_a_flight_is_the_same_again(done: tuple[Flown, Companion]) -> None:
    """The pictures are exposed beside the flight: what they show must not depend on which of both is faster."""
    flown, companion = done
    again, other = fly_rendered(parse_mission(MISSION), 1, engine="filterpy")
    assert again.batch.rows.tobytes() == flown.batch.rows.tobytes()
    assert [one.image for one in other.kept] == [one.image for one in companion.kept]


def test_the_vehicle_is_led_by_them(done: tuple[Flown, Companion]) -> None:
    flown, _ = done
    assert flown.end == "time is up"
    assert Mode.TRACKING in [mode for _, mode, _ in flown.transitions]


def test_the_log_holds_some_of_the_pictures_and_what_looks_at_them(
    done: tuple[Flown, Companion], tmp_path: Path
) -> None:
    path = tmp_path / "rendered.mcap"
    write_rendered(path, *done)
    flight = open_flight(path)
    kept = list(images(flight))
    assert len(kept) == pytest.approx(2.0 * 5.5, abs=1)
    assert all(one.clock == "companion" and decode(one.data) is not None for one in kept)
    stamps = {one.stamp_ns for one in kept}
    assert stamps & set(flight.events().rows["stamp_ns"].tolist())
    assert {"camera.toml", "target.toml", "config.toml"} <= set(flight.attachments)


def test_mishaps_that_falsify_fixes_are_refused() -> None:
    mission = parse_mission(MISSION + '[[mishaps]]\nkind = "false_target"\nstart_s = 1.0\n')
    with pytest.raises(ConfigError, match="false_target"):
        fly_rendered(mission, 1, engine="filterpy")

"""Simulated vision fixes: what they say is the geometry, the noise and the age that their description states."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.config import ConfigError
from estimation.deck import vision
from estimation.events import Kind
from estimation.parameters import Site, pack_parameters
from estimation.state import CM0, P0, PL0, PO0, Q0, RS0, Layout, nominal_zero
from logs.reader import open_flight
from logs.writer import FlightWriter
from simulation.fixes import CameraErrors, View
from simulation.flight import SimulatedFlight, parse_scenario, simulate

TEXT = """
description = "fixes"
[sea]
beaufort = 3
[streams]
timesync = { rate_hz = 10.0 }
vision = { rate_hz = 20.0, drop = 0.1, jitter_s = 0.0005, delay_spread_s = 0.01, view = { hidden_s = [[46.0, 50.0]] } }
[clocks]
autopilot = { offset_s = 50.0 }
companion = { offset_s = 7.0, skew_ppm = 30.0 }
[filter.platform]
use = true
[filter.vision]
latency_s = 0.04
latency_sigma_s = 0.005
lever_arm_m = [0.1, -0.05, 0.2]
mount_rpy_rad = [0.02, -0.03, 0.1]
scale_sigma = 0.02
mount_sigma_rad = 0.02
"""


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(parse_scenario(TEXT), 3)


def fixes(flight: SimulatedFlight) -> NDArray[np.void]:
    chosen: NDArray[np.void] = flight.batch.rows[flight.batch.rows["kind"] == Kind.VISION]
    return chosen


def content_s(flight: SimulatedFlight, rows: NDArray[np.void]) -> NDArray[np.float64]:
    stamped = flight.scenario.clocks["companion"].true_s(rows["stamp_ns"])
    age = 0.04 + flight.slow["camera_latency"].at(stamped)[:, 0]
    return np.asarray(stamped - age)


def test_the_filter_that_knows_the_truth_finds_nothing_but_the_noise(flight: SimulatedFlight) -> None:
    """Innovations of the filter's own model at the true state, squared over its covariance: three on average."""
    rows = fixes(flight)
    t = content_s(flight, rows)
    m, deck = flight.trajectory.motion(t), flight.trajectory.platform.motion(t).position[0]
    layout = Layout.of(flight.scenario.config)
    p = pack_parameters(flight.scenario.config, Site((0.9, 0.1, 50.0), 0.0))
    squares, x = [], nominal_zero()
    x[RS0] = flight.slow["range_scale"].values[0, 0]
    x[CM0 : CM0 + 3] = flight.slow["camera_mount"].values[0]
    for k, row in enumerate(rows):
        x[P0 : P0 + 3], x[Q0 : Q0 + 4] = m.position_m[k], m.quaternion[k]
        x[PO0 : PO0 + 2], x[PL0] = deck[k, :2], -deck[k, 2]
        r, H, R = np.zeros(3), np.zeros((3, layout.size)), np.zeros((3, 3))
        assert vision(row["value"], row["covariance"], x, np.zeros(3), p, layout.offsets, r, H, R) == 3
        squares.append(float(r @ np.linalg.solve(R, r)))
    # The stamps' jitter adds a little where the vehicle turns fast.
    assert np.mean(squares) == pytest.approx(3.0, abs=4.0 * math.sqrt(6.0 / len(rows)) + 0.1)


def test_there_are_fixes_only_where_the_target_is_seen(flight: SimulatedFlight) -> None:
    rows = fixes(flight)
    t = content_s(flight, rows)
    bounds = flight.trajectory.plan.bounds_s
    assert t.min() > bounds["cruise"][0]
    assert not np.any((t > 46.001) & (t < 49.999))
    tangent = np.abs(rows["value"][:, :2] / rows["value"][:, 2:3])
    assert tangent[:, 0].max() < math.tan(math.radians(32.0))
    assert tangent[:, 1].max() < math.tan(math.radians(25.0))
    assert np.linalg.norm(rows["value"][:, :3], axis=1).min() > 0.2
    during = (t > bounds["hover"][0]) & (t < 46.0)
    expected = 0.9 * 20.0 * (46.0 - bounds["hover"][0])
    assert np.count_nonzero(during) == pytest.approx(expected, rel=0.1)


def test_a_view_has_edges() -> None:
    view = View(
        horizontal_deg=60.0, vertical_deg=40.0, nearest_m=1.0, farthest_m=20.0, hidden_s=((5.0, 6.0),)
    )
    places = np.array(
        [
            [0, 0, 10],
            [5.7, 0, 10],
            [5.8, 0, 10],
            [0, 3.6, 10],
            [0, -3.7, 10],
            [0, 0, -10],
            [0, 0, 0.9],
            [0, 0, 21],
        ]
    )
    seen = view.sees(np.zeros(8), places.astype(np.float64))
    assert seen.tolist() == [True, True, False, True, False, False, False, False]
    assert view.sees(np.array([4.9, 5.0, 5.9, 6.0]), np.tile([0.0, 0.0, 10.0], (4, 1))).tolist() == [
        True,
        False,
        False,
        True,
    ]


def test_a_part_of_a_near_target_is_enough_until_its_rings_leave_the_picture() -> None:
    """The target's centre may lie outside of the picture by a quarter of the distance, at most 0.15 diameters."""
    view = View.of_target(1.0)
    border = math.tan(math.radians(0.5 * view.horizontal_deg))
    for distance, reach in ((0.2, 0.05), (0.5, 0.125), (2.0, 0.15)):
        places = np.array([[border * distance + reach + off, 0.0, distance] for off in (-0.001, 0.001)])
        assert view.sees(np.zeros(2), places).tolist() == [True, False]
    assert view.sees(np.zeros(2), np.array([[0.0, 0.0, 0.101], [0.0, 0.0, 0.099]])).tolist() == [True, False]


def test_fixes_arrive_late_and_on_the_companions_clock(flight: SimulatedFlight) -> None:
    rows = fixes(flight)
    assert set(rows["clock"]) == {flight.batch.clocks.index("companion")}
    arrival_s = (rows["arrival_ns"] - flight.place.utc_ns) * 1e-9
    late = arrival_s - content_s(flight, rows)
    assert late.min() > 0.08
    assert late.mean() == pytest.approx(0.04 + 0.06 + 0.01, abs=0.02)


def test_errors_of_the_camera_have_their_priors_and_their_box(flight: SimulatedFlight) -> None:
    config = flight.scenario.drawn.vision
    drawn = [CameraErrors.draw(config, np.zeros(1), np.random.default_rng(k)) for k in range(2000)]
    assert np.std([d.scale for d in drawn]) == pytest.approx(0.02, rel=0.08)
    assert np.std([d.mount_rad for d in drawn]) == pytest.approx(0.02, rel=0.08)
    assert np.std([d.latency_s for d in drawn]) == pytest.approx(0.005, rel=0.08)
    default = parse_scenario("description = 'x'").drawn.vision
    ages = [
        CameraErrors.draw(default, np.zeros(1), np.random.default_rng(k)).latency_s[0] for k in range(200)
    ]
    assert min(ages) == 0.0
    assert 0.02 < max(ages) <= 0.15


def test_a_camera_changes_no_other_sensor_and_may_state_no_covariance(flight: SimulatedFlight) -> None:
    vision_line = next(line for line in TEXT.splitlines() if line.startswith("vision"))
    blind = simulate(parse_scenario(TEXT.replace(vision_line, "")), 3)
    others = flight.batch.rows[flight.batch.rows["kind"] != Kind.VISION]
    for name in ("stamp_ns", "arrival_ns", "value", "covariance"):
        np.testing.assert_array_equal(others[name], blind.batch.rows[name])
    silent = simulate(parse_scenario(TEXT.replace("drop = 0.1", "drop = 0.1, covariance = false")), 3)
    assert np.isnan(fixes(silent)["covariance"]).all()
    np.testing.assert_array_equal(fixes(silent)["value"], fixes(flight)["value"])
    with pytest.raises(ConfigError, match="horizontal_deg"):
        parse_scenario(TEXT.replace("view = {", "view = { horizontal_deg = 200.0,"))


def test_a_log_keeps_fixes_and_their_clock(flight: SimulatedFlight, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(flight.recording())
    read = open_flight(path).events()
    again = read.rows[read.rows["kind"] == Kind.VISION]
    for name in ("stamp_ns", "arrival_ns", "value", "covariance"):
        np.testing.assert_array_equal(again[name], fixes(flight)[name])

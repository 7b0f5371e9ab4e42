"""Missions in a closed loop: one landing from take-off to the deck, its log, and files that are none."""

from __future__ import annotations

from importlib import resources
from pathlib import Path

import msgspec
import numpy as np
import pytest

from deckfix.demo import simulate_flight
from estimation.config import ConfigError
from estimation.events import Kind
from estimation.landing import step
from estimation.modes import Mode
from logs import open_flight
from simulation.mission import load_mission, mission_names, parse_mission
from simulation.sensors import Clock
from simulation.world import Flown, World, fly

MISSION = "landing_beaufort2_2026_11"


@pytest.fixture(scope="module")
def flown() -> Flown:
    return fly(load_mission(MISSION), 1)


def test_a_mission_ends_on_the_deck(flown: Flown) -> None:
    modes = [mode for _, mode, _ in flown.transitions]
    for earlier, later in zip(
        (Mode.SEARCH, Mode.TRACKING, Mode.OBSERVATION, Mode.LANDING),
        (Mode.TRACKING, Mode.OBSERVATION, Mode.LANDING, Mode.LANDED),
        strict=True,
    ):
        assert modes.index(earlier) < modes.index(later)
    assert flown.end == "landed"
    assert flown.contact is not None
    assert flown.contact.miss_m < flown.mission.config.landing.r_land_m
    assert 0.0 < flown.contact.speed_mps < 0.6


def test_sensors_are_drawn_with_the_noise_that_the_estimator_is_told(flown: Flown) -> None:
    rows, config = flown.batch.rows, flown.mission.config
    imu = rows[rows["kind"] == Kind.IMU]
    t = Clock(offset_s=21.0, skew_ppm=12.0).true_s(imu["stamp_ns"])
    rest = t < flown.mission.rest_s - 0.1
    scatter = np.diff(imu["value"][rest], axis=0).std(axis=0) / np.sqrt(2.0)
    wanted = np.sqrt(200.0) * np.array([config.imu.gyro_noise] * 3 + [config.imu.accel_noise] * 3)
    assert scatter == pytest.approx(wanted, rel=0.1)
    vision = rows[rows["kind"] == Kind.VISION]
    assert len(vision) > 300
    assert np.all(np.isfinite(vision["value"][:, :3]))
    assert np.all(np.diff(flown.instruments.arrival_s) >= 0.0)


def test_the_same_seed_flies_the_same_flight_and_another_one_not() -> None:
    short = msgspec.structs.replace(load_mission(MISSION), longest_s=9.0)
    one, again, other = (fly(short, seed) for seed in (1, 1, 2))
    assert one.end == "time is up"
    assert again.batch.rows.tobytes() == one.batch.rows.tobytes()
    assert again.truth.tobytes() == one.truth.tobytes()
    assert other.truth.tobytes() != one.truth.tobytes()


def test_the_log_of_a_mission_is_an_ordinary_flight(tmp_path: Path) -> None:
    path, given = tmp_path / "mission.mcap", tmp_path / "short.toml"
    text = (resources.files("simulation") / "missions" / f"{MISSION}.toml").read_text(encoding="utf-8")
    given.write_text(text.replace("seed = 1", "seed = 1\nlongest_s = 15.0"), encoding="utf-8")
    assert "time is up" in simulate_flight(str(given), path, seed=2)
    flight = open_flight(path)
    topics = {info.topic for info in flight.channels if info.count}
    assert {"/imu", "/gps/fix", "/vision/fix", "/timesync", "/landing/mode"} <= topics
    assert {"/truth/odometry", "/truth/platform"} <= topics
    assert flight.metadata["deckfix.simulation"]["end"] == "time is up"


@pytest.mark.parametrize(
    ("text", "word"),
    [
        ('description = "x"\n', "closed_loop"),
        ('description = "x"\nclosed_loop = true\n[filter.platform]\nuse = false\n', "platform.use"),
        ('description = "x"\nclosed_loop = true\nwinds = 3\n', "winds"),
        ('description = "x"\nclosed_loop = true\nmishaps = [{kind = "meteor", start_s = 1.0}]\n', "meteor"),
        ("description = \n", "TOML"),
    ],
)
def test_a_file_that_is_no_mission_is_refused(text: str, word: str) -> None:
    with pytest.raises(ConfigError, match=word):
        parse_mission(text, "m.toml")


def test_an_unknown_mission_is_refused_with_the_known_ones() -> None:
    assert MISSION in mission_names()
    with pytest.raises(ConfigError, match=MISSION):
        load_mission("nowhere")


def test_a_flight_that_is_branched_goes_on_as_it_would_have() -> None:
    world = World(load_mission(MISSION), 1, "auto", step, None)
    while world.t_s < 12.0:
        world.tick()
    branch = world.branch(step)
    for one in (world, branch):
        for _ in range(100):
            one.tick()
    assert world.flown().truth.tobytes() == branch.flown().truth.tobytes()
    assert world.flown().batch.rows.tobytes() == branch.flown().batch.rows.tobytes()

"""Simulated flights: sensors are what their description says, and a recording gives the same events back."""

from __future__ import annotations

from pathlib import Path

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.config import ConfigError
from estimation.events import EVENT_DTYPE, Kind
from estimation.frames import geodetic_to_ned, quat_conjugate, quat_log, quat_multiply
from estimation.models import pressure_altitude
from logs.reader import open_flight
from logs.writer import FlightWriter
from simulation.flight import (
    Scenario,
    SimulatedFlight,
    load_scenario,
    parse_scenario,
    scenario_names,
    simulate,
)
from simulation.sensors import Clock, gauss_markov, standard_pressure

SURVEY = "consistency_survey_2026_06"


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(load_scenario(SURVEY), 5)


def rows(flight: SimulatedFlight, kind: Kind) -> NDArray[np.void]:
    chosen: NDArray[np.void] = flight.batch.rows[flight.batch.rows["kind"] == kind]
    return chosen


def test_same_seed_same_flight(flight: SimulatedFlight) -> None:
    again = simulate(load_scenario(SURVEY), 5)
    assert flight.batch.rows.tobytes() == again.batch.rows.tobytes()
    assert flight.batch.rows.tobytes() != simulate(load_scenario(SURVEY), 6).batch.rows.tobytes()


def test_contents_are_late_by_the_latency(flight: SimulatedFlight) -> None:
    """Content time = stamp - latency, on the autopilot's clock: there the errors are the noise and nothing
    else.
    """
    c = flight.scenario.drawn.gps
    r = rows(flight, Kind.GPS_POSITION)
    t = flight.clock.true_s(r["stamp_ns"]) - c.latency_s
    m = flight.trajectory.motion(t)
    antenna = m.position_m + m.R_nb @ np.array(c.lever_arm_m) + flight.slow["gps_bias"].at(t)
    there = np.array([geodetic_to_ned(v[0], v[1], v[2], flight.place.origin) for v in r["value"]])
    error = there - antenna
    np.testing.assert_allclose(error.std(axis=0), [0.02, 0.02, 0.04], rtol=0.15)
    assert np.abs(error.mean(axis=0)).max() < 0.01
    v = rows(flight, Kind.GPS_VELOCITY)["value"][:, :3]
    moving = m.velocity_mps + np.einsum(
        "nij,nj->ni", m.R_nb, np.cross(m.angular_velocity_radps, c.lever_arm_m)
    )
    np.testing.assert_allclose((v - moving).std(axis=0), [0.05, 0.05, 0.08], rtol=0.15)


def test_inertial_noise_has_its_density(flight: SimulatedFlight) -> None:
    c = flight.scenario.drawn.imu
    r = rows(flight, Kind.IMU)
    t = flight.clock.true_s(r["stamp_ns"]) - 0.008
    m = flight.trajectory.motion(t)
    for values, truth, density, bias in (
        (r["value"][:, :3], m.angular_velocity_radps, c.gyro_noise, "gyro_bias"),
        (r["value"][:, 3:], m.specific_force_mps2, c.accel_noise, "accel_bias"),
    ):
        white = values - truth - flight.slow[bias].at(t)
        np.testing.assert_allclose(white.std(axis=0), density * np.sqrt(100.0), rtol=0.05)
        # The integral over T wanders by density times the root of T.
        sums = white[: 57 * 100].reshape(57, 100, 3).sum(axis=1) / 100.0
        assert sums.std() == pytest.approx(density, rel=0.2)


def test_other_sensors(flight: SimulatedFlight) -> None:
    c = flight.scenario.drawn
    r = rows(flight, Kind.BAROMETER)
    t = flight.clock.true_s(r["stamp_ns"])
    heights = np.array([pressure_altitude(p) for p in r["value"][:, 0]])
    m = flight.trajectory.motion(t)
    white = heights + m.position_m[:, 2] - flight.slow["baro_bias"].at(t)[:, 0]
    assert white.std() == pytest.approx(c.barometer.sigma_m, rel=0.1)
    r = rows(flight, Kind.MAGNETOMETER)
    m = flight.trajectory.motion(flight.clock.true_s(r["stamp_ns"]))
    field = np.einsum("nij,nj->ni", m.R_nb, r["value"][:, :3])
    heading = np.arctan2(field[:, 1], field[:, 0]) - flight.place.declination_rad
    assert heading.std() == pytest.approx(c.magnetometer.heading_sigma_rad, rel=0.1)
    np.testing.assert_allclose(np.linalg.norm(field, axis=1), flight.place.field_t)
    np.testing.assert_allclose(np.arcsin(field[:, 2] / flight.place.field_t), flight.place.dip_rad)
    r = rows(flight, Kind.ATTITUDE)
    q = flight.trajectory.motion(flight.clock.true_s(r["stamp_ns"])).quaternion
    # In NED: estimate times the inverse of the truth.
    turn = [quat_log(quat_multiply(v, quat_conjugate(u))) for v, u in zip(r["value"][:, :4], q, strict=True)]
    np.testing.assert_allclose(np.std(turn, axis=0), [0.03, 0.03, 0.15], rtol=0.15)


def test_rangefinder_drops_and_mismatch() -> None:
    scenario = parse_scenario(
        """
description = "range"
[streams]
rangefinder = { rate_hz = 40.0, drop = 0.25 }
[filter.rangefinder]
use = true
sigma_per_m = 0.0
lever_arm_m = [0.1, 0.0, 0.05]
[mismatch.rangefinder]
sigma_m = 0.2
"""
    )
    assert scenario.config.rangefinder.sigma_m == 0.05
    flight = simulate(scenario, 2)
    r = rows(flight, Kind.RANGEFINDER)
    assert len(r) == pytest.approx(0.75 * 40.0 * flight.trajectory.plan.duration_s, rel=0.05)
    m = flight.trajectory.motion(flight.clock.true_s(r["stamp_ns"]))
    sensor = m.position_m + m.R_nb @ np.array([0.1, 0.0, 0.05])
    # Along the body's down axis to the sea.
    down = m.R_nb[:, :, 2]
    np.testing.assert_allclose((r["value"][:, 0] + sensor[:, 2] / down[:, 2]).std(), 0.2, rtol=0.1)


def test_clocks_and_timesync() -> None:
    clock = Clock(offset_s=-3.0, skew_ppm=40.0)
    t = np.array([0.0, 10.0, 1000.0])
    np.testing.assert_allclose(clock.true_s(clock.stamp_ns(t)), t, atol=1e-9)
    assert int(clock.stamp_ns(t)[2]) == 997_040_000_000
    scenario = msgspec.structs.replace(
        parse_scenario(
            """
description = "sync"
[streams]
timesync = { rate_hz = 10.0, delay_s = 0.002, delay_spread_s = 0.001 }
magnetometer = { rate_hz = 20.0, clock = "companion", jitter_s = 0.0005 }
[clocks]
autopilot = { offset_s = 50.0 }
companion = { offset_s = 7.0, skew_ppm = 30.0 }
"""
        )
    )
    flight = simulate(scenario, 1)
    exchanges = [e for e in flight.batch if type(e).__name__ == "TimeSync"]
    assert len(exchanges) > 500
    for e in exchanges[:20]:
        assert 0 < e.received_ns - e.sent_ns < 30_000_000  # type: ignore[union-attr]
        middle = 0.5 * (e.sent_ns + e.received_ns)  # type: ignore[union-attr]
        assert abs(e.remote_ns - middle - 43e9) < 20e6  # type: ignore[union-attr]
    r = rows(flight, Kind.MAGNETOMETER)
    assert set(r["clock"]) == {flight.batch.clocks.index("companion")}
    assert abs(int(r["stamp_ns"][0]) - 7e9) < 0.1e9


def test_slow_errors_have_their_statistics() -> None:
    rng = np.random.default_rng(1)
    x = gauss_markov(40_000, 0.2, np.array([0.7, 4.0]), np.array([2.0, 5.0]), rng)
    np.testing.assert_allclose(x.std(axis=0), [0.7, 4.0], rtol=0.1)
    lag = [np.mean(x[10:, k] * x[:-10, k]) / np.mean(x[:, k] ** 2) for k in range(2)]
    np.testing.assert_allclose(lag, np.exp([-1.0, -0.4]), atol=0.05)
    heights = np.array([-300.0, 0.0, 100.0, 2000.0])
    back = [pressure_altitude(p) for p in standard_pressure(heights)]
    np.testing.assert_allclose(back, heights, atol=1e-6)


def test_recording_gives_the_events_and_the_truth_back(flight: SimulatedFlight, tmp_path: Path) -> None:
    path = tmp_path / "flight.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(flight.recording())
    log = open_flight(path)
    read = log.events()
    assert len(read) == len(flight.batch)
    for name in EVENT_DTYPE.names or ():
        if name in ("sensor", "clock", "value"):
            continue
        np.testing.assert_array_equal(
            np.sort(read.rows[name], axis=0), np.sort(flight.batch.rows[name], axis=0), err_msg=name
        )
    for kind in (Kind.IMU, Kind.BAROMETER, Kind.MAGNETOMETER):
        ours, theirs = (b.rows[b.rows["kind"] == kind]["value"] for b in (flight.batch, read))
        np.testing.assert_array_equal(ours, theirs)
    (truth,) = log.series("/truth/odometry")
    m = flight.trajectory.motion(flight.clock.true_s(truth.stamp_ns))
    np.testing.assert_allclose(truth.data["pose_pose_position"], m.position_m, atol=1e-6)
    np.testing.assert_allclose(truth.data["twist_twist_linear"], m.velocity_mps, atol=1e-6)
    (deck,) = log.series("/truth/platform")
    moved = flight.trajectory.platform.motion(flight.clock.true_s(deck.stamp_ns))
    np.testing.assert_allclose(deck.data["pose_pose_position"], moved.position[0], atol=1e-6)
    assert log.attachments["config.toml"][1].decode().startswith("[")


def test_all_scenarios_can_be_flown() -> None:
    names = scenario_names()
    assert "landing_2026_06" in names
    for name in names:
        scenario = load_scenario(name)
        assert scenario.description
        assert scenario.plan.duration_s < 120.0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("description = 3", "description"),
        ("seed = 1", "description"),
        ("description = 'x'\ncolour = 'red'", "colour"),
        ("description = 'x'\n[plan]\nhover = 3.0", "hover"),
        ("description = 'x'\n[raft]\ncolour = 3.0", "colour"),
        ("description = 'x'\n[plan]\nhover_s = -1.0", "hover_s"),
        ("description = 'x'\n[sea]\nbeaufort = 7", "Beaufort 7"),
        ("description = 'x'\n[filter.imu]\nacel_noise = 1.0", "accel_noise"),
        ("description = 'x'\n[filter]\nimu = 3", "no table"),
        ("description = 'x'\n[streams.imu]\nrate_hz = 0.0", "rate_hz"),
        ("description = ", "TOML"),
    ],
)
def test_scenarios_that_cannot_be_flown_are_refused_in_one_line(text: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said) as error:
        parse_scenario(text, "mine.toml")
    assert str(error.value).startswith("mine.toml: ")
    assert "\n" not in str(error.value)


def test_unknown_scenarios_are_named() -> None:
    with pytest.raises(ConfigError, match="landing_2026_06"):
        load_scenario("regatta")
    with pytest.raises(ConfigError, match="cannot be read"):
        load_scenario("/nowhere/at_all.toml")


def test_scenario_is_plain_data() -> None:
    scenario = load_scenario(SURVEY)
    assert msgspec.convert(msgspec.to_builtins(scenario), Scenario) == scenario

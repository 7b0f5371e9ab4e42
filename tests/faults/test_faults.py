"""Named faults on a simulated flight: the outcomes that must appear, and the error that must stay bounded."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from estimation.estimator import LandingEstimator
from estimation.events import EventBatch
from estimation.frames import Array
from estimation.outcome import Outcome
from estimation.output import Run
from simulation import faults
from simulation.flight import SimulatedFlight, load_scenario, simulate
from simulation.known import known_of_flight
from simulation.montecarlo import kinematic_errors

Replay = Callable[[EventBatch], "Judged"]


@dataclass(frozen=True)
class Judged:
    """A run and its errors against the truth: position and velocity, tilt and yaw [deg]."""

    run: Run
    t_s: Array
    position_m: Array
    velocity_mps: Array
    tilt_deg: Array
    yaw_deg: Array

    def outcomes(self, sensor: str) -> dict[Outcome, int]:
        records = self.run.records[self.run.records["sensor"] == self.run.sensors.index(sensor)]
        values, counts = np.unique(records["outcome"], return_counts=True)
        return {Outcome(int(v)): int(c) for v, c in zip(values, counts, strict=True)}

    def noted(self, text: str) -> bool:
        return any(text in note for _, note in self.run.notes)


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(load_scenario("consistency_default_2026_06"), 7)


@pytest.fixture(scope="module")
def replay(flight: SimulatedFlight) -> Replay:
    def judged(batch: EventBatch) -> Judged:
        run = LandingEstimator(flight.scenario.config, facts=flight.facts).run(batch)
        if not len(run.t_ns):
            nothing = np.empty(0)
            return Judged(run, nothing, np.empty((0, 3)), np.empty((0, 3)), nothing, nothing)
        e, _ = kinematic_errors(run, known_of_flight(flight, run))
        degrees = np.degrees(e[:, 6:9])
        tilt = np.linalg.norm(degrees[:, :2], axis=1)
        return Judged(run, flight.clock.true_s(run.t_ns), e[:, :3], e[:, 3:6], tilt, np.abs(degrees[:, 2]))

    return judged


@pytest.fixture(scope="module")
def clean(flight: SimulatedFlight, replay: Replay) -> Judged:
    return replay(flight.batch)


def apart_m(a: Judged, b: Judged) -> float:
    """Return the largest distance between two runs' positions at equal times."""
    _, i, j = np.intersect1d(a.run.t_ns, b.run.t_ns, return_indices=True)
    assert len(i) > 1000
    return float(np.linalg.norm(a.run.position_m[i] - b.run.position_m[j], axis=1).max())


def test_nothing_goes_wrong_without_a_fault(clean: Judged) -> None:
    assert clean.tilt_deg.max() < 1.5
    assert np.linalg.norm(clean.position_m[:, :2], axis=1).max() < 3.0
    assert [text for _, text in clean.run.notes] == ["initialised at rest, heading from the magnetometer"]
    for sensor in ("gps_position", "gps_velocity", "barometer", "magnetometer"):
        assert Outcome.REJECTED_GATE not in clean.outcomes(sensor)


def test_gps_jump_is_rejected(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.gps_jump(flight.batch, [50.0, 0.0, 0.0], 25.0, 3.0))
    assert found.outcomes("gps_position")[Outcome.REJECTED_GATE] == 15
    assert apart_m(found, clean) < 0.5
    assert found.tilt_deg.max() < 1.5


def test_slow_gps_drift_bends_the_track_but_not_the_attitude(flight: SimulatedFlight, replay: Replay) -> None:
    """A spoofer that draws position and velocity away together cannot be told from motion by GPS alone."""
    found = replay(faults.gps_drift(flight.batch, [0.3, 0.0, 0.0], 25.0))
    drifted = 0.3 * (found.t_s[-1] - 25.0)
    assert np.linalg.norm(found.position_m[:, :2], axis=1).max() < drifted + 3.0
    assert found.tilt_deg.max() < 1.5


def test_position_that_is_not_a_number(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.not_finite(flight.batch, "gps_position", 25.0, 3.0))
    assert found.outcomes("gps_position")[Outcome.REJECTED_NOT_FINITE] == 15
    assert np.isfinite(found.run.position_m).all()
    assert apart_m(found, clean) < 0.5


@pytest.mark.parametrize("sensor", ["gps_position", "gps_velocity"])
@pytest.mark.parametrize("what", ["singular", "negative"])
def test_covariance_that_is_none(
    flight: SimulatedFlight, replay: Replay, clean: Judged, sensor: str, what: str
) -> None:
    wrong = faults.bad_covariance(
        flight.batch, sensor, "singular" if what == "singular" else "negative", 25.0, 3.0
    )
    found = replay(wrong)
    assert found.outcomes(sensor)[Outcome.REJECTED_COVARIANCE] == 15
    assert apart_m(found, clean) < 0.5


def test_inertial_samples_that_are_not_numbers(
    flight: SimulatedFlight, replay: Replay, clean: Judged
) -> None:
    found = replay(faults.not_finite(flight.batch, "imu", 35.0, 0.1))
    assert found.run.imu_outcomes[Outcome.REJECTED_NOT_FINITE] == 20
    assert np.isfinite(found.run.covariance).all()
    assert apart_m(found, clean) < 1.0


def test_frozen_imu_is_left_behind(flight: SimulatedFlight, replay: Replay) -> None:
    """In a turn, for a second: rejections show it, and the position comes back to GPS."""
    found = replay(faults.frozen(flight.batch, "imu", 33.0, 1.0))
    rejected = sum(found.outcomes(s).get(Outcome.REJECTED_GATE, 0) for s in ("gps_velocity", "magnetometer"))
    assert rejected > 5
    last = found.t_s > found.t_s[-1] - 5.0
    assert np.linalg.norm(found.position_m[last, :2], axis=1).max() < 4.0
    assert found.tilt_deg[last].max() < 2.0


def test_short_gap_is_bridged(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.gap(flight.batch, "imu", 33.0, 0.3))
    assert not found.noted("aligning again")
    assert apart_m(found, clean) < 1.0
    assert found.tilt_deg.max() < 8.0
    assert found.tilt_deg[found.t_s > 45.0].max() < 1.5


def test_long_gap_is_a_new_start(flight: SimulatedFlight, replay: Replay) -> None:
    found = replay(faults.gap(flight.batch, "imu", 33.0, 5.0))
    assert found.noted("no inertial sample for 5.0 s: aligning again")
    assert found.noted("initialised in flight")
    assert not np.any((found.t_s > 33.1) & (found.t_s < 38.0))
    last = found.t_s > found.t_s[-1] - 5.0
    assert np.linalg.norm(found.position_m[last, :2], axis=1).max() < 4.0
    assert found.tilt_deg[last].max() < 2.0


def test_inertial_clock_that_steps_back(flight: SimulatedFlight, replay: Replay) -> None:
    found = replay(faults.clock_step(flight.batch, -10.0, 33.0))
    assert found.noted("the inertial clock went back by")
    assert found.run.imu_outcomes[Outcome.REJECTED_TOO_OLD] > 0
    assert found.noted("initialised in flight")
    assert np.isfinite(found.run.position_m).all()
    # After the step the stamps mean a time ten seconds later.
    run = found.run
    back = int(np.argmin(np.diff(run.t_ns))) + 1
    true_s = flight.clock.true_s(run.t_ns[back:]) + 10.0
    p = flight.trajectory.motion(true_s).position_m
    off = np.linalg.norm((run.position_m[back:] - p)[:, :2], axis=1)
    assert off[true_s > true_s[-1] - 5.0].max() < 4.0


def test_readings_older_than_the_window(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.delayed(flight.batch, "barometer", 1.0, 25.0, 3.0))
    assert found.outcomes("barometer")[Outcome.REJECTED_TOO_OLD] == 60
    assert apart_m(found, clean) < 1.0


def test_late_readings_are_fused_at_their_own_time(
    flight: SimulatedFlight, replay: Replay, clean: Judged
) -> None:
    found = replay(faults.delayed(flight.batch, "barometer", 0.3, 25.0, 3.0))
    late, usual = (x.outcomes("barometer").get(Outcome.FUSED_LATE, 0) for x in (found, clean))
    assert late - usual >= 55
    after = found.run.t_ns > 30e9
    same = clean.run.t_ns > 30e9
    np.testing.assert_array_equal(found.run.nominal[after], clean.run.nominal[same])


def test_readings_from_the_future(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.clock_step(flight.batch, 2.0, 25.0, "barometer"))
    outcomes = found.outcomes("barometer")
    assert outcomes[Outcome.REJECTED_FUTURE] > 600
    assert Outcome.REJECTED_GATE not in outcomes
    assert apart_m(found, clean) < 8.0  # without a barometer from then on
    assert found.tilt_deg.max() < 1.5


def test_repeated_readings_change_nothing(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.repeated(flight.batch, "barometer", 25.0, 3.0))
    assert found.outcomes("barometer")[Outcome.REJECTED_DUPLICATE] == 60
    np.testing.assert_array_equal(found.run.nominal, clean.run.nominal)
    np.testing.assert_array_equal(found.run.covariance, clean.run.covariance)


def test_cold_start_keeps_the_attitude_and_moves_the_position(
    flight: SimulatedFlight, replay: Replay
) -> None:
    """Fixes kilometres off for ten seconds, then right: the horizon must not follow, the position must."""
    found = replay(faults.gps_jump(flight.batch, [3000.0, 4000.0, 100.0], 0.0, 10.0))
    assert found.outcomes("gps_position")[Outcome.REJECTED_GATE] >= 5
    assert found.noted("gps_position contradicted the filter")
    assert found.tilt_deg.max() < 2.0
    horizontal = np.linalg.norm(found.position_m[:, :2], axis=1)
    assert horizontal[found.t_s < 9.0].min() > 4000.0
    assert horizontal[found.t_s > 18.0].max() < 4.0


def test_no_gps_is_said(flight: SimulatedFlight, replay: Replay) -> None:
    found = replay(faults.without(faults.without(flight.batch, "gps_position"), "gps_velocity"))
    assert len(found.run.t_ns) == 0
    assert "GPS" in found.run.missing
    assert set(found.outcomes("barometer")) == {Outcome.REJECTED_NOT_READY}


def test_gps_lost_for_ten_seconds(flight: SimulatedFlight, replay: Replay) -> None:
    found = replay(
        faults.gap(faults.gap(flight.batch, "gps_position", 25.0, 10.0), "gps_velocity", 25.0, 10.0)
    )
    horizontal = np.linalg.norm(found.position_m[:, :2], axis=1)
    assert horizontal.max() < 15.0
    assert horizontal[found.t_s > 40.0].max() < 3.0
    assert found.tilt_deg.max() < 2.0


def test_no_magnetometer(flight: SimulatedFlight, replay: Replay) -> None:
    """The heading comes from the horizontal acceleration that GPS and accelerometers both see."""
    found = replay(faults.without(faults.without(flight.batch, "magnetometer"), "attitude"))
    assert found.noted("heading from horizontal acceleration")
    assert found.t_s[0] > flight.trajectory.plan.rest_s
    last = found.t_s > found.t_s[-1] - 10.0
    assert found.yaw_deg[last].max() < 6.0
    assert found.tilt_deg[last].max() < 2.0


def test_magnetometer_spike_is_rejected(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.offset(flight.batch, "magnetometer", [0.0, 8e-5, 0.0], 25.0, 0.1))
    assert found.outcomes("magnetometer")[Outcome.REJECTED_GATE] >= 2
    assert np.abs(found.yaw_deg - clean.yaw_deg).max() < 0.5


def test_barometer_jump_moves_its_offset_not_the_height(
    flight: SimulatedFlight, replay: Replay, clean: Judged
) -> None:
    found = replay(faults.offset(flight.batch, "barometer", -600.0, 25.0))
    assert found.outcomes("barometer")[Outcome.REJECTED_GATE] >= 50
    assert found.noted("barometer contradicted the filter")
    assert apart_m(found, clean) < 1.0


@pytest.mark.parametrize("attitude", [True, False])
def test_start_in_flight(flight: SimulatedFlight, replay: Replay, attitude: bool) -> None:
    """The log begins in the middle of a fast turn."""
    batch = flight.batch if attitude else faults.without(flight.batch, "attitude")
    found = replay(faults.begins_at(batch, 20.0))
    assert found.noted("initialised in flight")
    assert found.t_s[0] < 32.0
    last = found.t_s > found.t_s[-1] - 10.0
    assert found.tilt_deg[last].max() < 2.0
    assert found.yaw_deg[last].max() < 6.0
    assert np.linalg.norm(found.position_m[last, :2], axis=1).max() < 4.0


def test_a_fault_of_an_unknown_sensor_is_refused(flight: SimulatedFlight) -> None:
    with pytest.raises(ValueError, match="'sonar' is not in this flight"):
        faults.without(flight.batch, "sonar")

"""Named faults of the camera, its clock and the GPS beside it, over a raft: the outcomes that must appear, and the
relative position that must stay within what the filter says of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pytest

from estimation.estimator import LandingEstimator
from estimation.events import AUTOPILOT, EventBatch, Kind
from estimation.frames import Array
from estimation.outcome import Outcome
from estimation.output import Run
from simulation import faults
from simulation.flight import SimulatedFlight, parse_scenario, simulate

TEXT = """
description = "a hover over a raft, for faults of the camera"
[plan]
rest_s = 3.0
climb_s = 3.0
leg_s = 4.0
hover_s = 24.0
descent_s = 6.0
deck_s = 0.5
altitude_m = 6.0
start_m = [-4.0, -3.0, -1.0]
legs_m = []
yaw_rad = [0.4, 0.4]
[sea]
beaufort = 2
[raft]
circle_m = 0.2
[wind]
sway_m = 0.1
[streams]
imu = { rate_hz = 100.0 }
barometer = { rate_hz = 10.0 }
magnetometer = { rate_hz = 10.0 }
timesync = { rate_hz = 10.0, delay_s = 0.001 }
vision = { rate_hz = 20.0, delay_s = 0.04 }
[clocks]
companion = { offset_s = 700.0 }
[filter.attitude]
use = "off"
[filter.platform]
use = true
[filter.vision]
latency_s = 0.04
latency_sigma_s = 0.002
"""
FROM_S, FOR_S = 20.0, 3.0
FIXES = 60
"""Fixes in ``FOR_S``."""


@dataclass(frozen=True)
class Judged:
    """A run with the error of its relative position (n, 3) [m] and that over its 1-sigma (n, 3), at true times."""

    run: Run
    t_s: Array
    error_m: Array
    ratio: Array

    def outcomes(self, sensor: str = "vision") -> dict[Outcome, int]:
        records = self.run.records[self.run.records["sensor"] == self.run.sensors.index(sensor)]
        values, counts = np.unique(records["outcome"], return_counts=True)
        return {Outcome(int(v)): int(c) for v, c in zip(values, counts, strict=True)}

    def during(self, begin_s: float, end_s: float) -> tuple[float, float]:
        """Return the largest error [m] and the largest error over its sigma of a time."""
        inside = (self.t_s >= begin_s) & (self.t_s < end_s)
        assert inside.sum() > 10
        return float(np.abs(self.error_m[inside]).max()), float(np.abs(self.ratio[inside]).max())


Replay = Callable[[EventBatch], Judged]


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(parse_scenario(TEXT), 11)


@pytest.fixture(scope="module")
def replay(flight: SimulatedFlight) -> Replay:
    def judged(batch: EventBatch) -> Judged:
        run = LandingEstimator(flight.scenario.config, facts=flight.facts).run(batch)
        t_s = flight.clock.true_s(run.t_ns)
        true = flight.trajectory.motion(t_s).position_m - flight.trajectory.platform.motion(t_s).position[0]
        error = run.deck[:, :3] - true
        assert np.isfinite(run.deck_covariance).all()
        sigma = np.sqrt(np.diagonal(run.deck_covariance, axis1=1, axis2=2)[:, :3])
        return Judged(run, t_s, error, error / sigma)

    return judged


@pytest.fixture(scope="module")
def clean(flight: SimulatedFlight, replay: Replay) -> Judged:
    return replay(flight.batch)


def test_nothing_goes_wrong_without_a_fault(clean: Judged) -> None:
    error, ratio = clean.during(15.0, 33.0)
    assert error < 0.25
    assert ratio < 4.5
    assert set(clean.outcomes()) <= {Outcome.FUSED_LATE, Outcome.DOWNWEIGHTED, Outcome.REJECTED_NOT_READY}


@pytest.mark.parametrize(
    ("fault", "outcome", "count"),
    [
        (lambda b: faults.not_finite(b, "vision", FROM_S, FOR_S), Outcome.REJECTED_NOT_FINITE, FIXES),
        (lambda b: faults.bad_covariance(b, "vision", "singular", FROM_S, FOR_S), Outcome.REJECTED_COVARIANCE, FIXES),
        (lambda b: faults.bad_covariance(b, "vision", "negative", FROM_S, FOR_S), Outcome.REJECTED_COVARIANCE, FIXES),
        (lambda b: faults.delayed(b, "vision", 1.0, FROM_S, FOR_S), Outcome.REJECTED_TOO_OLD, FIXES),
        (lambda b: faults.offset(b, "vision", [3.0, -2.0, 4.0], FROM_S, 1.0), Outcome.REJECTED_GATE, FIXES // 3),
    ],
    ids=["not a number", "singular", "negative", "older than the window", "burst of outliers"],
)  # fmt: skip
def test_fixes_that_are_rejected_cost_no_more_than_fixes_that_are_missing(
    flight: SimulatedFlight, replay: Replay, fault: Callable[[EventBatch], EventBatch], outcome: Outcome, count: int
) -> None:  # fmt: skip
    found = replay(fault(flight.batch))
    assert found.outcomes()[outcome] == pytest.approx(count, abs=2)
    assert found.during(FROM_S, 33.0)[1] < 5.0
    assert found.during(FROM_S + FOR_S + 2.0, 33.0)[0] < 0.3


def test_fixes_that_come_twice_change_nothing(flight: SimulatedFlight, replay: Replay, clean: Judged) -> None:
    found = replay(faults.repeated(flight.batch, "vision", FROM_S, FOR_S))
    assert found.outcomes()[Outcome.REJECTED_DUPLICATE] == pytest.approx(FIXES, abs=1)
    np.testing.assert_array_equal(found.run.nominal, clean.run.nominal)


def test_a_picture_that_stands_still_confirms_nothing(flight: SimulatedFlight, replay: Replay) -> None:
    """The same fix under fresh stamps: all but the first are told as repetitions, as if there were none."""
    wrong = faults.frozen(flight.batch, "vision", FROM_S, FOR_S)
    found = replay(wrong)
    assert found.outcomes()[Outcome.REJECTED_DUPLICATE] == pytest.approx(FIXES - 1, abs=2)
    assert found.during(FROM_S, 33.0)[1] < 5.0
    # With models that are not learned on the way, which would enlarge what rounding differs.
    still = parse_scenario(TEXT.replace("use = true\n", "use = true\nlearn_s = 0.0\n")).config
    missing = faults.gap(flight.batch, "vision", FROM_S + 0.05, FOR_S - 0.05)
    told, lost = (LandingEstimator(still, facts=flight.facts).run(b) for b in (wrong, missing))
    _, i, j = np.intersect1d(told.t_ns, lost.t_ns, return_indices=True)
    # The propagation is cut at the repetitions' times, no more.
    assert np.abs(told.deck[i] - lost.deck[j]).max() < 2e-3
    sigma, alone = (
        np.sqrt(np.diagonal(r.deck_covariance[k], axis1=1, axis2=2)) for r, k in ((told, i), (lost, j))
    )
    assert np.abs(sigma / alone - 1.0).max() < 2e-3


def test_a_picture_that_stands_still_is_found_in_any_order_of_arrival(flight: SimulatedFlight) -> None:
    wrong = faults.frozen(flight.batch, "vision", FROM_S, FOR_S)
    # On the inertial clock: what the exchanges say of another depends on when they come.
    rows = wrong.rows[wrong.rows["kind"] != Kind.TIMESYNC][:4400]
    fixes = rows["kind"] == Kind.VISION
    rows["stamp_ns"][fixes] -= 700_000_000_000
    rows["clock"] = wrong.clocks.index(AUTOPILOT)
    place = np.arange(len(rows)) + np.where(
        fixes, np.random.default_rng(3).uniform(0.0, 40.0, len(rows)), 0.0
    )
    place[-60:] = np.arange(len(rows) - 60, len(rows)) + 100.0
    early, shuffled = (
        EventBatch(rows[order], wrong.sensors, wrong.clocks)
        for order in (np.arange(len(rows)), np.argsort(place, kind="stable"))
    )
    a, b = (LandingEstimator(flight.scenario.config, facts=flight.facts).run(x) for x in (early, shuffled))
    np.testing.assert_array_equal(a.nominal[-1], b.nominal[-1])
    for run in (a, b):
        told = run.records[run.records["sensor"] == run.sensors.index("vision")]
        assert np.count_nonzero(told["outcome"] == Outcome.REJECTED_DUPLICATE) > 20


@pytest.mark.parametrize("by_s", [1.0, -1.0])
def test_a_clock_that_steps_is_noticed_and_followed(
    flight: SimulatedFlight, replay: Replay, by_s: float
) -> None:
    """The companion's clock, fixes and exchanges alike: fixes are rejected until the exchanges agree on the step."""
    stepped = faults.clock_step(flight.batch, by_s, FROM_S, "vision")
    rows = stepped.rows.copy()
    exchanges = rows["kind"] == Kind.TIMESYNC
    # Of an exchange, ``arrival_ns`` is the companion's clock at its middle; that clock began at 700 s.
    after = exchanges & (rows["arrival_ns"] >= round((700.0 + FROM_S) * 1e9))
    rows["arrival_ns"][after] += round(by_s * 1e9)
    found = replay(EventBatch(rows, stepped.sensors, stepped.clocks, stepped.timesync_reference))
    outcomes = found.outcomes()
    rejected = sum(n for o, n in outcomes.items() if not o.fused and o is not Outcome.REJECTED_NOT_READY)
    assert 1 <= rejected < 30
    assert found.run.clocks[0].steps == 1
    assert found.during(FROM_S, 33.0)[1] < 5.0
    assert found.during(FROM_S + 4.0, 33.0)[0] < 0.3


def test_fixes_from_the_future_are_not_fused(flight: SimulatedFlight, replay: Replay) -> None:
    """Stamps two seconds ahead, while the exchanges say that the clock is where it was."""
    found = replay(faults.clock_step(flight.batch, 2.0, FROM_S, "vision"))
    assert found.outcomes()[Outcome.REJECTED_FUTURE] > 200
    assert found.during(FROM_S, 33.0)[1] < 5.0


def test_vision_that_comes_back_moves_the_estimate_within_its_sigma(
    flight: SimulatedFlight, replay: Replay
) -> None:
    found = replay(faults.gap(flight.batch, "vision", FROM_S, 5.0))
    assert found.during(FROM_S, 33.0)[1] < 5.0
    back = (found.t_s > FROM_S + 4.5) & (found.t_s < FROM_S + 6.0)
    relative, t_s = found.run.deck[back, :3], found.t_s[back]
    true = flight.trajectory.motion(t_s).position_m - flight.trajectory.platform.motion(t_s).position[0]
    sigma = np.sqrt(np.diagonal(found.run.deck_covariance[back], axis1=1, axis2=2)[:, :3])
    jump = np.abs(np.diff(relative - true, axis=0)) / sigma[:-1]
    assert jump.max() < 4.0
    assert found.during(FROM_S + 7.0, 33.0)[0] < 0.3


def test_a_gps_that_jumps_does_not_move_the_relative_position(
    flight: SimulatedFlight, replay: Replay, clean: Judged
) -> None:
    found = replay(faults.gps_jump(flight.batch, [30.0, -20.0, 10.0], FROM_S, FOR_S))
    assert found.outcomes("gps_position")[Outcome.REJECTED_GATE] == 15
    assert np.abs(found.run.deck[:, :3] - clean.run.deck[:, :3]).max() < 0.05


def test_a_gps_that_drifts_is_told_by_vision_and_the_landing_is_finished_on_it(
    flight: SimulatedFlight, replay: Replay
) -> None:
    """Position and velocity are drawn away together; then the target is lost for the last three seconds."""
    drifting = faults.gps_drift(flight.batch, [0.05, 0.0, 0.0], FROM_S)
    found = replay(faults.gap(drifting, "vision", 30.0, 3.0))
    assert found.during(FROM_S, 30.0)[0] < 0.3
    assert found.during(30.0, 33.0)[0] < 0.5

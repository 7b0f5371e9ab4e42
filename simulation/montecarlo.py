"""Many simulated flights of one scenario: the estimator's errors and innovations, normalised, phase by phase."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from estimation.consistency import RunsConsistency, normalised_squared, runs_consistency
from estimation.estimator import EngineName, LandingEstimator
from estimation.frames import geodetic_to_ned, quat_conjugate, quat_log, quat_multiply
from estimation.outcome import Outcome
from estimation.output import Run
from estimation.state import BLOCKS, NOMINAL
from simulation.flight import Scenario, SimulatedFlight, simulate
from simulation.jets import Array
from simulation.sensors import Times, truth_at
from simulation.trajectory import PHASES

INSTANTS_HZ = 2.0
STATES = {
    "position": slice(0, 3),
    "velocity": slice(3, 6),
    "attitude": slice(6, 9),
    "kinematics": slice(0, 9),
}
"""Parts of the estimates' covariance that are judged together; ``kinematics`` is all of it."""
TRACKING_S = 12.0
"""The first part of a hover in sight of the deck, in which its heave is not learned yet."""
PARTS = (*PHASES, "tracking", "blind")
"""Parts of a flight that are judged by themselves: the phases, and of a hover that sees the deck what comes first and
what is blind; the rest of it is ``hover``."""
SLOW = ("gyro_bias", "accel_bias", "gps_bias", "baro_bias")


@dataclass(frozen=True, slots=True)
class FlightErrors:
    """One flight's normalised squares, and its forecasts of the heave.

    ``nees`` holds, for each judged quantity, the degrees of freedom and values (n,) at ``instants_s`` (n,),
    true time; ``phase`` (n,) are indices of ``PARTS``; ``nis`` for each sensor the degrees of freedom, the
    content's stamps and the values. Slow errors have the squares of their components over their own variances,
    averaged: their correlations are not given out.
    """

    instants_s: Array
    phase: Times
    nees: dict[str, tuple[int, Array]]
    nis: dict[str, tuple[int, Times, Array]]
    nis_phase: dict[str, Times]
    run: Run
    flight: SimulatedFlight


def fly(scenario: Scenario, seed: int, engine: EngineName = "auto") -> FlightErrors:
    """Simulate one flight, run the estimator over it and return what is to be judged.

    Raises ``ValueError`` where the estimator never starts.
    """
    flight = simulate(scenario, seed)
    run = LandingEstimator(scenario.config, engine=engine, facts=flight.facts).run(flight.batch)
    if not len(run.t_ns):
        raise ValueError(f"the estimator did not start in seed {seed}: it waited for {run.missing}")
    return errors(flight, run)


def errors(flight: SimulatedFlight, run: Run) -> FlightErrors:
    """Compare a run with the truth of its flight."""
    true_s = flight.clock.true_s(run.t_ns)
    grid = np.arange(0.0, flight.trajectory.plan.duration_s, 1.0 / INSTANTS_HZ)
    index = np.searchsorted(true_s, grid)
    usable = (index < len(true_s)) & (grid >= true_s[0])
    # An instant is the first estimate after it; before the start there is none.
    chosen = index[usable]
    instants = np.full(len(grid), np.nan)
    instants[usable] = true_s[chosen]
    e, covariance = kinematic_errors(flight, run)
    nees = {}
    for name, part in STATES.items():
        values = np.full(len(grid), np.nan)
        values[usable] = normalised_squared(e[chosen, part], covariance[chosen, part, part])
        nees[name] = (part.stop - part.start, values)
    for name in SLOW:
        entry = _slow(flight, run, name, true_s)
        if entry is not None:
            values = np.full(len(grid), np.nan)
            values[usable] = np.sum(entry[chosen] ** 2, axis=1)
            nees[name] = (entry.shape[1], values)
    for name, (e, covariance) in deck_errors(flight, run).items():
        values = np.full(len(grid), np.nan)
        values[usable] = normalised_squared(e[chosen], covariance[chosen])
        nees[name] = (e.shape[1], values)
    nis, nis_phase = {}, {}
    for k, name in enumerate(run.sensors):
        r = run.records[(run.records["sensor"] == k) & (run.records["dof"] > 0)]
        if len(r):
            nis[name] = (int(r["dof"].max()), r["t_ns"], r["nis"])
            nis_phase[name] = parts_at(flight, flight.clock.true_s(r["t_ns"]))
    return FlightErrors(grid, parts_at(flight, grid), nees, nis, nis_phase, run, flight)


def parts_at(flight: SimulatedFlight, t_s: Array) -> Times:
    """Return the part of the flight, as an index of ``PARTS``, at each time."""
    index = flight.trajectory.phase(t_s)
    vision = flight.scenario.streams.vision
    if vision is None or vision.view is None:
        return index
    begin, end = flight.trajectory.plan.bounds_s["hover"]
    seeing = max([b for a, b in vision.view.hidden_s if a < begin < b], default=begin)
    hover = index == PHASES.index("hover")
    index[hover & (t_s < seeing + TRACKING_S)] = PARTS.index("tracking")
    for a, b in vision.view.hidden_s:
        index[hover & (t_s >= a) & (t_s < b)] = PARTS.index("blind" if a > begin and b < end else "cruise")
    return index


def deck_errors(flight: SimulatedFlight, run: Run) -> dict[str, tuple[Array, Array]]:
    """Return the errors, truth less estimate, with their covariances, of the relative position and velocity (n, 6) and
    of the deck's rate (n, 1); nothing where there is no deck. Before the first fix they are NaN.
    """
    if not run.deck.shape[1]:
        return {}
    true_s = flight.clock.true_s(run.t_ns)
    own, deck = truth_at(flight.trajectory, flight.clock, run.t_ns), flight.trajectory.platform.motion(true_s)
    relative = np.hstack([own.position_m - deck.position[0], own.velocity_mps - deck.position[1]])
    e = relative - run.deck[:, :6]
    rate = -deck.position[1][:, 2:] - run.deck[:, 7:8]
    cameras = [k for k, name in enumerate(run.sensors) if name == "vision"]
    seen = np.isin(run.records["sensor"], cameras) & (run.records["outcome"] <= int(Outcome.DOWNWEIGHTED))
    before = run.t_ns <= np.min(run.records["t_ns"][seen], initial=np.iinfo(np.int64).max)
    e[before], rate[before] = np.nan, np.nan
    C = run.deck_covariance
    return {
        "relative_position": (e[:, :3], C[:, :3, :3]),
        "relative": (e, C[:, :6, :6]),
        "deck_rate": (rate, C[:, 7:8, 7:8]),
    }


def kinematic_errors(flight: SimulatedFlight, run: Run) -> tuple[Array, Array]:
    """Return the errors (n, 9), truth less estimate, of position, velocity and attitude, and their
    covariance.
    """
    m = truth_at(flight.trajectory, flight.clock, run.t_ns)
    assert run.origin is not None
    datum = geodetic_to_ned(*run.origin, flight.place.origin)
    turned = np.array(
        [
            quat_log(quat_multiply(quat_conjugate(a), b))
            for a, b in zip(run.quaternion, m.quaternion, strict=True)
        ]
    )
    e = np.hstack([m.position_m - datum - run.position_m, m.velocity_mps - run.velocity_mps, turned])
    return e, run.covariance


def _slow(flight: SimulatedFlight, run: Run, name: str, true_s: Array) -> Array | None:
    """Return the errors of a slow block over their sigmas (n, k), or None where it is not a state."""
    entries = [i for i, s in enumerate(run.state_names) if s.split(".", maxsplit=1)[0] == name]
    if name not in flight.slow or not entries:
        return None
    block = next(b for b, (known, _, _) in enumerate(BLOCKS) if known == name)
    estimate = run.nominal[:, NOMINAL[block] : NOMINAL[block] + len(entries)]
    return (flight.slow[name].at(true_s) - estimate) / run.sigma[:, entries]


def nees_by_phase(
    flights: Sequence[FlightErrors], probability: float = 0.95
) -> dict[tuple[str, str], RunsConsistency]:
    """Return the consistency of each quantity in each phase; phases without estimates are left out."""
    out = {}
    for name, (dof, _) in flights[0].nees.items():
        values = np.stack([f.nees[name][1] for f in flights])
        for k, phase in enumerate(PARTS):
            inside = values[:, flights[0].phase == k]
            if np.isfinite(inside).any():
                out[name, phase] = runs_consistency(inside, dof, probability)
    return out


def nis_by_phase(
    flights: Sequence[FlightErrors], probability: float = 0.95
) -> dict[tuple[str, str], RunsConsistency]:
    """Return the consistency of each sensor's innovations in each phase.

    Measurements of equal stamp in different flights are one instant; without drops and jitter all are.
    """
    out = {}
    for name, (dof, _, _) in flights[0].nis.items():
        stamps = np.unique(np.concatenate([f.nis[name][1] for f in flights]))
        values = np.full((len(flights), len(stamps)), np.nan)
        phases = np.zeros(len(stamps), dtype=np.int64)
        for row, f in zip(values, flights, strict=True):
            places = np.searchsorted(stamps, f.nis[name][1])
            row[places] = f.nis[name][2]
            phases[places] = f.nis_phase[name]
        for k, phase in enumerate(PARTS):
            inside = values[:, phases == k]
            if np.isfinite(inside).any():
                out[name, phase] = runs_consistency(inside, dof, probability)
    return out

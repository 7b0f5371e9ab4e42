"""Many simulated flights of one scenario: the estimator's errors and innovations, normalised, part by part."""

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
from simulation import world
from simulation.flight import Scenario, simulate
from simulation.jets import Array
from simulation.known import Known, known_of_flight, known_of_landing
from simulation.mission import Mission

INSTANTS_HZ = 2.0
STATES = {
    "position": slice(0, 3),
    "velocity": slice(3, 6),
    "attitude": slice(6, 9),
    "kinematics": slice(0, 9),
}
"""Parts of the estimates' covariance that are judged together; ``kinematics`` is all of it."""
SLOW = ("gyro_bias", "accel_bias", "gps_bias", "baro_bias")


@dataclass(frozen=True, slots=True)
class Squares:
    """Normalised squares (n,) of ``dof`` degrees of freedom, NaN where there is none, at true times (n,)."""

    dof: int
    t_s: Array
    values: Array


@dataclass(frozen=True, slots=True)
class FlightErrors:
    """One flight's normalised squares: ``nees`` of each judged quantity at common instants, ``nis`` of each sensor.

    Slow errors have the squares of their components over their own variances, averaged: their correlations are not
    given out.
    """

    nees: dict[str, Squares]
    nis: dict[str, Squares]
    run: Run
    known: Known


def fly(scenario: Scenario, seed: int, engine: EngineName = "auto") -> FlightErrors:
    """Simulate one flight by plan, run the estimator over it and return what is to be judged.

    Raises ``ValueError`` where the estimator never starts.
    """
    flight = simulate(scenario, seed)
    run = _started(
        LandingEstimator(scenario.config, engine=engine, facts=flight.facts).run(flight.batch), seed
    )
    return errors(run, known_of_flight(flight, run))


def land(mission: Mission, seed: int, engine: EngineName = "auto") -> FlightErrors:
    """Fly one landing on its own estimates, run the estimator over what arrived and return what is to be judged.

    Raises ``ValueError`` where the estimator never starts.
    """
    flown = world.fly(mission, seed, engine=engine)
    estimator = LandingEstimator(mission.config, engine=engine, facts=world.facts_of(mission))
    run = _started(estimator.run(flown.batch), seed)
    return errors(run, known_of_landing(flown, run))


def _started(run: Run, seed: int) -> Run:
    if not len(run.t_ns):
        raise ValueError(f"the estimator did not start in seed {seed}: it waited for {run.missing}")
    return run


def errors(run: Run, known: Known) -> FlightErrors:
    """Compare a run with the truth of its flight."""
    true_s = known.clock.true_s(run.t_ns)
    grid = np.arange(0.0, known.end_s, 1.0 / INSTANTS_HZ)
    index = np.searchsorted(true_s, grid)
    usable = (index < len(true_s)) & (grid >= true_s[0])
    # An instant is the first estimate after it; before the start there is none.
    chosen = index[usable]

    def at_instants(dof: int, squares: Array) -> Squares:
        values = np.full(len(grid), np.nan)
        values[usable] = squares
        return Squares(dof, grid, values)

    e, covariance = kinematic_errors(run, known)
    nees = {}
    for name, part in STATES.items():
        squares = normalised_squared(e[chosen, part], covariance[chosen, part, part])
        nees[name] = at_instants(part.stop - part.start, squares)
    for name in SLOW:
        entry = _slow(run, known, name)
        if entry is not None:
            nees[name] = at_instants(entry.shape[1], np.sum(entry[chosen] ** 2, axis=1))
    for name, (e, covariance) in deck_errors(run, known).items():
        nees[name] = at_instants(e.shape[1], normalised_squared(e[chosen], covariance[chosen]))
    nis = {}
    for k, name in enumerate(run.sensors):
        r = run.records[(run.records["sensor"] == k) & (run.records["dof"] > 0)]
        if len(r):
            nis[name] = Squares(int(r["dof"].max()), known.clock.true_s(r["t_ns"]), r["nis"])
    return FlightErrors(nees, nis, run, known)


def deck_errors(run: Run, known: Known) -> dict[str, tuple[Array, Array]]:
    """Return the errors, truth less estimate, with their covariances, of the relative position and velocity (n, 6) and
    of the deck's rate (n, 1); nothing where there is no deck. Before the first fix they are NaN.
    """
    if not run.deck.shape[1]:
        return {}
    relative = np.hstack([known.position_m - known.deck_m, known.velocity_mps - known.deck_mps])
    e = relative - run.deck[:, :6]
    rate = -known.deck_mps[:, 2:] - run.deck[:, 7:8]
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


def kinematic_errors(run: Run, known: Known) -> tuple[Array, Array]:
    """Return the errors (n, 9), truth less estimate, of position, velocity and attitude, and their
    covariance.
    """
    assert run.origin is not None
    datum = geodetic_to_ned(*run.origin, known.place.origin)
    turned = np.array(
        [
            quat_log(quat_multiply(quat_conjugate(a), b))
            for a, b in zip(run.quaternion, known.quaternion, strict=True)
        ]
    )
    moved = [known.position_m - datum - run.position_m, known.velocity_mps - run.velocity_mps]
    return np.hstack([*moved, turned]), run.covariance


def _slow(run: Run, known: Known, name: str) -> Array | None:
    """Return the errors of a slow block over their sigmas (n, k), or None where it is not a state."""
    entries = [i for i, s in enumerate(run.state_names) if s.split(".", maxsplit=1)[0] == name]
    if name not in known.slow or not entries:
        return None
    block = next(b for b, (label, _, _) in enumerate(BLOCKS) if label == name)
    estimate = run.nominal[:, NOMINAL[block] : NOMINAL[block] + len(entries)]
    return (known.slow[name].at(known.clock.true_s(run.t_ns)) - estimate) / run.sigma[:, entries]


def nees_by_phase(
    flights: Sequence[FlightErrors], probability: float = 0.95
) -> dict[tuple[str, str], RunsConsistency]:
    """Return the consistency of each quantity in each part of the flight; parts without estimates are left out."""
    return _by_part([(f.known, f.nees) for f in flights], probability)


def nis_by_phase(
    flights: Sequence[FlightErrors], probability: float = 0.95
) -> dict[tuple[str, str], RunsConsistency]:
    """Return the consistency of each sensor's innovations in each part of the flight."""
    return _by_part([(f.known, f.nis) for f in flights], probability)


def _by_part(
    flights: list[tuple[Known, dict[str, Squares]]], probability: float
) -> dict[tuple[str, str], RunsConsistency]:
    """Judge what lies in each part, the first of one flight beside the first of the others and so on: landings that
    were flown are not at the same point at the same time.
    """
    out = {}
    parts = flights[0][0].parts
    for name in dict.fromkeys(name for _, squares in flights for name in squares):
        given = [(known.part_at(s[name].t_s), s[name]) for known, s in flights if name in s]
        for k, part in enumerate(parts):
            rows = [s.values[index == k] for index, s in given]
            values = np.full((len(rows), max(map(len, rows))), np.nan)
            for row, inside in zip(values, rows, strict=True):
                row[: len(inside)] = inside
            if np.isfinite(values).any():
                out[name, part] = runs_consistency(values, given[0][1].dof, probability)
    return out

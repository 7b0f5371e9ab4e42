"""What a tuning maximises: how likely the measurements of a flight were, in the eyes of the filter before each.

A filter with the right noises predicts every measurement with an innovation r of covariance S, and the innovations are
independent of each other; their joint density is the likelihood of the flight (Schweppe, 1965). A measurement of
dimension m counts

    log( (1 - e) f + e g ),   log f = -(rho(NIS) + log det S + m log 2 pi) / 2,   g = 1 / (2 w)^m,

where rho is Huber's function: NIS up to the filter's own bound b, and 2 sqrt(b NIS) - b beyond. g is what a faulty
reading could be, anything within w of the prediction, and e how often one is faulty. g knows nothing of the
configuration: a measurement outside the gate costs the same whatever the noises are, and far more than one that was
predicted, so that neither rejecting everything nor believing everything pays. What is counted is the same for all
configurations, that is what the configuration at the start compared; a measurement that another one does not compare
costs as much as a faulty one.

Where a log has the truth, its velocity and attitude can count as well (``truth_weight``): the same density of the
errors with the covariance of the estimates, every ``TRUTH_EVERY_NS``.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from deckfix.reference import Trajectory
from deckfix.replaying import facts, trajectory
from deckfix.sync import on_inertial_clock
from deckfix.tune_parameters import with_values
from estimation.config import Config, parse_config
from estimation.consistency import normalised_squared
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import EventBatch, Kind
from estimation.frames import Array, quat_conjugate, quat_log, quat_multiply
from estimation.intake import latencies_s
from estimation.outcome import Outcome
from estimation.output import Facts, Run, with_facts
from estimation.parameters import chi_square_bound

FAULTY = 1e-3
"""e: share of measurements that may be faulty."""
WIDTHS: dict[Kind, float] = {
    Kind.GPS_POSITION: 100.0,
    Kind.GPS_VELOCITY: 20.0,
    Kind.BAROMETER: 100.0,
    Kind.MAGNETOMETER: np.pi,
    Kind.ATTITUDE: np.pi,
    Kind.RANGEFINDER: 50.0,
    Kind.VISION: 10.0,
}
"""w: how far a faulty reading may be off [m, m/s, rad], in each of its components."""
TRUTH_EVERY_NS = 5_000_000_000
"""Errors of the estimate are correlated over seconds: nearer instants would count one error several times."""
PARTS = 200
"""Into so many parts of as many measurements a flight is divided, where it has as many."""
KEY_DTYPE = np.dtype([("stamp_ns", "i8"), ("sensor", "i2")])
"""What tells measurements of a flight apart."""


@dataclass(frozen=True, slots=True)
class Trial:
    """A flight and the values to try on it: ``base`` is the configuration at the start as TOML."""

    path: str
    base: str
    values: tuple[tuple[str, float], ...]
    engine: EngineName
    truth_weight: float


@dataclass(frozen=True, slots=True)
class SensorScore:
    """One sensor's share: measurements counted, mean NIS over degrees of freedom (of those compared), share rejected,
    log-likelihood."""

    kind: Kind
    count: int
    nis_over_dof: float
    rejected: float
    log_likelihood: float


@dataclass(frozen=True, slots=True)
class Score:
    """What a trial gave: the log-likelihood (truth included, weighted), that of short parts of the flight, one after
    the other, which add up to it, the truth's, and each sensor's."""

    log_likelihood: float
    parts: tuple[float, ...]
    truth: float | None
    sensors: dict[str, SensorScore]


@dataclass(frozen=True, slots=True)
class Refused:
    """Why a flight cannot be used."""

    reason: str


@dataclass(frozen=True, slots=True)
class _Flight:
    """A flight in the order of its content, and what is counted of it.

    ``keys`` (n,) ascending with ``kinds`` (n,), and ``background`` (n,), what each costs when it is faulty.
    """

    batch: EventBatch
    facts: Facts
    truth: Trajectory | None
    keys: NDArray[np.void]
    kinds: NDArray[np.int64]
    background: Array


def score(trial: Trial) -> Score | Refused:
    """Return the likelihood of a flight under some values; nothing is raised."""
    from logs.errors import LogError

    try:
        flight = _flight(trial.path, trial.base, trial.engine)
        if isinstance(flight, Refused):
            return flight
        config = with_values(_base(trial.base), trial.values)
        return _scored(
            _run(flight.batch, flight.facts, config, trial.engine), flight, config, trial.truth_weight
        )
    except LogError as error:
        return Refused(str(error))
    except OSError as error:
        return Refused(f"{trial.path}: {error.strerror or type(error).__name__}")


@lru_cache(maxsize=1)
def _base(text: str) -> Config:
    return parse_config(text, "the configuration to start from")


@lru_cache(maxsize=12)
def _flight(path: str, base: str, engine: EngineName) -> _Flight | Refused:
    """Return a flight as it is tried, kept by each worker for the next trial."""
    from logs.reader import open_flight

    opened = open_flight(Path(path))
    known = facts(opened)
    config = _base(base)
    mapped, _ = on_inertial_clock(opened.events())
    if not np.any(mapped.rows["kind"] == Kind.IMU):
        return Refused(
            f"{path}: holds no inertial samples (/imu); log the IMU, or import the file that has it"
        )
    # In the order of the content nothing is late, and the filter, which gives the same either way, need not go back.
    age = np.round(latencies_s(with_facts(config, known), known) * 1e9).astype(np.int64)[mapped.rows["kind"]]
    order = np.argsort(mapped.rows["stamp_ns"] - age, kind="stable")
    batch = EventBatch(mapped.rows[order], mapped.sensors, mapped.clocks)
    run = _run(batch, known, config, engine)
    if not len(run.t_ns):
        return Refused(f"{path}: the filter never starts: it waits for {run.missing}")
    compared = _compared(run)
    keys = np.unique(_keys(run, compared, batch.sensors))
    if not len(keys):
        return Refused(
            f"{path}: no measurement was compared with the estimate; nothing can be learned from it"
        )
    dof = np.zeros(len(keys), dtype=np.int64)
    dof[np.searchsorted(keys, _keys(run, compared, batch.sensors))] = compared["dof"]
    kinds = np.zeros(len(batch.sensors), dtype=np.int64)
    kinds[batch.rows["sensor"]] = batch.rows["kind"]
    of_key = kinds[keys["sensor"]]
    width = np.array([WIDTHS[Kind(int(k))] for k in of_key])
    background = np.log(FAULTY) - dof * np.log(2.0 * width)
    truth = trajectory(opened, "/truth/odometry", opened.clock_offsets_ns)
    return _Flight(batch, known, truth, keys, of_key, background)


def _run(batch: EventBatch, known: Facts, config: Config, engine: EngineName) -> Run:
    quiet = msgspec.structs.replace(config.filter, output_rate_hz=1.0)
    return LandingEstimator(msgspec.structs.replace(config, filter=quiet), engine, known).run(batch)


def _compared(run: Run) -> NDArray[np.void]:
    r = run.records
    found: NDArray[np.void] = r[(r["dof"] > 0) & np.isfinite(r["log_det"]) & np.isfinite(r["nis"])]
    return found


def _keys(run: Run, records: NDArray[np.void], sensors: Sequence[str]) -> NDArray[np.void]:
    """Return the keys of records, with the sensors' places in the batch and not in the run."""
    place = np.array([sensors.index(name) for name in run.sensors] or [0], dtype=np.int16)
    keys = np.zeros(len(records), dtype=KEY_DTYPE)
    keys["stamp_ns"], keys["sensor"] = records["stamp_ns"], place[records["sensor"]]
    return keys


def density(nis: Array, dof: NDArray[np.int64], log_det: Array, huber_sigma: float) -> Array:
    """Return log f of innovations (n,): Gaussian, with Huber's tails beyond ``huber_sigma``."""
    each = {int(m): chi_square_bound(huber_sigma, int(m)) for m in np.unique(dof)}
    b = np.array([each[int(m)] for m in dof])
    rho = np.where(nis <= b, nis, 2.0 * np.sqrt(b * np.maximum(nis, b)) - b)
    out: Array = -0.5 * (rho + log_det + dof * np.log(2.0 * np.pi))
    return out


def _scored(run: Run, flight: _Flight, config: Config, truth_weight: float) -> Score:
    value = flight.background.copy()
    compared = _compared(run)
    keys = _keys(run, compared, flight.batch.sensors)
    place = np.searchsorted(flight.keys, keys).clip(max=len(flight.keys) - 1)
    counted = flight.keys[place] == keys
    compared, place = compared[counted], place[counted]
    good = density(
        compared["nis"], compared["dof"].astype(np.int64), compared["log_det"], config.filter.huber_sigma
    )
    value[place] = np.logaddexp(np.log1p(-FAULTY) + good, flight.background[place])
    sensors = {}
    for number, name in enumerate(flight.batch.sensors):
        mine = flight.keys["sensor"] == number
        if mine.any():
            its = compared[flight.keys["sensor"][place] == number]
            ratio = float(np.mean(its["nis"] / its["dof"])) if len(its) else np.nan
            passed = int(np.count_nonzero(its["outcome"] <= Outcome.DOWNWEIGHTED))
            rejected = 1.0 - passed / int(np.count_nonzero(mine))
            kind = Kind(int(flight.kinds[mine][0]))
            count = int(np.count_nonzero(mine))
            sensors[name] = SensorScore(kind, count, ratio, rejected, float(value[mine].sum()))
    begins = np.unique(np.arange(PARTS) * len(value) // PARTS)
    parts, truth = np.add.reduceat(value, begins).tolist(), None
    if truth_weight > 0.0 and flight.truth is not None:
        truth = _truth(run, flight.truth, config.filter.huber_sigma)
        parts.append(truth_weight * truth)
    return Score(sum(parts), tuple(parts), truth, sensors)


def _truth(run: Run, truth: Trajectory, huber_sigma: float) -> float:
    """Return the log-likelihood of the errors of velocity and attitude, 6 at each instant."""
    if truth.velocity_mps is None or truth.quaternion is None or not len(run.t_ns):
        return 0.0
    number = run.t_ns // TRUTH_EVERY_NS
    first = np.flatnonzero(np.append(True, number[1:] != number[:-1]))
    t = run.t_ns[first]
    velocity = truth.velocity_mps.at(t) - run.velocity_mps[first]
    turned = [
        quat_log(quat_multiply(quat_conjugate(a), b))
        for a, b in zip(run.quaternion[first], truth.quaternion_at(t), strict=True)
    ]
    error = np.hstack([velocity, np.array(turned).reshape(-1, 3)])
    covariance = run.covariance[first, 3:9, 3:9]
    squared = normalised_squared(error, covariance)
    known = np.isfinite(squared)
    log_det = np.linalg.slogdet(covariance[known])[1]
    dof = np.full(int(known.sum()), 6)
    return float(density(squared[known], dof, log_det, huber_sigma).sum()) if known.any() else 0.0

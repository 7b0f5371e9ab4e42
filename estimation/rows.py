"""Columns that the engines read and write: events in the order of their content, and estimates that come out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.frames import Array
from estimation.state import NOMINAL_SIZE

Int = NDArray[np.int64]

PENDING = -1
"""Outcome of a measurement that has not been tried yet."""


@dataclass(slots=True)
class Rows:
    """Events as columns of equal length n.

    ``t_ns`` is the time of the content on the estimator's clock; ``id`` the order of arrival; ``late`` is 1 where
    the filter had already passed that time; ``stamp_ns`` and ``arrival_ns`` are the event's own, ``age_ns`` how far
    the inertial clock was past the content when it arrived. The engines write ``outcome``, ``reset`` (1 where a lock-out was
    resolved) and ``result`` (n, 8): NIS, dimension, innovation (3), its predicted sigma (3).
    """

    t_ns: Int
    kind: Int
    sensor: Int
    id: Int
    late: Int
    stamp_ns: Int
    arrival_ns: Int
    age_ns: Int
    value: Array
    own: Array
    outcome: Int
    reset: Int
    result: Array

    @classmethod
    def empty(cls, n: int) -> Rows:
        """Return n rows, not yet tried."""
        integers = [np.zeros(n, dtype=np.int64) for _ in range(8)]
        return cls(
            *integers,
            np.zeros((n, 6)),
            np.zeros((n, 6)),
            np.full(n, PENDING, dtype=np.int64),
            np.zeros(n, dtype=np.int64),
            np.zeros((n, 8)),
        )

    @property
    def columns(self) -> tuple[NDArray[np.generic], ...]:
        """All columns, in the order of the constructor."""
        return (
            self.t_ns, self.kind, self.sensor, self.id, self.late, self.stamp_ns, self.arrival_ns, self.age_ns,
            self.value, self.own, self.outcome, self.reset, self.result,
        )  # fmt: skip

    def take(self, index: slice | Int) -> Rows:
        """Return the rows of an index: views for a slice, copies for an array."""
        return Rows(*(c[index] for c in self.columns))  # type: ignore[arg-type]

    def write(self, start: int, other: Rows) -> None:
        """Copy other rows over those that begin at ``start``."""
        stop = start + len(other.t_ns)
        for mine, theirs in zip(self.columns, other.columns, strict=True):
            mine[start:stop] = theirs

    @staticmethod
    def concatenate(a: Rows, b: Rows) -> Rows:
        """Return the rows of a and then those of b."""
        pairs = zip(a.columns, b.columns, strict=True)
        return Rows(*(np.concatenate(pair) for pair in pairs))  # type: ignore[arg-type]


@dataclass(slots=True)
class Estimates:
    """Estimates as columns: time, nominal state (n, 40), sigma of the error state (n, k), and the covariance (n, 9, 9)
    of position, velocity and attitude error. ``count`` rows are filled."""

    t_ns: Int
    x: Array
    sigma: Array
    covariance: Array
    count: int = 0

    @classmethod
    def empty(cls, n: int, size: int) -> Estimates:
        """Return room for n estimates with an error state of ``size``."""
        return cls(np.zeros(n, dtype=np.int64), np.zeros((n, NOMINAL_SIZE)), np.zeros((n, size)), np.zeros((n, 9, 9)))

    def filled(self) -> Estimates:
        """Return copies of the rows that are filled."""
        c = self.count
        return Estimates(self.t_ns[:c].copy(), self.x[:c].copy(), self.sigma[:c].copy(), self.covariance[:c].copy(), c)

    @staticmethod
    def concatenate(parts: list[Estimates], size: int) -> Estimates:
        """Join filled estimates in their order."""
        if not parts:
            return Estimates.empty(0, size)
        t = np.concatenate([e.t_ns for e in parts])
        return Estimates(
            t,
            np.concatenate([e.x for e in parts]),
            np.concatenate([e.sigma for e in parts]),
            np.concatenate([e.covariance for e in parts]),
            len(t),
        )


@dataclass(slots=True)
class FilterState:
    """Everything that the next step depends on; copied, it is a checkpoint.

    ``clock`` holds the state's time, the last inertial sample's and the start's [ns]; ``imu`` that sample;
    ``scatter`` the vibration measure; ``lock`` the lock-out memory of each sensor.
    """

    clock: Int
    x: Array
    P: Array
    imu: Array
    scatter: Array
    lock: Array

    def copy(self) -> FilterState:
        """Return an independent copy."""
        return FilterState(
            self.clock.copy(), self.x.copy(), self.P.copy(), self.imu.copy(), self.scatter.copy(), self.lock.copy()
        )

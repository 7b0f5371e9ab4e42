"""Columns that the engines read and write: events in the order of their content, and estimates that come out."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.frames import Array
from estimation.state import NOMINAL_SIZE, PLATFORM_OFFSET, Layout

Int = NDArray[np.int64]

DECK_OUTPUTS = 8
"""Entries of ``estimation.deck.deck_output``."""

PENDING = -1
"""Outcome of a measurement that has not been tried yet."""


T_NS, KIND, SENSOR, ID, LATE, STAMP_NS, ARRIVAL_NS, AGE_NS, OUTCOME, RESET = range(10)
"""Columns of ``Rows.ints``."""
VALUE, OWN, RESULT, SEEN, LOG_DET, FLOATS = 0, 6, 12, 20, 38, 39
SEEN_LEVEL, SEEN_MOVED, SEEN_PLACE, SEEN_DOUBT, SEEN_CORRECTED = 6, 7, 10, 12, 15
"""Where in ``Rows.seen`` what belongs to a fix begins, behind what it shows."""
"""First columns in ``Rows.floats``, and their number."""
HEAVE_MODEL = 10
"""Kind of a row that is no measurement: from here on a chain of the platform's motion has the parameters in ``value``
and ``own`` (``estimation.deck.take_up``)."""


@dataclass(slots=True)
class Rows:
    """Events as rows of two matrices, ``ints`` (n, 10) and ``floats`` (n, 39), with a view for each column.

    ``t_ns`` is the time of the content on the estimator's clock; ``id`` the order of arrival; ``late`` is 1 where
    the filter had already passed that time; ``stamp_ns`` and ``arrival_ns`` are the event's own, ``age_ns`` how far
    the inertial clock was past the content when it arrived. ``value`` and ``own`` (n, 6) are the event's value and
    covariance. The engines write ``outcome``, ``reset`` (1 where a lock-out was resolved, 2 where the learned
    heave was let go) and ``result`` (n, 8):
    NIS, dimension, innovation (3), its predicted sigma (3), ``seen`` (n, 18): where a fix shows the deck
    (``estimation.deck.seen_place``), the level after it was fused, how far measurements had moved the vehicle north,
    east and down, the mean place after it [m], the variances of the vehicle's velocity before it and the summed squares
    of what measurements had changed it by [m^2/s^2], and ``log_det``: logarithm of the determinant of the innovation's
    covariance.
    """

    ints: Int
    floats: Array

    @classmethod
    def empty(cls, n: int) -> Rows:
        """Return n rows, not yet tried."""
        rows = cls(np.zeros((n, 10), dtype=np.int64), np.zeros((n, FLOATS)))
        rows.outcome[:] = PENDING
        return rows

    def __len__(self) -> int:
        """Return the number of rows."""
        return len(self.ints)

    @property
    def t_ns(self) -> Int:
        """Time of the content on the estimator's clock [ns]."""
        return self.ints[:, T_NS]

    @property
    def kind(self) -> Int:
        """``events.Kind``."""
        return self.ints[:, KIND]

    @property
    def sensor(self) -> Int:
        """Index of the sensor's name."""
        return self.ints[:, SENSOR]

    @property
    def id(self) -> Int:
        """Order of arrival."""
        return self.ints[:, ID]

    @property
    def late(self) -> Int:
        """1 where the filter had passed the content."""
        return self.ints[:, LATE]

    @property
    def stamp_ns(self) -> Int:
        """The event's own stamp."""
        return self.ints[:, STAMP_NS]

    @property
    def arrival_ns(self) -> Int:
        """The event's arrival."""
        return self.ints[:, ARRIVAL_NS]

    @property
    def age_ns(self) -> Int:
        """Age of the content at arrival."""
        return self.ints[:, AGE_NS]

    @property
    def outcome(self) -> Int:
        """``Outcome`` or ``PENDING``."""
        return self.ints[:, OUTCOME]

    @property
    def reset(self) -> Int:
        """1 where a lock-out was resolved, 2 where the learned heave was let go."""
        return self.ints[:, RESET]

    @property
    def value(self) -> Array:
        """The event's value, (n, 6)."""
        return self.floats[:, VALUE:OWN]

    @property
    def own(self) -> Array:
        """The event's covariance, (n, 6)."""
        return self.floats[:, OWN:RESULT]

    @property
    def result(self) -> Array:
        """NIS, dimension, innovation (3), sigma (3)."""
        return self.floats[:, RESULT:SEEN]

    @property
    def seen(self) -> Array:
        """Height, north and east of the deck as a fix shows it [m], each with its variance; the level after it; how far
        measurements had moved the vehicle north, east and down; the mean place after it; the variance of the vehicle's
        velocity, and the sum of squares of what measurements had added to it, north, east and down. (n, 18)
        """
        return self.floats[:, SEEN:LOG_DET]

    @property
    def log_det(self) -> Array:
        """Logarithm of the determinant of the innovation's covariance, before any weight."""
        return self.floats[:, LOG_DET]

    def take(self, index: slice | Int) -> Rows:
        """Return the rows of an index: views for a slice, copies for an array."""
        return Rows(self.ints[index], self.floats[index])

    def copy(self) -> Rows:
        """Return an independent copy."""
        return Rows(self.ints.copy(), self.floats.copy())

    def write(self, start: int, other: Rows) -> None:
        """Copy other rows over those that begin at ``start``."""
        self.ints[start : start + len(other)] = other.ints
        self.floats[start : start + len(other)] = other.floats

    def make_room(self, place: int, size: int) -> None:
        """Move the rows from ``place`` to ``size`` one further; there must be room behind them."""
        self.ints[place + 1 : size + 1] = self.ints[place:size].copy()
        self.floats[place + 1 : size + 1] = self.floats[place:size].copy()

    @staticmethod
    def concatenate(a: Rows, b: Rows) -> Rows:
        """Return the rows of a and then those of b."""
        return Rows(np.concatenate((a.ints, b.ints)), np.concatenate((a.floats, b.floats)))


@dataclass(slots=True)
class Estimates:
    """Estimates as columns, of which ``count`` rows are filled.

    Time, nominal state (n, NOMINAL_SIZE), sigma of the error state (n, k), covariance (n, 9, 9) of position, velocity
    and attitude error, and of the platform, where it is on, what ``deck_output`` gives (n, 8) with its covariance
    (n, 8, 8).
    """

    t_ns: Int
    x: Array
    sigma: Array
    covariance: Array
    deck: Array
    deck_covariance: Array
    count: int = 0

    @classmethod
    def empty(cls, n: int, layout: Layout) -> Estimates:
        """Return room for n estimates."""
        deck = DECK_OUTPUTS if layout.offsets[PLATFORM_OFFSET] >= 0 else 0
        return cls(
            np.zeros(n, dtype=np.int64),
            np.zeros((n, NOMINAL_SIZE)),
            np.zeros((n, layout.size)),
            np.zeros((n, 9, 9)),
            np.zeros((n, deck)),
            np.zeros((n, deck, deck)),
        )

    @property
    def columns(self) -> tuple[NDArray[Any], ...]:
        """All columns, in the order of the constructor."""
        return self.t_ns, self.x, self.sigma, self.covariance, self.deck, self.deck_covariance

    def filled(self) -> Estimates:
        """Return copies of the rows that are filled."""
        t, x, sigma, covariance, deck, deck_covariance = (c[: self.count].copy() for c in self.columns)
        return Estimates(t, x, sigma, covariance, deck, deck_covariance, self.count)

    @staticmethod
    def concatenate(parts: list[Estimates], layout: Layout) -> Estimates:
        """Join filled estimates in their order."""
        if not parts:
            return Estimates.empty(0, layout)
        joined = (np.concatenate(c) for c in zip(*(e.columns for e in parts), strict=True))
        t, x, sigma, covariance, deck, deck_covariance = joined
        return Estimates(t, x, sigma, covariance, deck, deck_covariance, len(t))


@dataclass(slots=True)
class FilterState:
    """Everything that the next step depends on; copied, it is a checkpoint.

    ``clock`` holds the state's time, the last inertial sample's and the start's [ns]; ``imu`` that sample; ``scatter``
    the vibration measure (2), the mean squared rotation, when a learned heave was last let go [s since the start] and
    what fixes seem to tell of the camera's age (2, ``estimation.camera_age``); ``memory`` what is remembered of each
    sensor; ``motion`` the parameters of the deck's motion (``estimation.deck``), ``moved`` (6,) how far measurements
    have moved the vehicle, NED [m], and the summed squares of what they have changed its velocity by [m^2/s^2].
    """

    clock: Int
    x: Array
    P: Array
    imu: Array
    scatter: Array
    memory: Array
    motion: Array
    moved: Array

    def copy(self) -> FilterState:
        """Return an independent copy."""
        return FilterState(
            self.clock.copy(),
            self.x.copy(),
            self.P.copy(),
            self.imu.copy(),
            self.scatter.copy(),
            self.memory.copy(),
            self.motion.copy(),
            self.moved.copy(),
        )

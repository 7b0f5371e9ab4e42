"""The deck a few seconds ahead of the estimate, from the filter's own states: its height and rate, its horizontal
velocity, and how well the vehicle's place relative to it will be known.

The heave block is linear, x' = f x + l w, so that what is known of it at a time h later is exact:
x(h) = F x, covariance F P F' + S - F S F' with F = exp(f h) and S the block's covariance in a sea without end. With
growing h the forecast goes over into what is known of the sea alone; it is never worse than that.
Horizontally the sway's blocks are of the same kind; the place is derived in docs/concepts.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimation.band import BAND_PARAMETERS, BAND_SIZE, band_matrix, band_stationary
from estimation.deck import DRIFT_SPEED, DRIFT_TIME_S, HEAVE, SWAY_EAST, SWAY_NORTH
from estimation.frames import Array
from estimation.state import (
    PD0,
    PH0,
    PLATFORM_DRIFT,
    PLATFORM_HEAVE,
    PLATFORM_OFFSET,
    PLATFORM_SWAY,
    POSITION,
    PS0,
    VELOCITY,
    Offsets,
)


@dataclass(frozen=True, slots=True)
class DeckForecast:
    """The deck's height about its level and its rate, up, at the times ``horizon_s`` (m,) after ``t_ns``.

    ``height_m``, ``height_sigma_m``, ``rate_mps``, ``rate_sigma_mps`` (m,); ``skill`` (m,) is 1 - variance of the
    rate over that of the sea: 1 is certain, 0 knows nothing but the sea. ``sea_rate_sigma_mps`` is the rate's 1-sigma
    in that sea, ``learned`` tells whether the sea was learned in flight (else it is the configuration's prior).
    ``velocity_mps`` (m, 2) is the deck's horizontal velocity, north and east, of the place's drift and of the sway.
    ``apart_covariance_m2`` (m, 2, 2) is that of the vehicle's place relative to the target, north and east, when
    nothing more is seen until then: a vehicle that follows what is foreseen will be off by so much.
    """

    t_ns: int
    horizon_s: Array
    height_m: Array
    height_sigma_m: Array
    rate_mps: Array
    rate_sigma_mps: Array
    skill: Array
    sea_rate_sigma_mps: float
    learned: bool
    velocity_mps: Array
    apart_covariance_m2: Array

    def rate_at(self, horizon_s: float) -> tuple[float, float]:
        """Return the rate and its 1-sigma [m/s] at a horizon, interpolated, and held beyond the ends."""
        rate = float(np.interp(horizon_s, self.horizon_s, self.rate_mps))
        return rate, float(np.interp(horizon_s, self.horizon_s, self.rate_sigma_mps))

    def rise_m(self, horizon_s: float) -> float:
        """Return how far [m] the deck will have come up at a horizon since the first of them, interpolated."""
        return float(np.interp(horizon_s, self.horizon_s, self.height_m) - self.height_m[0])

    def velocity_at(self, horizon_s: float) -> Array:
        """Return the deck's horizontal velocity (2,) [m/s] at a horizon, interpolated, and held beyond the ends."""
        return np.array([np.interp(horizon_s, self.horizon_s, axis) for axis in self.velocity_mps.T])

    def apart_at(self, horizon_s: float) -> Array:
        """Return the covariance (2, 2) [m^2] of the relative place at a horizon, interpolated, held beyond the ends."""
        flat = self.apart_covariance_m2.reshape(-1, 4)
        return np.array([np.interp(horizon_s, self.horizon_s, entry) for entry in flat.T]).reshape(2, 2)

    def quiet_probability(self, begin_s: float, end_s: float, rate_limit_mps: float) -> float:
        """Return the smallest probability, over the horizons from begin to end, that |rate| is below the limit.

        It bounds from above the probability that the deck is quiet throughout, and is close to it for a window that is
        short against the waves' period. 0 where no horizon lies in the window.
        """
        inside = (self.horizon_s >= begin_s) & (self.horizon_s <= end_s)
        quiet = [
            _between(-rate_limit_mps, rate_limit_mps, float(m), float(s))
            for m, s in zip(self.rate_mps[inside], self.rate_sigma_mps[inside], strict=True)
        ]
        return min(quiet, default=0.0)


@dataclass(slots=True)
class DeckForecaster:
    """Forecasts at fixed horizons; keeps the transitions of the last heave parameters, which change rarely."""

    horizon_s: Array
    _parameters: Array | None = None
    _rows: Array | None = None
    _spread: Array | None = None
    _sea: Array | None = None
    _sway: Array | None = None
    _ways: Array | None = None
    _unseen: Array | None = None

    @classmethod
    def at(cls, horizon_s: ArrayLike) -> DeckForecaster:
        """Return a forecaster for these horizons (m,) [s], ascending from 0 or later.

        Raises ``ValueError`` for horizons that are not.
        """
        h = np.asarray(horizon_s, dtype=np.float64)
        if h.ndim != 1 or not len(h) or not np.all(np.isfinite(h)) or h[0] < 0.0 or np.any(np.diff(h) <= 0.0):
            raise ValueError("horizon_s: must be a list of ascending seconds, from 0 or later")
        return cls(h)

    def forecast(
        self, t_ns: int, x: Array, P: Array, motion: Array, learned: bool, offsets: Offsets
    ) -> DeckForecast:
        """Return the forecast from the nominal state (NOMINAL_SIZE,), its error's covariance (n, n), the motion's
        parameters (22,) and the offsets of the blocks at ``t_ns``; the platform's blocks must be among them.
        """
        if self._parameters is None or not np.array_equal(motion, self._parameters):
            self._prepare(motion)
            self._parameters = motion.copy()
        assert self._rows is not None and self._spread is not None and self._sea is not None
        assert self._sway is not None
        start = offsets[PLATFORM_HEAVE]
        block = slice(start, start + BAND_SIZE)
        mean = self._rows @ x[PH0 : PH0 + BAND_SIZE]
        variance = np.einsum("mki,ij,mkj->mk", self._rows, P[block, block], self._rows) + self._spread
        # What is known of the sea alone bounds the doubt.
        variance = np.clip(variance, 0.0, self._sea)
        with np.errstate(invalid="ignore", divide="ignore"):
            skill = np.where(self._sea[1] > 0.0, 1.0 - variance[:, 1] / self._sea[1], 0.0)
        sigma = np.sqrt(variance)
        swing = np.einsum("mak,ak->ma", self._sway, x[PS0 : PS0 + 2 * BAND_SIZE].reshape(2, BAND_SIZE))
        remains = np.exp(-self.horizon_s / DRIFT_TIME_S)
        velocity = swing + remains[:, None] * x[PD0 : PD0 + 2]
        return DeckForecast(
            t_ns, self.horizon_s, mean[:, 0], sigma[:, 0], mean[:, 1], sigma[:, 1], skill,
            math.sqrt(self._sea[1]), learned, velocity, self._apart(P, offsets),
        )  # fmt: skip

    def _apart(self, P: Array, offsets: Offsets) -> Array:
        """Return the covariance (m, 2, 2) of the relative place at the horizons without a measurement until then.

        Of what is known now, that place is p + h v - o - T (1 - exp(-h / T)) d - e' F s: the vehicle's place and
        velocity, the deck's mean place, its drift and the states of its sway. The sway adds the part of its spectrum
        that it has not shown yet, the drift its noise; that of the inertial sensors is far smaller.
        """
        assert self._ways is not None and self._unseen is not None
        places = [
            place
            for axis in range(2)
            for place in (
                offsets[POSITION] + axis, offsets[VELOCITY] + axis, offsets[PLATFORM_OFFSET] + axis,
                offsets[PLATFORM_DRIFT] + axis, *(offsets[PLATFORM_SWAY] + axis * BAND_SIZE + np.arange(BAND_SIZE)),
            )
        ]  # fmt: skip
        covariance: Array = self._ways @ P[np.ix_(places, places)] @ self._ways.transpose(0, 2, 1)
        covariance[:, [0, 1], [0, 1]] += self._unseen
        return covariance

    def _prepare(self, motion: Array) -> None:
        """Fill rows (m, 2, 6) of height and rate, their own spread (m, 2) and the sea's variances (2,); the rows
        (m, 2, 6) of the sway's velocity; and those (m, 2, 20) of the relative place, whose columns are for each axis
        the vehicle's place and velocity, the deck's mean place, its drift and its sway, with the variance (m, 2) that
        sway and drift add.
        """
        from scipy.linalg import expm

        heave = motion[HEAVE : HEAVE + BAND_PARAMETERS]
        f, S = band_matrix(heave), band_stationary(heave)
        seen = np.zeros((2, BAND_SIZE))
        seen[0, 5] = 1.0
        seen[1] = f[5]
        self._rows = np.stack([seen @ expm(f * h) for h in self.horizon_s])
        self._sea = np.einsum("ki,ij,kj->k", seen, S, seen)
        self._spread = self._sea - np.einsum("mki,ij,mkj->mk", self._rows, S, self._rows)
        bands = [motion[c : c + BAND_PARAMETERS] for c in (SWAY_NORTH, SWAY_EAST)]
        chains = [band_matrix(band) for band in bands]
        places = np.stack([[expm(g * h)[5] for g in chains] for h in self.horizon_s])
        self._sway = np.stack([places[:, k] @ g for k, g in enumerate(chains)], axis=1)
        h, carries = self.horizon_s, DRIFT_TIME_S * (1.0 - np.exp(-self.horizon_s / DRIFT_TIME_S))
        ways = np.zeros((len(h), 2, 2, 4 + BAND_SIZE))
        for k in range(2):
            ways[:, k, k, :4] = np.stack([np.ones_like(h), h, -np.ones_like(h), -carries], axis=1)
            ways[:, k, k, 4:] = -places[:, k]
        self._ways = ways.reshape(len(h), 2, -1)
        sways = np.stack([band_stationary(band) for band in bands])
        self._unseen = sways[:, 5, 5] - np.einsum("mki,kij,mkj->mk", places, sways, places)
        # An integrated first-order Gauss-Markov process.
        time, remains = self.horizon_s / DRIFT_TIME_S, np.exp(-self.horizon_s / DRIFT_TIME_S)
        drift = (motion[DRIFT_SPEED] * DRIFT_TIME_S) ** 2 * (2.0 * time - 3.0 + 4.0 * remains - remains**2)
        self._unseen = np.maximum(self._unseen + drift[:, None], 0.0)


def _between(low: float, high: float, mean: float, sigma: float) -> float:
    """Return the probability that a Gaussian lies between two limits."""
    if sigma <= 0.0:
        return float(low < mean < high)
    scale = 1.0 / (sigma * math.sqrt(2.0))
    return 0.5 * (math.erf((high - mean) * scale) - math.erf((low - mean) * scale))

"""The deck a few seconds ahead of the estimate, from the filter's own heave states.

The heave block is linear, x' = f x + l w, so that what is known of it at a time h later is exact:
x(h) = F x, covariance F P F' + S - F S F' with F = exp(f h) and S the block's covariance in a sea without end. With
growing h the forecast goes over into what is known of the sea alone; it is never worse than that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from estimation.band import BAND_PARAMETERS, BAND_SIZE, band_matrix, band_stationary
from estimation.deck import DRIFT_TIME_S, HEAVE, SWAY_EAST, SWAY_NORTH
from estimation.frames import Array


@dataclass(frozen=True, slots=True)
class DeckForecast:
    """The deck's height about its level and its rate, up, at the times ``horizon_s`` (m,) after ``t_ns``.

    ``height_m``, ``height_sigma_m``, ``rate_mps``, ``rate_sigma_mps`` (m,); ``skill`` (m,) is 1 - variance of the
    rate over that of the sea: 1 is certain, 0 knows nothing but the sea. ``sea_rate_sigma_mps`` is the rate's 1-sigma
    in that sea, ``learned`` tells whether the sea was learned in flight (else it is the configuration's prior).
    ``velocity_mps`` (m, 2) is the deck's horizontal velocity, north and east, of the place's drift and of the sway.
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

    def rate_at(self, horizon_s: float) -> tuple[float, float]:
        """Return the rate and its 1-sigma [m/s] at a horizon, interpolated, and held beyond the ends."""
        rate = float(np.interp(horizon_s, self.horizon_s, self.rate_mps))
        return rate, float(np.interp(horizon_s, self.horizon_s, self.rate_sigma_mps))

    def velocity_at(self, horizon_s: float) -> Array:
        """Return the deck's horizontal velocity (2,) [m/s] at a horizon, interpolated, and held beyond the ends."""
        return np.array([np.interp(horizon_s, self.horizon_s, axis) for axis in self.velocity_mps.T])

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
        self,
        t_ns: int,
        heave: Array,
        P: Array,
        motion: Array,
        learned: bool,
        sway: Array,
        drift: Array,
    ) -> DeckForecast:
        """Return the forecast from the heave states (6,), their covariance (6, 6), the states of the sway (12,), the
        drift's velocity (2,) and the motion's parameters (22,) at ``t_ns``.
        """
        if self._parameters is None or not np.array_equal(motion, self._parameters):
            self._prepare(motion)
            self._parameters = motion.copy()
        assert self._rows is not None and self._spread is not None and self._sea is not None
        assert self._sway is not None
        mean = self._rows @ heave
        variance = np.einsum("mki,ij,mkj->mk", self._rows, P, self._rows) + self._spread
        # What is known of the sea alone bounds the doubt.
        variance = np.clip(variance, 0.0, self._sea)
        with np.errstate(invalid="ignore", divide="ignore"):
            skill = np.where(self._sea[1] > 0.0, 1.0 - variance[:, 1] / self._sea[1], 0.0)
        sigma = np.sqrt(variance)
        swing = np.einsum("mak,ak->ma", self._sway, sway.reshape(2, BAND_SIZE))
        remains = np.exp(-self.horizon_s / DRIFT_TIME_S)
        return DeckForecast(
            t_ns, self.horizon_s, mean[:, 0], sigma[:, 0], mean[:, 1], sigma[:, 1], skill,
            math.sqrt(self._sea[1]), learned, swing + remains[:, None] * drift,
        )  # fmt: skip

    def _prepare(self, motion: Array) -> None:
        """Fill rows (m, 2, 6) of height and rate, their own spread (m, 2) and the sea's variances (2,); and the rows
        (m, 2, 6) of the sway's velocity north and east.
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
        chains = [band_matrix(motion[c : c + BAND_PARAMETERS]) for c in (SWAY_NORTH, SWAY_EAST)]
        self._sway = np.stack([[g[5] @ expm(g * h) for g in chains] for h in self.horizon_s])


def _between(low: float, high: float, mean: float, sigma: float) -> float:
    """Return the probability that a Gaussian lies between two limits."""
    if sigma <= 0.0:
        return float(low < mean < high)
    scale = 1.0 / (sigma * math.sqrt(2.0))
    return 0.5 * (math.erf((high - mean) * scale) - math.erf((low - mean) * scale))

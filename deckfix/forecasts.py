"""The heave forecasts of a flight, and how they compare with what then happened.

Each heave model forecasts from its last fix on. All arrays have one row for each model and one column for each
horizon; heave and rate are positive up, heights count from the origin of the estimates.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deckfix.reference import Column
from estimation.heave.model import HeaveModel

Array = NDArray[np.float64]
Times = NDArray[np.int64]

HORIZONS_S = (0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0)
"""Horizons that are written, shown and judged [s]."""
QUIET_RATE_MPS = 0.3
QUIET_S = 1.0
"""A quiescent window: the deck's rate stays below so much for so long."""
WIDTH_95 = 1.959964
"""Half width of the 95 % interval in standard deviations."""
FEWEST = 5
"""Fewer forecasts than these are not judged."""


@dataclass(frozen=True, slots=True)
class Forecasts:
    """Forecasts of n models at h horizons.

    ``origin_ns`` (n,) is the time of each model's last fix; ``level_m`` (n,) its level there. ``sigma_m`` and
    ``rate_sigma_mps`` (n, h) are infinite where nothing is known. ``fallback`` marks where the level was given in
    place of a forecast; ``window_probability`` that of a quiescent window that begins at the horizon.
    """

    origin_ns: Times
    horizon_s: Array
    level_m: Array
    heave_m: Array
    sigma_m: Array
    rate_mps: Array
    rate_sigma_mps: Array
    skill: Array
    fallback: NDArray[np.bool_]
    window_probability: Array

    def __len__(self) -> int:
        """Return the number of models."""
        return len(self.origin_ns)


@dataclass(frozen=True, slots=True)
class Scores:
    """Forecasts against what happened, by horizon (h,).

    ``against`` is ``truth`` or ``estimate`` (the filter's own later estimate). ``rmse_m`` of the forecast and
    ``level_rmse_m`` of the level alone, over ``count`` forecasts; ``coverage_95`` is the share inside the stated
    95 % interval; NaN where fewer than ``FEWEST`` could be judged.
    """

    against: str
    horizon_s: Array
    count: Times
    rmse_m: Array
    level_rmse_m: Array
    coverage_95: Array

    def block(self) -> dict[str, object]:
        """Return the scores as ``replay --json`` writes them; horizons that could not be judged are left out."""
        return {
            "against": self.against,
            "horizons": {
                f"{h:g}": {
                    "count": int(self.count[k]),
                    "rmse_m": float(self.rmse_m[k]),
                    "level_rmse_m": float(self.level_rmse_m[k]),
                    "coverage_95": float(self.coverage_95[k]),
                }
                for k, h in enumerate(self.horizon_s)
                if self.count[k] >= FEWEST
            },
        }


def origin_ns(due_ns: int, model: HeaveModel) -> int:
    """Return when a model's t = 0 was, of a model that counts its series' time from ``due_ns``."""
    return due_ns + round(model.last_s * 1e9)


def forecasts(models: Sequence[tuple[int, HeaveModel]], horizon_s: Sequence[float] = HORIZONS_S) -> Forecasts:
    """Return the forecasts of models, each given with the time that its series counts from."""
    h = np.asarray(horizon_s, np.float64)
    told = [model.predict(h) for _, model in models]
    window = [
        [model.quiescent(float(a), QUIET_S, rate_limit_mps=QUIET_RATE_MPS) for a in h] for _, model in models
    ]

    def rows(values: list[Array]) -> Array:
        return np.array(values, np.float64).reshape(len(models), len(h))

    return Forecasts(
        np.array([origin_ns(due, model) for due, model in models], np.int64),
        h,
        np.array([model.level_m for _, model in models], np.float64),
        rows([t.mean_m for t in told]),
        rows([np.sqrt(t.variance_m2) for t in told]),
        rows([t.rate_mps for t in told]),
        rows([np.sqrt(t.rate_variance_m2ps2) for t in told]),
        rows([t.skill for t in told]),
        np.array([t.fallback for t in told], np.bool_).reshape(len(models), len(h)),
        rows([np.array(w) for w in window]),
    )


def judge(made: Forecasts, happened: Column, against: str) -> Scores:
    """Return how the forecasts compare with the height (up) that was seen later, ``happened.values`` (m, 1)."""
    n, h = made.heave_m.shape
    times = made.origin_ns[:, None] + np.round(made.horizon_s * 1e9).astype(np.int64)
    seen = happened.at(times.ravel())[:, 0].reshape(n, h)
    known = np.isfinite(seen) & np.isfinite(made.sigma_m)
    count = known.sum(axis=0)
    error, level = made.heave_m - seen, made.level_m[:, None] - seen
    with np.errstate(invalid="ignore"):
        inside = np.abs(error) <= WIDTH_95 * made.sigma_m

    def mean(values: Array) -> Array:
        total = np.where(known, values, 0.0).sum(axis=0)
        return np.where(count >= FEWEST, total / np.maximum(count, 1), np.nan)

    return Scores(
        against,
        made.horizon_s,
        count,
        np.sqrt(mean(error**2)),
        np.sqrt(mean(level**2)),
        mean(inside.astype(np.float64)),
    )

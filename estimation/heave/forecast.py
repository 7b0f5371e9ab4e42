"""Forecasts of heave and its rate from Gaussian coefficients: joint moments, guard, skill, quiet windows."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.heave.basis import Basis

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Coefficients:
    """Gaussian coefficients of a basis, and what the motion is without them.

    ``offset_m`` is added to every value; ``misfit_m2`` is variance that the basis does not explain;
    ``variance_m2`` and ``rate_variance_m2ps2`` are those of the motion about its level: what is left to say
    beyond ``horizon_s``. ``level`` marks the columns that are level and drift.
    """

    basis: Basis
    mean: Array
    covariance: Array
    offset_m: float
    variance_m2: float
    rate_variance_m2ps2: float
    horizon_s: float
    misfit_m2: float = 0.0

    @property
    def level(self) -> NDArray[np.bool_]:
        """Columns of level and drift (k,)."""
        mask = np.zeros(self.basis.size, np.bool_)
        mask[2 * len(self.basis.frequency_hz) :] = True
        return mask


@dataclass(frozen=True, slots=True)
class Forecast:
    """Heave and its rate at some horizons, with what is said in place of a forecast that knows nothing.

    All arrays have the shape of ``horizon_s``. ``fallback`` is True where the forecast was no better than the
    mean predictor and the level was given instead, with the variance of the motion about it.
    """

    horizon_s: Array
    mean_m: Array
    variance_m2: Array
    rate_mps: Array
    rate_variance_m2ps2: Array
    skill: Array
    fallback: NDArray[np.bool_]


def forecast(model: Coefficients, horizon_s: ArrayLike) -> Forecast:
    """Mean and variance at ``horizon_s`` [s] after the last sample (scalar or any shape; negative: the past).

    A forecast is published only where its variance is below that of the mean predictor (level and drift
    alone, the motion about them unknown); elsewhere, and beyond ``model.horizon_s``, that predictor is. Heave
    and rate are judged each for itself; ``fallback`` and ``skill`` = 1 - variance / mean predictor's are
    heave's.
    """
    horizon = np.asarray(horizon_s, np.float64)
    if not np.all(np.isfinite(horizon)):
        raise ValueError("horizon_s: must be finite seconds after the last sample")
    flat = np.atleast_1d(horizon).ravel()
    known = flat <= model.horizon_s
    values, rates = model.basis.values(flat), model.basis.rates(flat)
    mean, variance, only_mean, only_variance = _moments(model, values, model.variance_m2)
    variance = variance + model.misfit_m2
    useful = known & (variance < only_variance)
    rate, rate_variance, only_rate, only_rate_variance = _moments(model, rates, model.rate_variance_m2ps2)
    rate_useful = known & (rate_variance < only_rate_variance)
    with np.errstate(invalid="ignore"):
        skill = np.where(useful & (only_variance > 0), 1.0 - variance / np.maximum(only_variance, 1e-30), 0.0)

    def shaped(values: Array) -> Array:
        return values.reshape(horizon.shape)

    return Forecast(
        horizon,
        shaped(model.offset_m + np.where(useful, mean, only_mean)),
        shaped(np.where(useful, variance, only_variance)),
        shaped(np.where(rate_useful, rate, only_rate)),
        shaped(np.where(rate_useful, rate_variance, only_rate_variance)),
        shaped(skill),
        (~useful).reshape(horizon.shape),
    )


def joint(model: Coefficients, horizon_s: ArrayLike) -> tuple[Array, Array]:
    """Joint moments at ``horizon_s`` (n,): mean (2n,) of n heaves [m] then n rates [m/s], covariance (2n,
    2n).

    Beyond ``model.horizon_s`` the motion about the level is unknown: variances are then those of the motion,
    and the covariance with other times is that of level and drift.
    """
    flat = np.atleast_1d(np.asarray(horizon_s, np.float64))
    columns = np.vstack([model.basis.values(flat), model.basis.rates(flat)])
    far = np.tile(flat > model.horizon_s, 2)
    columns[np.ix_(far, ~model.level)] = 0.0
    mean: Array = columns @ model.mean
    mean[: len(flat)] += model.offset_m
    covariance: Array = columns @ model.covariance @ columns.T
    n = len(flat)
    extra = np.where(far, np.repeat([model.variance_m2, model.rate_variance_m2ps2], n), 0.0)
    extra[:n] += np.where(far[:n], 0.0, model.misfit_m2)
    covariance[np.diag_indices_from(covariance)] += extra
    return mean, 0.5 * (covariance + covariance.T)


def quiescent(
    model: Coefficients,
    start_s: float,
    duration_s: float,
    rate_limit_mps: float,
    height_band_m: float | None,
    samples: int,
    rng: np.random.Generator,
) -> float:
    """Probability that the deck stays quiet from ``start_s`` for ``duration_s``.

    Quiet is: |rate| below ``rate_limit_mps`` all the time and, where ``height_band_m`` is given, the heave
    within so much of the level. Counted over draws of the joint forecast at steps of 0.1 s or less.
    """
    count = max(2, int(np.ceil(duration_s / 0.1)) + 1)
    times = start_s + np.linspace(0.0, duration_s, count)
    mean, covariance = joint(model, times)
    columns = model.basis.values(times)
    level = columns[:, model.level] @ model.mean[model.level] + model.offset_m
    values, vectors = np.linalg.eigh(covariance)
    root = vectors * np.sqrt(np.maximum(values, 0.0))
    drawn = mean + rng.standard_normal((samples, len(mean))) @ root.T
    quiet = np.all(np.abs(drawn[:, count:]) < rate_limit_mps, axis=1)
    if height_band_m is not None:
        quiet &= np.all(np.abs(drawn[:, :count] - level) < height_band_m, axis=1)
    return float(np.mean(quiet))


def _moments(model: Coefficients, columns: Array, motion: float) -> tuple[Array, Array, Array, Array]:
    """Mean and variance of the whole, and of level and drift alone with the motion unknown."""
    mean = columns @ model.mean
    variance = np.einsum("ij,ij->i", columns @ model.covariance, columns)
    slow = columns[:, model.level]
    part = model.covariance[np.ix_(model.level, model.level)]
    slow_variance = np.einsum("ij,ij->i", slow @ part, slow)
    return mean, np.maximum(variance, 0.0), slow @ model.mean[model.level], slow_variance + motion

"""The series that a heave model is fitted to: checked, cut to the window, averaged in short bins."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

WINDOW_S = 120.0
BIN_S = 0.125
SMALLEST_NOISE = 1e-5
"""Smallest sigma of a bin over the range of the series, or 1 m where that is less: below it the arithmetic has no
digits left."""


@dataclass(frozen=True, slots=True)
class Window:
    """Binned samples, times counted from the last sample: ``time_s`` (n,) <= 0, oldest first.

    ``value_m`` (n,) has the weighted mean ``offset_m`` removed; ``variance_m2`` (n,) is each bin's noise.
    ``samples`` counts the finite samples used, ``dropped`` those that were not finite.
    """

    time_s: Array
    value_m: Array
    variance_m2: Array
    offset_m: float
    span_s: float
    interval_s: float
    samples: int
    dropped: int
    last_s: float

    @property
    def noise_density_m2ps(self) -> float:
        """One-sided density of the measurement noise [m^2/Hz]."""
        return 2.0 * max(self.span_s, self.interval_s) / float(np.sum(1.0 / self.variance_m2))

    @property
    def signal_variance_m2(self) -> float:
        """Variance of the samples less that of their noise, not below zero [m^2]."""
        weight = 1.0 / self.variance_m2
        scatter = float(np.sum(weight * self.value_m**2) / np.sum(weight))
        return max(0.0, scatter - len(weight) / float(np.sum(weight)))


def cut_window(
    t_s: ArrayLike,
    heave_m: ArrayLike,
    sigma_m: ArrayLike,
    *,
    window_s: float = WINDOW_S,
    bin_s: float = BIN_S,
) -> Window:
    """Check a series and average it in bins of ``bin_s``, weighted by its variances.

    ``t_s`` (n,) times [s], oldest first, irregular and with gaps as they come; ``heave_m`` (n,) [m], up;
    ``sigma_m`` scalar or (n,) 1 sigma [m]. Samples that are not finite are left out and counted; those older
    than ``window_s`` before the last are left out. Raises ValueError naming the argument that cannot be used.
    """
    t, value = np.asarray(t_s, np.float64), np.asarray(heave_m, np.float64)
    sigma = np.asarray(sigma_m, np.float64)
    if t.ndim != 1 or t.shape != value.shape:
        raise ValueError(
            f"heave_m: shape {value.shape} does not fit t_s of shape {t.shape}; both must be (n,)"
        )
    if sigma.ndim and sigma.shape != t.shape:
        raise ValueError(f"sigma_m: shape {sigma.shape} is neither scalar nor that of t_s {t.shape}")
    if not window_s > 0 or not bin_s >= 0:
        raise ValueError("window_s must be positive and bin_s not negative")
    sigma = np.broadcast_to(sigma, t.shape)
    finite = np.isfinite(t) & np.isfinite(value) & np.isfinite(sigma)
    if not finite.any():
        raise ValueError("heave_m: no finite sample; give at least one with a finite time and sigma_m")
    t, value, sigma = t[finite], value[finite], sigma[finite]
    if np.any(sigma <= 0):
        raise ValueError("sigma_m: must be positive; give the 1 sigma of each sample in metres")
    if np.any(np.diff(t) < 0):
        k = int(np.argmax(np.diff(t) < 0)) + 1
        raise ValueError(
            f"t_s: must be oldest first, but sample {k} is earlier than the one before it; sort it"
        )
    dropped, last = int(len(finite) - len(t)), float(t[-1])
    t = t - last
    recent = t >= -window_s
    t, value, variance = t[recent], value[recent], sigma[recent] ** 2
    span = float(-t[0])
    steps = np.diff(t)
    interval = float(np.median(steps[steps > 0])) if np.any(steps > 0) else 0.0
    samples = len(t)
    if bin_s > 0:
        t, value, variance = _average(t, value, variance, bin_s)
    variance = np.maximum(variance, SMALLEST_NOISE**2 * max(1.0, float(np.ptp(value))) ** 2)
    weight = 1.0 / variance
    offset = float(np.sum(weight * value) / np.sum(weight))
    return Window(t, value - offset, variance, offset, span, max(interval, bin_s), samples, dropped, last)


def _average(t: Array, value: Array, variance: Array, bin_s: float) -> tuple[Array, Array, Array]:
    """Weighted means of times and values in bins that end at the last sample."""
    _, index = np.unique(np.floor(t / bin_s + 1e-9), return_inverse=True)
    weight = np.bincount(index, 1.0 / variance)
    mean_t: Array = np.bincount(index, t / variance) / weight
    mean_value: Array = np.bincount(index, value / variance) / weight
    return mean_t, mean_value, 1.0 / weight

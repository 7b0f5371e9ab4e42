"""The plain form of the heave model: a sum of N sinusoids with free periods, by least squares.

This is equation (3.6) taken literally. It is the baseline: on an irregular sea it forecasts worse than the
mean level beyond a second, because amplitudes and phases are held fixed for ever. It is right for a deck that
really moves in a few sinusoids.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from estimation.heave.basis import Basis
from estimation.heave.forecast import Coefficients
from estimation.heave.series import Window

Array = NDArray[np.float64]


def fit_sinusoids(window: Window, count: int, lowest_hz: float, highest_hz: float) -> Coefficients:
    """Fit ``count`` sinusoids and a level by variable projection: periods searched, amplitudes solved.

    Sinusoids are added one by one at the peak of the residual's periodogram and all periods are then refined
    together. The misfit beyond the samples' noise is kept as ``misfit_m2``.
    """
    from scipy.optimize import least_squares

    weight = 1.0 / np.sqrt(window.variance_m2)
    data = weight * window.value_m
    top = min(highest_hz, 0.45 / window.interval_s)
    grid = np.arange(lowest_hz, top, 1.0 / (8.0 * max(window.span_s, 5.0)))

    def solve(frequency: Array) -> tuple[Array, Array]:
        columns = weight[:, None] * Basis(frequency).values(window.time_s)
        solution = np.asarray(np.linalg.lstsq(columns, data, rcond=1e-9)[0], np.float64)
        return columns, solution

    def residual(log_frequency: Array) -> Array:
        columns, solution = solve(np.exp(log_frequency))
        difference: Array = columns @ solution - data
        return difference

    wave = np.exp(-2j * np.pi * np.outer(grid, window.time_s))
    log_frequency = np.zeros(0)
    for _ in range(max(0, min(count, len(window.time_s) // 4))):
        left = -residual(log_frequency)
        best = float(grid[int(np.argmax(np.abs(wave @ (weight * left))))])
        start = np.append(log_frequency, math.log(best))
        bounds = (math.log(lowest_hz) - 1e-6, math.log(top) + 1e-6)
        log_frequency = least_squares(residual, start, bounds=bounds, max_nfev=20).x
    basis = Basis(np.exp(log_frequency))
    columns, solution = solve(basis.frequency_hz)
    freedom = max(1, len(data) - columns.shape[1] - len(log_frequency))
    excess = max(0.0, float(np.sum((data - columns @ solution) ** 2)) / freedom - 1.0)
    m, omega = len(log_frequency), 2.0 * np.pi * basis.frequency_hz
    power = 0.5 * (solution[:m] ** 2 + solution[m : 2 * m] ** 2)
    misfit = excess * float(np.mean(window.variance_m2))
    return Coefficients(
        basis,
        solution,
        np.linalg.pinv(columns.T @ columns, rcond=1e-12, hermitian=True) * (1.0 + excess),
        window.offset_m,
        window.signal_variance_m2,
        float(power @ omega**2),
        math.inf,
        misfit,
    )

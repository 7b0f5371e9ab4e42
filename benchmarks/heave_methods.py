"""Forecasts to compare with: the optimal one that knows the spectrum, and what others do."""

from __future__ import annotations

import numpy as np
from heave_series import HORIZONS_S, Observation
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from estimation import heave

Array = NDArray[np.float64]

LEVEL_VARIANCE = 25.0


def average(observation: Observation, bin_s: float) -> tuple[Array, Array, Array]:
    """Times, means and variances of the samples in bins that end at the last one."""
    index = np.floor(observation.time_s / bin_s + 1e-9).astype(np.int64)
    _, index = np.unique(index, return_inverse=True)
    count = np.bincount(index)
    time = np.bincount(index, observation.time_s) / count
    value = np.bincount(index, observation.heave_m) / count
    return time, value, observation.sigma_m**2 / count


def gaussian(
    time: Array, value: Array, variance: Array, lag: Array, covariance: Array
) -> tuple[Array, Array]:
    """Conditional mean and variance at the horizons, for a covariance tabled over evenly spaced lags."""

    def table(lags: Array) -> Array:
        return np.interp(np.abs(lags), lag, covariance) + LEVEL_VARIANCE

    factor = cho_factor(table(time[:, None] - time) + np.diag(variance))
    cross = table(HORIZONS_S[:, None] - time)
    mean = cross @ cho_solve(factor, value)
    spread = table(np.zeros(1)) - np.einsum("ij,ji->i", cross, cho_solve(factor, cross.T))
    return mean, spread


def optimal(observation: Observation) -> tuple[Array, Array]:
    """The limit: a Gaussian predictor that knows the spectrum and sees every sample."""
    lag = np.arange(0.0, -observation.time_s[0] + HORIZONS_S[-1] + 0.1, 0.02)
    spacing = float(observation.frequency_hz[1] - observation.frequency_hz[0])
    fine = np.arange(0.02, 1.4, min(spacing, 0.004))
    power = np.interp(fine, observation.frequency_hz, observation.density) * (fine[1] - fine[0])
    covariance = np.cos(2.0 * np.pi * np.outer(lag, fine)) @ power
    variance = np.full(len(observation.time_s), observation.sigma_m**2)
    return gaussian(observation.time_s, observation.heave_m, variance, lag, covariance)


def mean_level(observation: Observation) -> Array:
    return np.full(len(HORIZONS_S), observation.heave_m.mean())


def constant_velocity(observation: Observation) -> Array:
    """Kalman filter with white acceleration of 0.3 m/s^2 per root hertz, as precision-landing filters have it."""
    time, value, variance = average(observation, 0.05)
    x, p = np.array([value[0], 0.0]), np.diag([variance[0], 1.0])
    for k in range(1, len(time)):
        dt = time[k] - time[k - 1]
        f = np.array([[1.0, dt], [0.0, 1.0]])
        p = f @ p @ f.T + 0.09 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        x = f @ x
        gain = p[:, 0] / (p[0, 0] + variance[k])
        x, p = x + gain * (value[k] - x[0]), p - np.outer(gain, p[0])
    return np.asarray(x[0] + x[1] * HORIZONS_S, np.float64)


def peak_oscillators(observation: Observation, peaks: int = 5) -> Array:
    """Largest peaks of the FFT, each an oscillator whose amplitude wanders in 20 s; the observer's exact form."""
    time, value, variance = average(observation, 0.125)
    even = np.arange(time[0], 0.0, 0.125)
    level = value.mean()
    taper = np.hanning(len(even))
    line = np.abs(np.fft.rfft(taper * (np.interp(even, time, value) - level), 4 * len(even)))
    frequency = np.fft.rfftfreq(4 * len(even), 0.125)
    inner = (line[1:-1] > line[:-2]) & (line[1:-1] > line[2:]) & (frequency[1:-1] > 0.03)
    found = np.flatnonzero(inner) + 1
    found = found[np.argsort(line[found])[::-1][:peaks]]
    amplitude = 2.0 * line[found] / taper.sum()
    lag = np.arange(0.0, -time[0] + HORIZONS_S[-1] + 0.1, 0.02)
    power = 0.5 * amplitude**2
    covariance = np.exp(-lag / 20.0) * (np.cos(2.0 * np.pi * np.outer(lag, frequency[found])) @ power)
    return gaussian(time, value, variance, lag, covariance)[0]


def burg(series: Array, order: int) -> Array:
    """Coefficients a (order,) of x_k = sum a_i x_{k-i}, by Burg's recursion."""
    forward, backward = series[1:].copy(), series[:-1].copy()
    a = np.zeros(0)
    for _ in range(order):
        reflection = 2.0 * (forward @ backward) / (forward @ forward + backward @ backward)
        a = np.append(a - reflection * a[::-1], reflection)
        forward, backward = forward[1:] - reflection * backward[1:], (backward - reflection * forward)[:-1]
    return a


def autoregressive(observation: Observation) -> Array:
    """Mean of the forecasts of AR models of order 16, 24 and 32 at 4 Hz."""
    time, value, _ = average(observation, 0.25)
    even = np.arange(time[0], time[-1] + 1e-9, 0.25)[-int((time[-1] - time[0]) / 0.25) - 1 :]
    even = even + (time[-1] - even[-1])
    level = value.mean()
    series = np.interp(even, time, value) - level
    ahead = int(np.ceil((HORIZONS_S[-1] - time[-1]) / 0.25)) + 1
    total = np.zeros(len(HORIZONS_S))
    for order in (16, 24, 32):
        a, run = burg(series, order), list(series)
        for _ in range(ahead):
            run.append(float(a @ np.array(run[: -order - 1 : -1])))
        tail = run[-ahead - 1 :]
        total += np.interp(HORIZONS_S, time[-1] + 0.25 * np.arange(ahead + 1), tail)
    return np.asarray(level + total / 3.0, np.float64)


def band_pass(observation: Observation, model: heave.HeaveModel) -> Array:
    """The six-state block fitted to the learned spectrum, with a free level, as a filter would carry it."""
    block = model.band_pass()
    time, value, variance = average(observation, 0.125)
    step = 0.05
    lag = np.arange(0.0, -time[0] + HORIZONS_S[-1] + 0.1, step)
    phi, _ = block.discrete(step)
    state, covariance = block.stationary @ block.heave_row, np.empty(len(lag))
    for k in range(len(lag)):
        covariance[k] = block.heave_row @ state
        state = phi @ state
    return gaussian(time, value, variance, lag, covariance)[0]

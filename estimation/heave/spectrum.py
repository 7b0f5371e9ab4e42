"""Learning a smooth spectrum of the sea from a minute of noisy heave.

The series is a sum of harmonics on a dense frequency grid whose coefficients are Gaussian with variances s_j,
the spectrum, plus a level and a slow drift (Bayesian harmonic regression). The spectrum is

    s(f) = (floor + J_1(f) + J_2(f)) exp(sum_k c_k B_k(f)),

two JONSWAP-like peaks, each with its own peakedness and fall-off, times a smooth positive correction. All
parameters and the sizes of drift and noise are found together by maximising the exact marginal likelihood of
the samples, with its gradient, under priors that hold the correction near one and the peaks near the shape
of a wind sea on a small raft: the fewer the data, the closer the result stays to the parametric form. What
is left uncertain of the spectrum enters twice: its mean, not its mode, is taken, and the coefficients'
covariance is widened by the delta method.

A series may hang on something that wanders itself, as a deck's height does that is seen from a vehicle. The
density of that wander, where it is told, is noise of the same harmonics: K holds it, what is learned is the spectrum
beside it, and the coefficients are those of the motion alone.

The likelihood is evaluated in a compressed space: the samples are projected on the few hundred directions
that the band can excite within the window.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.heave.basis import Basis, dense_basis
from estimation.heave.series import Window

Array = NDArray[np.float64]
Density = Callable[[Array], Array]
"""One-sided density [m^2/Hz] of a noise that is not white, at frequencies (m,) [Hz]."""

PEAK_MEAN = np.array([0.0, 0.0, 0.8, 6.0])
PEAK_SIGMA = np.array([1e3, 1e3, 0.7, 2.0])
"""Prior of a peak: log power and log frequency free, log peakedness, power of the fall-off."""
PEAKS = 2


@dataclass(frozen=True, slots=True)
class SpectrumSettings:
    """How a spectrum is learned."""

    lowest_hz: float = 0.03
    lowest_cycles: float = 1.5
    """Motion with fewer cycles in the window than this is level and drift: that it comes back has not been seen, and a
    spectrum learned from it could be of any size."""
    highest_hz: float = 1.3
    horizon_s: float = 10.0
    """Longest forecast that the frequency grid must serve."""
    floor: float = 5e-4
    """Smallest power of a frequency, relative to the peak of the periodogram."""
    correction_sigma: float = 0.7
    """1 sigma of the log of the smooth correction, per bump."""
    bump_periods: float = 1.25
    """Width of a bump: sqrt((this / span)^2 + (bump_ratio f)^2)."""
    bump_ratio: float = 0.1
    level_sigma_m: float = 10.0
    drift_mps: float = 0.003
    """Median of the drift's prior size [m per root second]: 0.003 is 3 mm after 1 s, 9 mm after 10 s."""
    drift_log_sigma: float = 1.5
    noise_log_sigma: float = 0.5
    """1 sigma of the log of the true noise over the stated one."""
    iterations: int = 30
    warm_iterations: int = 12
    warm_refits: int = 10
    """So many refits that start from their predecessor are followed by one that also searches from scratch."""


@dataclass(frozen=True, slots=True)
class LearnedSpectrum:
    """A spectrum and the coefficients that it gives for one window.

    ``power_m2`` (m,) variance of each harmonic; ``mean`` (k,) and ``covariance`` (k, k) of all coefficients
    of ``basis``; ``parameters`` for the next warm start; ``drift_mps`` [m per root second]; ``noise_scale``
    the samples' scatter over the sigma that they were given with; ``age`` counts the refits since a search from
    scratch.
    """

    basis: Basis
    power_m2: Array
    mean: Array
    covariance: Array
    parameters: Array
    drift_mps: float
    noise_scale: float
    evaluations: int
    age: int


@dataclass(frozen=True, slots=True)
class _Problem:
    """The compressed regression: columns U (r, k), data y (r,), noise of one common variance.

    ``outside`` directions of the data that no column reaches hold noise alone, ``outside_square`` their sum of
    squares: they tell how large the noise really is. ``wander`` (m,) variances of the noise's own harmonics.
    """

    columns: Array
    data: Array
    harmonics: int
    level_variance: float
    outside: int
    outside_square: float
    wander: Array

    def prior(self, power: Array, drift_variance: float) -> Array:
        drift = np.full(self.columns.shape[1] - 2 * self.harmonics - 1, drift_variance)
        return np.concatenate([power, power, [self.level_variance], drift])

    def evidence(self, prior: Array, noise: float) -> tuple[float, Array, float, Array, Array]:
        """Likelihood of the prior variances (k,) and of the noise's variance, K = U (S + wander) U' + noise I.

        Returns the negative log likelihood, its gradient per prior variance (k,) and by the log of the noise's
        variance, the whitened columns L^-1 U (r, k), and U' K^-1 y (k,).
        """
        from scipy.linalg import blas, lapack

        u, total = self.columns, prior.copy()
        total[: 2 * self.harmonics] += np.tile(self.wander, 2)
        k = blas.dsyrk(1.0, u * np.sqrt(total), lower=1)
        k[np.diag_indices_from(k)] += noise
        lower, info = lapack.dpotrf(k, lower=1, overwrite_a=1)
        if info:
            raise np.linalg.LinAlgError("the covariance of the heave samples is not positive definite")
        solved, _ = lapack.dpotrs(lower, self.data, lower=1)
        value = 0.5 * float(self.data @ solved) + float(np.log(np.diag(lower)).sum())
        whitened = blas.dtrsm(1.0, lower, u, lower=1)
        score = u.T @ solved
        power = np.einsum("ij,ij->j", whitened, whitened)
        value += 0.5 * (self.outside * math.log(noise) + self.outside_square / noise)
        explained = len(solved) - float(total @ power) - noise * float(solved @ solved)
        by_noise = 0.5 * (explained + self.outside - self.outside_square / noise)
        return value, 0.5 * (power - score**2), by_noise, whitened, score


@dataclass(frozen=True, slots=True)
class _Shape:
    """The spectrum as a function of its parameters [peaks, log drift and noise variance, correction]."""

    frequency: Array
    bumps: Array
    floor: float

    def __call__(self, x: Array) -> tuple[Array, Array]:
        """Power (m,) and its derivative by each parameter (p, m); zero by those of drift and noise."""
        total, rows = np.full(len(self.frequency), self.floor), []
        for k in range(PEAKS):
            value, derivative = _peak(self.frequency, x[4 * k : 4 * k + 4])
            total = total + value
            rows.append(derivative)
        correction = np.exp(self.bumps @ x[4 * PEAKS + 2 :])
        power = total * correction
        peaks = np.concatenate(rows) * correction
        return power, np.vstack([peaks, np.zeros((2, len(power))), (self.bumps * power[:, None]).T])


def _peak(frequency: Array, p: Array) -> tuple[Array, Array]:
    """JONSWAP's form with fall-off f^-n: value (m,), derivatives (4, m) by log power, log fp, log gamma, n."""
    x = frequency / math.exp(p[1])
    width = np.where(x <= 1.0, 0.07, 0.09)
    log_x, x4 = np.log(x), np.minimum(x**-4.0, 1e3)
    bell = np.exp(-((x - 1.0) ** 2) / (2.0 * width**2))
    value = np.exp(np.maximum(p[0] - p[3] * log_x - 0.25 * p[3] * (x4 - 1.0) + p[2] * bell, -60.0))
    by_frequency = p[3] * (1.0 - x4) + p[2] * bell * (x - 1.0) * x / width**2
    return value, value * np.array([np.ones_like(x), by_frequency, bell, -log_x - 0.25 * (x4 - 1.0)])


def grid_span(window: Window) -> float:
    """Return the span rounded up to 5 s: equal spans share a grid, so that a refit starts warm."""
    return max(5.0, 5.0 * math.ceil(window.span_s / 5.0))


def learn(
    window: Window,
    settings: SpectrumSettings | None = None,
    previous: LearnedSpectrum | None = None,
    wander: Density | None = None,
) -> LearnedSpectrum:
    """Learn the spectrum of one window and the coefficients in it.

    ``previous`` is an earlier result to start the search from; the result is the same up to the search's
    tolerance. ``wander`` is the density of the wander of the series' own zero, None for none. Cost: about 2 ms an
    iteration at 60 s.
    """
    from scipy.optimize import OptimizeResult, minimize

    settings = settings or SpectrumSettings()
    span = grid_span(window)
    lowest = max(settings.lowest_hz, settings.lowest_cycles / span)
    basis = dense_basis(span, window.interval_s, lowest, settings.highest_hz, settings.horizon_s)
    problem = _compress(window, basis, settings, _wander_power(basis, wander))
    bumps = _bumps(basis.frequency_hz, span, settings)
    first, top = _first_guess(window, basis, settings, wander)
    shape = _Shape(basis.frequency_hz, bumps, settings.floor * math.exp(top))
    log_drift = 2.0 * math.log(settings.drift_mps)
    centre = np.concatenate([np.tile(PEAK_MEAN, PEAKS), [log_drift, 0.0], np.zeros(bumps.shape[1])])
    sigma = np.concatenate(
        [
            np.tile(PEAK_SIGMA, PEAKS),
            [2.0 * settings.drift_log_sigma, 2.0 * settings.noise_log_sigma],
            np.full(bumps.shape[1], settings.correction_sigma),
        ]
    )
    where = 4 * PEAKS
    band = (math.log(lowest), math.log(basis.frequency_hz[-1]))
    bounds = [(top - 8.0, top + 3.0), band, (0.0, 2.0), (3.0, 14.0)] * PEAKS
    bounds += [(-16.0, 0.0), (-8.0, 8.0)] + [(-4.0, 4.0)] * bumps.shape[1]
    low, high = np.array(bounds).T

    def objective(x: Array) -> tuple[float, Array]:
        power, derivative = shape(x)
        prior = problem.prior(power, math.exp(x[where]))
        value, slope, by_noise, _, _ = problem.evidence(prior, math.exp(x[where + 1]))
        m = len(power)
        gradient = derivative @ (slope[:m] + slope[m : 2 * m])
        gradient[where] = slope[2 * m + 1 :] @ prior[2 * m + 1 :]
        gradient[where + 1] = by_noise
        z = (x - centre) / sigma
        return value + 0.5 * float(z @ z), gradient + z / sigma

    def search(start: Array, iterations: int) -> OptimizeResult:
        options = {"maxiter": iterations}
        return minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)

    cold = np.clip(np.concatenate([first, [log_drift, 0.0], np.zeros(bumps.shape[1])]), low, high)
    age, evaluations, found = 0, 0, None
    if previous is not None and previous.parameters.shape == cold.shape:
        warm = np.clip(previous.parameters, low, high)
        if objective(warm)[0] < objective(cold)[0]:
            found, age = search(warm, settings.warm_iterations), previous.age + 1
            evaluations = int(found.nfev)
    if found is None or age >= settings.warm_refits:
        fresh = search(cold, settings.iterations)
        evaluations += int(fresh.nfev)
        found, age = (fresh if found is None or fresh.fun < found.fun else found), 0
    x: Array = found.x
    power, derivative = shape(x)
    uncertain = _log_covariance(problem, power, derivative, x, sigma, where)
    by_parameter = derivative / power
    spread = np.einsum("ij,ij->j", by_parameter, uncertain @ by_parameter)
    power = power * np.exp(0.5 * np.minimum(spread, 1.0))
    derivative = by_parameter * power
    mean, covariance = _posterior(problem, power, derivative, x, uncertain, where)
    drift, scale = (math.exp(0.5 * value) for value in x[where : where + 2])
    return LearnedSpectrum(basis, power, mean, covariance, x, drift, scale, evaluations, age)


def _wander_power(basis: Basis, wander: Density | None) -> Array:
    """Return the variance of each harmonic's coefficients (m,) [m^2] of a noise of this density."""
    if wander is None:
        return np.zeros(len(basis.frequency_hz))
    return wander(basis.frequency_hz) * float(basis.frequency_hz[1] - basis.frequency_hz[0])


def _compress(window: Window, basis: Basis, settings: SpectrumSettings, wander: Array) -> _Problem:
    """Whiten, and project on harmonics spaced as for a slightly longer window: the whole band is kept."""
    weight = 1.0 / np.sqrt(window.variance_m2)[:, None]
    extended = 1.15 * grid_span(window) + 2.0
    frequency = np.arange(0.0, basis.frequency_hz[-1] + 1.5 / extended, 1.0 / extended)
    frame = Basis(frequency[1:]).values(window.time_s)
    columns = weight * basis.values(window.time_s)
    data = weight[:, 0] * window.value_m
    outside, square = 0, 0.0
    if frame.shape[1] < frame.shape[0]:
        q, _ = np.linalg.qr(weight * frame)
        inside = q.T @ data
        outside, square = len(data) - len(inside), float(data @ data - inside @ inside)
        columns, data = q.T @ columns, inside
    columns = np.asfortranarray(columns)
    # The mean is taken off already: a level much wider than what is left only costs the arithmetic its digits.
    left = 10.0 * float(np.ptp(window.value_m)) + 1e3 * math.sqrt(float(window.variance_m2.max()))
    level_variance = min(settings.level_sigma_m, left) ** 2
    return _Problem(columns, data, len(basis.frequency_hz), level_variance, outside, max(0.0, square), wander)


def _bumps(frequency: Array, span_s: float, settings: SpectrumSettings) -> Array:
    """Gaussian bumps, a width apart, that get wider with the frequency: (m, bumps)."""
    centres = [float(frequency[0])]
    widths = []
    while True:
        widths.append(math.hypot(settings.bump_periods / span_s, settings.bump_ratio * centres[-1]))
        if centres[-1] >= frequency[-1]:
            break
        centres.append(centres[-1] + widths[-1])
    bumps: Array = np.exp(-0.5 * ((frequency[:, None] - np.array(centres)) / np.array(widths)) ** 2)
    return bumps


def _first_guess(
    window: Window, basis: Basis, settings: SpectrumSettings, wander: Density | None
) -> tuple[Array, float]:
    """Two peaks from a Hann-tapered periodogram, and the log of the largest power on the grid."""
    t, span = window.time_s, max(window.span_s, 5.0)
    taper = 0.5 - 0.5 * np.cos(
        2.0 * np.pi * (t - t[0] + 0.5 * window.interval_s) / (span + window.interval_s)
    )
    frequency = np.arange(1, max(3, int(basis.frequency_hz[-1] * span)) + 1) / span
    frequency = frequency[(frequency >= basis.frequency_hz[0]) & (frequency <= basis.frequency_hz[-1])]
    level = float(taper @ window.value_m / taper.sum())
    line = np.exp(-2j * np.pi * np.outer(frequency, t)) @ (taper * (window.value_m - level))
    noise = np.full(len(frequency), window.noise_density_m2ps)
    if wander is not None:
        noise += wander(frequency)
    density = np.maximum(2.0 * np.abs(line) ** 2 * span / (len(t) * (taper @ taper)) - noise, 0.02 * noise)
    smooth = np.convolve(np.pad(density, 1, mode="edge"), [0.25, 0.5, 0.25], "valid")
    spacing = float(basis.frequency_hz[1] - basis.frequency_hz[0])
    peak = int(np.argmax(smooth))
    fp, top = float(frequency[peak]), math.log(float(smooth[peak]) * spacing)
    first = [top, math.log(fp), PEAK_MEAN[2], PEAK_MEAN[3]]
    second = [top - 2.5, math.log(fp) + 0.5, PEAK_MEAN[2], PEAK_MEAN[3]]
    # Another peak elsewhere, where there is one above the noise: a small sea beside a slow motion.
    apart = np.abs(np.log(frequency / fp)) > 0.5
    if np.any(apart & (smooth > noise)):
        other = int(np.argmax(np.where(apart, smooth, 0.0)))
        second[:2] = math.log(float(smooth[other]) * spacing), math.log(float(frequency[other]))
    return np.array(first + second), top


def _log_covariance(
    problem: _Problem, power: Array, derivative: Array, x: Array, sigma: Array, where: int
) -> Array:
    """Covariance of the parameters (p, p): the inverse of Fisher's information plus the prior's.

    The information on the variances of the coefficients is 1/2 W o W with W = U' K^-1 U; the wander's are known.
    """
    prior = problem.prior(power, math.exp(x[where]))
    _, _, _, whitened, _ = problem.evidence(prior, math.exp(x[where + 1]))
    w = whitened.T @ whitened
    full = _by_coefficient(prior, derivative, where)
    information = 0.5 * full @ (w * w) @ full.T + np.diag(1.0 / sigma**2)
    covariance = np.linalg.inv(information)
    return np.asarray(0.5 * (covariance + covariance.T), np.float64)


def _by_coefficient(prior: Array, derivative: Array, where: int) -> Array:
    """Derivatives of the coefficients' variances by the parameters (p, k), drift included."""
    m = derivative.shape[1]
    full = np.zeros((len(derivative), len(prior)))
    full[:, :m] = full[:, m : 2 * m] = derivative
    full[where, 2 * m + 1 :] = prior[2 * m + 1 :]
    return full


def _posterior(
    problem: _Problem, power: Array, derivative: Array, x: Array, uncertain: Array, where: int
) -> tuple[Array, Array]:
    """Mean (k,) and covariance (k, k) of the coefficients, the spectrum's own uncertainty included.

    With S the prior variances, W = U' K^-1 U and g = U' K^-1 y the mean is S g and the covariance S - S W S. The
    covariance ``uncertain`` (p, p) of the parameters enters through the mean's derivative by them (the
    empirical-Bayes correction of Kass and Steffey, 1989).
    """
    prior = problem.prior(power, math.exp(x[where]))
    _, _, _, whitened, score = problem.evidence(prior, math.exp(x[where + 1]))
    w = whitened.T @ whitened
    moved = _by_coefficient(prior, derivative, where) * score
    by_parameter = moved - (moved @ w) * prior
    covariance = np.diag(prior) - (prior[:, None] * w) * prior
    covariance += by_parameter.T @ uncertain @ by_parameter
    return prior * score, 0.5 * (covariance + covariance.T)

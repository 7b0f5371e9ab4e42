"""Learning a smooth spectrum of the sea from a minute of noisy heave.

The series is a sum of harmonics on a dense frequency grid whose coefficients are Gaussian with variances s_j,
the spectrum, plus a level and a slow drift (Bayesian harmonic regression). The spectrum is

    s(f) = (floor + J_1(f) + J_2(f)) exp(sum_k c_k B_k(f)),

two JONSWAP-like peaks, each with its own peakedness and fall-off, times a smooth positive correction. All
parameters and the sizes of drift and noise are found together by maximising the exact marginal likelihood of
the samples, by Fisher's scoring, under priors that hold the correction near one and the peaks near the shape
of a wind sea on a small raft: the fewer the data, the closer the result stays to the parametric form. What
is left uncertain of the spectrum enters twice: its mean, not its mode, is taken, and the coefficients'
covariance is widened by the delta method.

A series may hang on something that wanders itself, as a deck's height does that is seen from a vehicle. The
density of that wander, where it is told, is noise of the same harmonics: K holds it, what is learned is the spectrum
beside it, and the coefficients are those of the motion alone.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.heave.basis import Basis, dense_basis
from estimation.heave.regression import Evidence, Regression, compress, information, posterior
from estimation.heave.series import Window
from estimation.scoring import Place, descend

Array = NDArray[np.float64]
Density = Callable[[Array], Array]
"""One-sided density [m^2/Hz] of a noise that is not white, at frequencies (m,) [Hz]."""

PEAK_MEAN = np.array([0.0, 0.0, 0.8, 6.0])
PEAK_SIGMA = np.array([1e3, 1e3, 0.7, 2.0])
"""Prior of a peak: log power and log frequency free, log peakedness, power of the fall-off."""
PEAKS = 2
DRIFT, NOISE = 4 * PEAKS, 4 * PEAKS + 1
"""Places of the logs of the drift's and of the noise's variance among the parameters."""


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
    iterations: int = 40
    warm_iterations: int = 12
    tolerance: float = 0.003
    """Gain of the posterior's logarithm below which a search ends."""
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
        correction = np.exp(self.bumps @ x[NOISE + 1 :])
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


@dataclass(frozen=True, slots=True)
class _State:
    """What a place of the search was evaluated to."""

    evidence: Evidence
    power: Array
    derivative: Array


@dataclass(frozen=True, slots=True)
class _Posterior:
    """The negative log posterior of the parameters x (p,): peaks, log drift and noise variance, correction.

    ``centre`` and ``sigma`` (p,) are their prior.
    """

    regression: Regression
    shape: _Shape
    centre: Array
    sigma: Array

    def __call__(self, x: Array) -> Place[_State]:
        power, derivative = self.shape(x)
        found = self.regression.evidence(self.regression.prior(power, math.exp(x[DRIFT])), math.exp(x[NOISE]))
        z = (x - self.centre) / self.sigma
        return Place(x, found.value + 0.5 * float(z @ z), _State(found, power, derivative))

    def derivatives(self, place: Place[_State]) -> tuple[Array, Array]:
        """Gradient (p,) and information (p, p), the prior's in both; that of the noise stands beside the others', which
        it hardly hangs on."""
        found = place.state.evidence
        by_parameter = self.by_coefficient(found.prior, place.state.derivative)
        gradient = by_parameter @ found.slope
        gradient[NOISE] = found.by_noise
        H = information(found, by_parameter) + np.diag(1.0 / self.sigma**2)
        H[NOISE, NOISE] += found.noise_information
        return gradient + (place.x - self.centre) / self.sigma**2, H

    def by_coefficient(self, prior: Array, derivative: Array) -> Array:
        """Derivatives of the coefficients' variances by the parameters (p, k), drift included."""
        m = derivative.shape[1]
        full = np.zeros((len(derivative), len(prior)))
        full[:, :m] = full[:, m : 2 * m] = derivative
        full[DRIFT, 2 * m + 1 :] = prior[2 * m + 1 :]
        return full


def learn(
    window: Window,
    settings: SpectrumSettings | None = None,
    previous: LearnedSpectrum | None = None,
    wander: Density | None = None,
) -> LearnedSpectrum:
    """Learn the spectrum of one window and the coefficients in it.

    ``previous`` is an earlier result to start the search from; the result is the same up to the search's
    tolerance. ``wander`` is the density of the wander of the series' own zero, None for none. Cost at 60 s: about
    1.5 ms a step, and 8 ms besides.
    """
    settings = settings or SpectrumSettings()
    span = grid_span(window)
    lowest = max(settings.lowest_hz, settings.lowest_cycles / span)
    basis = dense_basis(span, window.interval_s, lowest, settings.highest_hz, settings.horizon_s)
    frequency = basis.frequency_hz
    wandering = None if wander is None else wander(frequency) * float(frequency[1] - frequency[0])
    bumps = _bumps(frequency, span, settings)
    first, top = _first_guess(window, basis, settings, wander)
    log_drift = 2.0 * math.log(settings.drift_mps)
    none = np.zeros(bumps.shape[1])
    evaluate = _Posterior(
        compress(window, basis, span, settings.level_sigma_m, wandering),
        _Shape(frequency, bumps, settings.floor * math.exp(top)),
        np.concatenate([np.tile(PEAK_MEAN, PEAKS), [log_drift, 0.0], none]),
        np.concatenate(
            [
                np.tile(PEAK_SIGMA, PEAKS),
                [2.0 * settings.drift_log_sigma, 2.0 * settings.noise_log_sigma],
                none + settings.correction_sigma,
            ]
        ),
    )
    band = (math.log(lowest), math.log(frequency[-1]))
    bounds = [(top - 8.0, top + 3.0), band, (0.0, 2.0), (3.0, 14.0)] * PEAKS
    bounds += [(-16.0, 0.0), (-8.0, 8.0)] + [(-4.0, 4.0)] * len(none)
    low, high = np.array(bounds).T

    def search(start: Place[_State], iterations: int) -> tuple[Place[_State], int]:
        def tried(x: Array) -> Place[_State]:
            try:
                return evaluate(x)
            except np.linalg.LinAlgError:  # a step too far for the arithmetic: not one to take
                return Place(x, math.inf, start.state)

        return descend(
            tried, evaluate.derivatives, start, low, high, iterations=iterations, tolerance=settings.tolerance
        )

    cold = evaluate(np.clip(np.concatenate([first, [log_drift, 0.0], none]), low, high))
    age, evaluations, found = 0, 1, None
    if previous is not None and previous.parameters.shape == cold.x.shape:
        warm = evaluate(np.clip(previous.parameters, low, high))
        evaluations += 1
        if warm.value < cold.value:
            found, steps = search(warm, settings.warm_iterations)
            age, evaluations = previous.age + 1, evaluations + steps
    if found is None or age >= settings.warm_refits:
        fresh, steps = search(cold, settings.iterations)
        found, age = (fresh if found is None or fresh.value < found.value else found), 0
        evaluations += steps
    return _learned(evaluate, found, basis, evaluations, age)


def _learned(
    evaluate: _Posterior, found: Place[_State], basis: Basis, evaluations: int, age: int
) -> LearnedSpectrum:
    """Return the mean spectrum, not the most probable one, about the place that was found, and what it gives."""
    x, state = found.x, found.state
    uncertain = np.linalg.inv(evaluate.derivatives(found)[1])
    uncertain = 0.5 * (uncertain + uncertain.T)
    by_parameter = state.derivative / state.power
    spread = np.einsum("ij,ij->j", by_parameter, uncertain @ by_parameter)
    power = state.power * np.exp(0.5 * np.minimum(spread, 1.0))
    regression = evaluate.regression
    mean_of = regression.evidence(regression.prior(power, math.exp(x[DRIFT])), math.exp(x[NOISE]))
    mean, covariance = posterior(
        mean_of, evaluate.by_coefficient(mean_of.prior, by_parameter * power), uncertain
    )
    drift, scale = (math.exp(0.5 * value) for value in x[[DRIFT, NOISE]])
    return LearnedSpectrum(basis, power, mean, covariance, x, drift, scale, evaluations, age)


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

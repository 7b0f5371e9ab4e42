"""The Gaussian regression behind a learned spectrum: how likely prior variances are, and what they make of the samples.

Samples y = U a + noise, whitened; the coefficients a are independent with prior variances S, of which those of the
harmonics hold the wander of the series' own zero besides: K = U (S + wander) U' + noise I. The evidence is evaluated in
a compressed space: the samples are projected on the few hundred directions that the band can excite within the window.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.heave.basis import Basis
from estimation.heave.series import Window

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class Evidence:
    """How likely the data are under prior variances ``prior`` (k,) and a noise of variance ``noise``.

    ``value`` the negative log likelihood, ``slope`` (k,) and ``by_noise`` its derivatives by the prior variances and by
    the log of the noise's; ``noise_information`` about the latter, an upper bound; ``whitened`` L^-1 U (r, k) with
    K = L L', and ``score`` U' K^-1 y (k,).
    """

    prior: Array
    noise: float
    value: float
    slope: Array
    by_noise: float
    noise_information: float
    whitened: Array
    score: Array

    def weights(self) -> Array:
        """Return W = U' K^-1 U (k, k)."""
        out: Array = self.whitened.T @ self.whitened
        return out


@dataclass(frozen=True, slots=True)
class Regression:
    """The compressed regression: columns U (r, k), data y (r,), noise of one common variance.

    The columns are those of a ``Basis`` with so many ``harmonics``. ``outside`` directions of the data that no column
    reaches hold noise alone, ``outside_square`` their sum of squares: they tell how large the noise really is.
    ``wander`` (m,) variances of the noise's own harmonics.
    """

    columns: Array
    data: Array
    harmonics: int
    level_variance: float
    outside: int
    outside_square: float
    wander: Array

    def prior(self, power: Array, drift_variance: float) -> Array:
        """Return the prior variances (k,) of all coefficients from those of the harmonics (m,)."""
        drift = np.full(self.columns.shape[1] - 2 * self.harmonics - 1, drift_variance)
        return np.concatenate([power, power, [self.level_variance], drift])

    def evidence(self, prior: Array, noise: float) -> Evidence:
        """Return how likely the data are; raise ``LinAlgError`` where K is not positive definite."""
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
        value += 0.5 * (self.outside * math.log(noise) + self.outside_square / noise)
        whitened = blas.dtrsm(1.0, lower, u, lower=1)
        score = u.T @ solved
        power = np.einsum("ij,ij->j", whitened, whitened)
        # noise tr(K^-1), which is also no less than noise^2 tr(K^-2)
        unexplained = len(solved) - float(total @ power)
        by_noise = unexplained - noise * float(solved @ solved) + self.outside - self.outside_square / noise
        known = 0.5 * (unexplained + self.outside)
        return Evidence(prior, noise, value, 0.5 * (power - score**2), 0.5 * by_noise, known, whitened, score)


def compress(
    window: Window, basis: Basis, span_s: float, level_sigma_m: float, wander: Array | None
) -> Regression:
    """Return the regression of a window on a basis: whitened, and projected on harmonics spaced as for a window
    slightly longer than ``span_s``, which keep the whole band.

    ``level_sigma_m`` [m] is the level's prior, ``wander`` (m,) [m^2] the variances of the zero's own harmonics.
    """
    weight = 1.0 / np.sqrt(window.variance_m2)[:, None]
    extended = 1.15 * span_s + 2.0
    frequency = np.arange(0.0, basis.frequency_hz[-1] + 1.5 / extended, 1.0 / extended)
    frame = Basis(frequency[1:]).values(window.time_s)
    columns = weight * basis.values(window.time_s)
    data = weight[:, 0] * window.value_m
    outside, square = 0, 0.0
    if frame.shape[1] < frame.shape[0]:
        q, _ = np.linalg.qr(weight * frame)
        inside = q.T @ data
        outside, square = len(data) - len(inside), float(data @ data - inside @ inside)
        columns, data = (columns.T @ q).T, inside
    # The mean is taken off already: a level much wider than what is left only costs the arithmetic its digits.
    left = 10.0 * float(np.ptp(window.value_m)) + 1e3 * math.sqrt(float(window.variance_m2.max()))
    m = len(basis.frequency_hz)
    return Regression(
        np.asfortranarray(columns),
        data,
        m,
        min(level_sigma_m, left) ** 2,
        outside,
        max(0.0, square),
        np.zeros(m) if wander is None else wander,
    )


def information(evidence: Evidence, by_parameter: Array) -> Array:
    """Return Fisher's information (p, p) on parameters that move the prior variances by ``by_parameter`` (p, k).

    That on the variances is 1/2 W o W with W = U' K^-1 U; the wander's are known.
    """
    w = evidence.weights()
    out: Array = 0.5 * by_parameter @ (w * w) @ by_parameter.T
    return 0.5 * (out + out.T)


def posterior(evidence: Evidence, by_parameter: Array, uncertain: Array) -> tuple[Array, Array]:
    """Return mean (k,) and covariance (k, k) of the coefficients, the prior's own uncertainty included.

    With S the prior variances and g = U' K^-1 y the mean is S g and the covariance S - S W S. The covariance
    ``uncertain`` (p, p) of the parameters that S hangs on by ``by_parameter`` (p, k) enters through the mean's
    derivative by them (the empirical-Bayes correction of Kass and Steffey, 1989).
    """
    prior, w = evidence.prior, evidence.weights()
    moved = by_parameter * evidence.score
    mean_by_parameter = moved - (moved @ w) * prior
    covariance = np.diag(prior) - (prior[:, None] * w) * prior
    covariance += mean_by_parameter.T @ uncertain @ mean_by_parameter
    return prior * evidence.score, 0.5 * (covariance + covariance.T)

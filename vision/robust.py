"""Weighted least squares that survive lines that show something else."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.view import either

Array = NDArray[np.float64]

MODEL_VARIANCE_PX2 = 1e-4
"""Variance of a displacement that its own line does not know of [px^2]."""


class Solved(NamedTuple):
    """A solution: the inverse of the normal matrix (n, n), ``weight``, ``residual`` and ``inlier`` of each row
    (p,), the parameters' change (n,), and the mean weighted square of the residuals over the degrees of freedom.
    """

    ok: bool
    inverse: Array
    weight: Array
    residual: Array
    inlier: NDArray[np.bool_]
    change: Array
    chi2: float


def median(values: Array) -> float:
    """Return the upper median: ``numpy.median`` takes five times as long on a hundred values."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def masked(values: Array, keep: NDArray[np.bool_]) -> Array:
    """Return the values (p,), zero where they are not kept, whatever they are there."""
    return np.where(keep, values, 0.0)


def times(matrix: Array, vector: Array) -> Array:
    """Return the product of a matrix (p, n) and a vector (n,)."""
    product: Array = matrix @ vector
    return product


def normal_equations(a: Array, weight: Array, b: Array) -> tuple[Array, Array]:
    """Return A' W A (n, n) and A' W b (n,) of rows ``a`` (p, n)."""
    aw = (a * weight[:, None]).T
    return aw @ a, aw @ b


def inverted(matrix: Array) -> tuple[bool, Array]:
    """Return the inverse of a symmetric positive definite matrix, and whether it is one."""
    try:
        return True, np.asarray(np.linalg.inv(matrix))
    except np.linalg.LinAlgError:
        return False, matrix


def least_squares(
    a: Array, delta: Array, sigma2: Array, valid: NDArray[np.bool_], precision: Array, pull: Array
) -> Solved:
    """Solve for the change of the parameters, robustly; rows that disagree lose their weight altogether.

    ``a`` (p, n) and ``delta`` (p,) with variances ``sigma2``; ``precision`` (n,) and ``pull`` (n,) of the prior.
    """
    n = len(precision)
    full = masked(1.0 / (sigma2 + MODEL_VARIANCE_PX2), valid)
    delta = masked(delta, valid)
    weight, residual, inverse, change = full, delta, np.zeros((n, n)), np.zeros(n)
    ok, scale = False, 0.0
    for step in range(3):
        matrix, vector = normal_equations(a, weight, delta)
        for k in range(n):
            matrix[k, k] += precision[k]
            vector[k] += pull[k]
        ok, inverse = inverted(matrix)
        if not ok:
            break
        change = times(inverse, vector)
        residual, next_weight, scale, largest = reweighted(a, delta, full, change, valid)
        if step == 2 or largest < 2.5 * scale:
            break
        weight = next_weight
    inlier = valid & (np.abs(residual) < max(5.0 * scale, 0.25))
    used = np.count_nonzero(weight)
    chi2 = (weight * residual * residual).sum() / max(used - n, 1)
    return Solved(ok and bool(used >= 10), inverse, weight, residual, inlier, change, chi2)


def scatter_covariance(a: Array, solved: Solved, precision: Array, expected: Array) -> Array:
    """Return the covariance (n, n) of the parameters from the scatter of the residuals.

    With H the inverse of the normal matrix, W the weights, P the prior's ``precision``, V the rows' ``expected``
    variances (p,) and s^2 what the residuals show these have to be multiplied by,

        H (s^2 A' W V W A + P) H

    (Huber's sandwich). Weights come from variances that each row estimates from a few pixels of its own, and from
    the residuals, so that they differ by chance beside what is expected: H alone, which is right where weights are the
    inverse of variances, then claims some 10 % too little.
    """
    variance = masked(expected, solved.weight > 0.0)
    scale = solved.chi2 * np.count_nonzero(solved.weight) / max((solved.weight * variance).sum(), 1e-12)
    meat, _ = normal_equations(a, solved.weight * solved.weight * variance, solved.residual)
    meat = scale * meat
    for k in range(len(precision)):
        meat[k, k] += precision[k]
    covariance = np.empty((len(precision), len(precision)))
    for k in range(len(precision)):
        covariance[k] = times(solved.inverse, times(meat, solved.inverse[k]))
    return covariance


def reweighted(
    a: Array, delta: Array, full: Array, change: Array, valid: NDArray[np.bool_]
) -> tuple[Array, Array, float, float]:
    """Return the residuals after a change, the rows' next weights, the residuals' scale and the largest."""
    residual = delta - times(a, change)
    size = np.abs(residual)
    seen = size[valid]
    scale = residual_scale(median(seen))
    return residual, full * kept(size, scale), scale, float(seen.max())


def residual_scale(middle: float) -> float:
    """Return the residuals' 1-sigma [px] from their median size."""
    return max(1.4826 * middle, 0.01)


def kept(size: Any, scale: float) -> Any:
    """Return the share of its weight that a row with a residual of this size keeps."""
    huber = np.minimum(1.0, 2.0 * scale / np.maximum(size, 1e-12))
    return either(size < max(5.0 * scale, 0.1), huber, 0.0)

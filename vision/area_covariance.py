"""How well the place of a small target is known, from the residuals themselves.

Residuals are neither equal nor independent: light has photon noise, edges carry the errors of their model, and
compression spreads its errors over neighbouring pixels. So the covariance is not the normal matrix's inverse times
one variance, but the estimator's own response to what was left,

    H^-1 (sum_B s_B s_B' / 9 + prior) H^-1        s_B = sum of w_i e_i J_i over the block B

over all blocks of 3x3 pixels: errors are taken as less and less alike up to three pixels apart (White's estimator
with Bartlett's window; residuals are divided by what their own pixel left free, as in HC3).

A small target's few edge pixels tell that only roughly. Of equal, independent errors the sum for one parameter has

    nu = (sum_i g_i)^2 / sum_ij g_i g_j k_ij^2        g_i = (w_i (H^-1 J_i))^2, k_ij Bartlett's window

degrees of freedom (Satterthwaite), and what is normalised by it is distributed as Student's t, whose variance is
nu / (nu - 2) times as large: the covariance is that of the t distribution.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.area_model import Pixels
from vision.robust import normal_equations

Array = NDArray[np.float64]

MAX_LEVERAGE = 0.9
BLOCK = 3
MIN_FREEDOM = 6.0
"""Least degrees of freedom; with fewer the variance is hardly defined."""


def sandwich(
    rows: Array, weight: Array, residual: Array, inverse: Array, variance: float, prior: Array, pixels: Pixels
) -> Array:
    """Return the covariance (m, m) of the parameters of linearised equations.

    ``rows`` (n, m), ``weight`` and ``residual`` (n,) of the pixels; ``inverse`` (m, m) is that of the normal matrix
    times ``variance``; ``prior`` (m,) what the prior adds to that matrix's diagonal.
    """
    plain = inverse / variance
    turned = rows @ plain
    leverage = np.minimum(weight * (rows * turned).sum(axis=1), MAX_LEVERAGE)
    score = weight * residual / (1.0 - leverage)
    blocks = block_sums(turned, score, pixels)
    meat, _ = normal_equations(blocks, np.full(len(blocks), 1.0 / BLOCK**2), np.zeros(len(blocks)))
    known, _ = normal_equations(plain, prior * variance, np.zeros(len(prior)))
    wider = widening(freedom(turned, weight, pixels), len(prior))
    for i in range(len(prior)):
        for j in range(len(prior)):
            meat[i, j] *= wider[i] * wider[j]
    return meat + known


def widening(degrees: Array, count: int) -> Array:
    """Return the 1-sigma of Student's t for each parameter (count,), with the ``degrees`` of freedom of the first
    three; the others have those of the third, the scale.
    """
    factor = np.empty(count)
    for i in range(count):
        nu = max(degrees[min(i, 2)], MIN_FREEDOM)
        factor[i] = np.sqrt(nu / (nu - 2.0))
    return factor


def window(di: int, dj: int) -> float:
    """Return Bartlett's window for pixels so many rows and columns apart."""
    return max(1.0 - abs(di) / BLOCK, 0.0) * max(1.0 - abs(dj) / BLOCK, 0.0)


def freedom(turned: Array, weight: Array, pixels: Pixels) -> Array:
    """Return the degrees of freedom (3,) of the variances of the first three parameters."""
    row = (pixels.v - pixels.corner[1]).astype(np.int64) + BLOCK - 1
    column = (pixels.u - pixels.corner[0]).astype(np.int64) + BLOCK - 1
    share = (turned[:, :3] * weight[:, None]) ** 2
    box = np.zeros((pixels.down + 2 * BLOCK - 2, pixels.across + 2 * BLOCK - 2, 3))
    box[row, column] = share
    together = np.zeros(3)
    for di in range(1 - BLOCK, BLOCK):
        for dj in range(1 - BLOCK, BLOCK):
            together += window(di, dj) ** 2 * (share * box[row + di, column + dj]).sum(axis=0)
    return np.asarray(share.sum(axis=0) ** 2 / np.maximum(together, 1e-300))


def block_sums(turned: Array, score: Array, pixels: Pixels) -> Array:
    """Return the sums of ``score`` times the rows of ``turned`` (n, m) over all blocks of pixels (k, m)."""
    row = (pixels.v - pixels.corner[1]).astype(np.int64)
    column = (pixels.u - pixels.corner[0]).astype(np.int64)
    total = np.zeros((pixels.down + BLOCK - 1, pixels.across + BLOCK - 1, turned.shape[1]))
    each = turned * score[:, None]
    for i in range(BLOCK):
        for j in range(BLOCK):
            total[row + i, column + j] += each
    blocks: Array = total.reshape(-1, turned.shape[1])
    some: Array = blocks[(blocks != 0.0).any(axis=1)]
    return some

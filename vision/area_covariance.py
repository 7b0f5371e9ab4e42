"""How well the place of a small target is known, from the residuals themselves.

Residuals are neither equal nor independent: light has photon noise, edges carry the errors of their model, and
compression spreads its errors over neighbouring pixels. So the covariance is not the normal matrix's inverse times
one variance, but the estimator's own response to what was left,

    H^-1 (sum_B s_B s_B' / 9 + prior) H^-1        s_B = sum of w_i e_i J_i over the block B

over all blocks of 3x3 pixels: errors are taken as less and less alike up to three pixels apart (White's estimator
with Bartlett's window; residuals are divided by what their own pixel left free, as in HC3).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.area_model import Pixels
from vision.robust import normal_equations

Array = NDArray[np.float64]

MAX_LEVERAGE = 0.9
BLOCK = 3


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
    return meat + known


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

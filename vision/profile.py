"""How far an edge lies from where it was predicted, from the brightness along a line of pixels.

On a line the brightness is ``a + b P(d)`` with the light's level a and contrast b free, d the distance from
the edge and P the blurred profile of the edge and of its neighbours. Linearised about the prediction, each
line gives the edge's displacement, its variance, and by how much the blur should change; no line knows of
another, so that light, shadow and glare need no model.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.lines import (
    BEND,
    DISTANCE,
    GAP_PX,
    HALF_PX,
    INWARD_BEND,
    INWARD_PX,
    LEVEL,
    NU,
    NV,
    OUTWARD_BEND,
    OUTWARD_PX,
    SIDE,
    TOTAL,
    VALUE,
    WEIGHT,
    Lines,
)
from vision.robust import inverted, masked, median, normal_equations, times
from vision.view import either

Array = NDArray[np.float64]

SQRT_2_OVER_PI = 0.7978845608028654
INV_SQRT_2PI = 0.3989422804014327
MIN_CONTRAST = 4.0
"""Least brightness across an edge."""
MIN_VARIANCE = 0.08
"""Variance of the rounding to whole numbers, the least noise of a pixel."""
DIRECTIONAL_PX = 0.85
"""Blur from which its direction is sought."""


class Measured(NamedTuple):
    """What lines say, all (p,): displacement [px], its variance, whether it is an edge at all, and the change
    of the logarithm of its blur; the edges' median ``contrast``. Not ``ok`` where there are too few.
    """

    ok: bool
    delta: Array
    sigma2: Array
    valid: NDArray[np.bool_]
    ratio: Array
    contrast: float


def phi(t: Any) -> Any:
    """Return the normal distribution function, to 3e-4 (Page's formula with tanh)."""
    return 0.5 + 0.5 * np.tanh(SQRT_2_OVER_PI * t * (1.0 + 0.044715 * t * t))


def line_blur(blur_xy: Array, nu: Any, nv: Any) -> Any:
    """Return the blur across lines with normals (nu, nv) [px] of a blur's covariance (uu, uv, vv) [px^2]."""
    square = nu * nu * blur_xy[0] + nu * nv * blur_xy[1] + nv * nv * blur_xy[2]
    return np.sqrt(np.minimum(np.maximum(square, 0.09), 36.0))


def line_blurs(lines: Lines, blur_xy: Array) -> Array:
    """Return ``line_blur`` of all lines (p,)."""
    blur: Array = line_blur(blur_xy, lines.row[:, NU], lines.row[:, NV])
    return blur


def crowded(lines: Lines, blur: Array) -> bool:
    """Return whether neighbouring edges reach into some of the lines."""
    return bool((lines.row[:, GAP_PX] - lines.row[:, HALF_PX] < 3.0 * blur).any())


def line_moments(
    lines: Lines, shift_px: Array, growth_px: float, blur: Array, with_neighbours: bool
) -> Array:
    """Return the moments (p, 4, 4) of three columns and the brightness about their means on each line.

    The columns are the derivatives of the brightness, over the contrast, with the contrast, the displacement
    and the logarithm of the blur, at ``shift_px`` (p,) from the prediction and with ``blur`` (p,).
    """
    row, value, weight = lines.row, lines.pixels[:, :, VALUE], lines.pixels[:, :, WEIGHT]
    s = row[:, SIDE]
    per = (1.0 / blur)[:, None]
    distance = lines.pixels[:, :, DISTANCE] - (shift_px - blur * blur * row[:, BEND])[:, None]
    t = distance * per
    bell = np.exp(-0.5 * t * t)
    rise = phi(t)
    spread = t * bell
    if with_neighbours:
        # The neighbours grow the other way, and bend by their own radius.
        grown = (2.0 * growth_px) * s - blur * blur * row[:, BEND]
        for offset in (
            grown - row[:, OUTWARD_PX] + blur * blur * row[:, OUTWARD_BEND],
            grown + row[:, INWARD_PX] + blur * blur * row[:, INWARD_BEND],
        ):
            tj = np.minimum(np.maximum((distance + offset[:, None]) * per, -9.0), 9.0)
            bj = np.exp(-0.5 * tj * tj)
            rise = rise - phi(tj)
            bell = bell - bj
            spread = spread - tj * bj
    basis = np.empty((len(s), 4, t.shape[1]))
    np.multiply(s[:, None], rise, out=basis[:, 0])
    np.multiply((-INV_SQRT_2PI * s)[:, None] * per, bell, out=basis[:, 1])
    np.multiply((-INV_SQRT_2PI * s)[:, None], spread, out=basis[:, 2])
    basis[:, 3] = value - row[:, LEVEL, None]
    weighted = basis * weight[:, None, :]
    # About the means of each line: its level is eliminated.
    sums = weighted.sum(axis=2)
    gram = weighted @ basis.transpose(0, 2, 1)
    gram -= (sums / np.maximum(lines.row[:, TOTAL], 1.0)[:, None])[:, :, None] * sums[:, None, :]
    return gram


def line_solution(
    a: Any, b: Any, c: Any, d: Any, e: Any, f: Any, h0: Any, h1: Any, h2: Any
) -> tuple[Any, Any, Any, Any]:
    """Return contrast, displacement times contrast, blur's change times contrast, and the displacement's
    element of the inverse, from moments [[a, b, c], [b, d, e], [c, e, f]] and (h0, h1, h2).
    """
    f = f * 1.05 + 1e-12
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * c00 + b * c01 + c * c02
    per = 1.0 / either(determinant > 1e-12 * a * d * f, determinant, np.inf)
    return (
        (c00 * h0 + c01 * h1 + c02 * h2) * per,
        (c01 * h0 + c11 * h1 + c12 * h2) * per,
        (c02 * h0 + c12 * h1 + c22 * h2) * per,
        c11 * per,
    )


def line_solution_sharp(a: Any, b: Any, d: Any, h0: Any, h1: Any) -> tuple[Any, Any, Any]:
    """Return the same without the blur: contrast, displacement times contrast, element of the inverse."""
    determinant = a * d - b * b
    per = 1.0 / either(determinant > 1e-12 * a * d, determinant, np.inf)
    return (d * h0 - b * h1) * per, (a * h1 - b * h0) * per, a * per


def solve_lines(gram: Array, free_blur: bool) -> tuple[Array, Array, Array, Array, Array]:
    """Return each line's contrast, displacement and blur's change times contrast, the displacement's element
    of the inverse, and the sum of squares that is left, all (p,).
    """
    h0, h1, h2 = gram[:, 0, 3], gram[:, 1, 3], gram[:, 2, 3]
    a, b, d = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    if free_blur:
        contrast, shift, wider, inverse = line_solution(
            a, b, gram[:, 0, 2], d, gram[:, 1, 2], gram[:, 2, 2], h0, h1, h2
        )
    else:
        contrast, shift, inverse = line_solution_sharp(a, b, d, h0, h1)
        wider = np.zeros_like(shift)
    rest = gram[:, 3, 3] - (contrast * h0 + shift * h1 + wider * h2)
    return contrast, shift, wider, inverse, np.maximum(rest, 0.0)


def line_noise(rest: Any, total: Any) -> Any:
    """Return the variance of a line's pixels [brightness^2]."""
    return rest / np.maximum(total - 4.0, 1.0)


def line_displacement(
    contrast: Any,
    shift: Any,
    inverse: Any,
    rest: Any,
    power: Any,
    total: Any,
    half_px: Any,
    middle: float,
    noise: float,
) -> tuple[Any, Any, Any]:
    """Return a line's displacement [px], its variance, and whether it is an edge at all.

    ``middle`` is the median contrast of all lines, ``noise`` the median variance of their pixels.
    """  # fmt: skip
    seen = np.maximum(contrast, 1.0)
    delta = shift / seen
    sigma2 = np.maximum(line_noise(rest, total), noise) * inverse / (seen * seen)
    limit = np.maximum(0.15 * power, 8.0 * noise * np.maximum(total - 4.0, 1.0))
    valid = (contrast > max(MIN_CONTRAST, 0.3 * middle)) & (rest < limit)
    valid = valid & (np.abs(delta) < half_px) & (sigma2 < 1.0) & (total >= 5.0)
    return delta, sigma2, valid


def displacements(
    lines: Lines,
    gram: Array,
    contrast: Array,
    shift: Array,
    inverse: Array,
    rest: Array,
    middle: float,
    noise: float,
) -> tuple[Array, Array, NDArray[np.bool_]]:
    """Return ``line_displacement`` of all lines."""
    return line_displacement(
        contrast,
        shift,
        inverse,
        rest,
        gram[:, 3, 3],
        lines.row[:, TOTAL],
        lines.row[:, HALF_PX],
        middle,
        noise,
    )


def measure(lines: Lines, gram: Array, free_blur: bool) -> Measured:
    """Solve each line for its contrast and displacement, and for its blur where ``free_blur``."""
    contrast, shift, wider, inverse, rest = solve_lines(gram, free_blur)
    middle = median(contrast)
    noise = max(median(line_noise(rest, lines.row[:, TOTAL])), MIN_VARIANCE)
    delta, sigma2, valid = displacements(lines, gram, contrast, shift, inverse, rest, middle, noise)
    ok = middle > MIN_CONTRAST and bool(np.count_nonzero(valid) >= 10)
    return Measured(ok, delta, sigma2, valid, wider / np.maximum(contrast, 1.0), middle)


def updated_blur(
    lines: Lines, blur_px: float, blur_xy: Array, ratio: Array, used: NDArray[np.bool_]
) -> tuple[float, Array]:
    """Return the blur [px] and its covariance (uu, uv, vv) [px^2] after what the lines say.

    A blur that is not small may differ with the direction (motion).
    """
    step = np.minimum(np.maximum(ratio, -0.5), 0.5)
    blur_px = min(6.0, max(0.3, blur_px * float(np.exp(median(step[used])))))
    even = np.array([blur_px * blur_px, 0.0, blur_px * blur_px])
    if blur_px < DIRECTIONAL_PX:
        return blur_px, even
    square = (line_blurs(lines, blur_xy) * np.exp(step))[used] ** 2
    nu, nv = lines.row[used, NU], lines.row[used, NV]
    columns = np.empty((len(square), 3))
    columns[:, 0], columns[:, 1], columns[:, 2] = nu * nu, nu * nv, nv * nv
    weight = np.ones(len(square))
    found = even
    for _ in range(2):
        if weight.sum() < 10:
            return blur_px, blur_xy
        matrix, vector = normal_equations(columns, weight, square)
        solvable, inverse = inverted(matrix)
        if not solvable:
            return blur_px, blur_xy
        found = times(inverse, vector)
        off = np.abs(square - times(columns, found))
        weight = masked(np.ones(len(off)), off < 3.0 * median(off) + 1e-6)
    return blur_px, found

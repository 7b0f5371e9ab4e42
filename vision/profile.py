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
    CLIPPED,
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
    SAMPLES,
    SIDE,
    TOTAL,
    VALUE,
    WEIGHT,
    Lines,
)
from vision.robust import MODEL_VARIANCE_PX2, inverted, masked, median, normal_equations, times
from vision.view import either

Array = NDArray[np.float64]

SQRT_2_OVER_PI = 0.7978845608028654
INV_SQRT_2PI = 0.3989422804014327
MIN_CONTRAST = 4.0
"""Least brightness across an edge."""
MIN_EDGES = 10
"""Least number of lines that show an edge."""
MIN_VARIANCE = 0.08
"""Variance of the rounding to whole numbers, the least noise of a pixel."""
CLIPPED_ERROR_PX = 0.3
"""Error of the place of an edge on a line with clipped pixels, where others have none."""
ENOUGH_UNCLIPPED = 9
MIN_GAUSSIAN_PX = 0.25
"""Least blur of a lens."""
MAX_BOX = 3.3
"""Widest box as a share of the whole blur; a box alone has 3.46."""
FAR_PX = 40.0
"""Distance from an edge beyond which nothing changes."""
DIRECTIONAL_PX = 0.85
"""Blur from which its direction is sought."""


class Measured(NamedTuple):
    """What lines say, all (p,): displacement [px], its variance, whether it is an edge at all, and the change
    of the logarithm of its blur; the variance ``expected`` where all pixels are as noisy as the median line's; the
    edges' median ``contrast``. Not ``ok`` where there are too few.
    """

    ok: bool
    delta: Array
    sigma2: Array
    valid: NDArray[np.bool_]
    ratio: Array
    expected: Array
    contrast: float


def phi(t: Any) -> Any:
    """Return the normal distribution function, to 3e-4 (Page's formula, as a logistic function)."""
    t = np.minimum(np.maximum(t, -8.0), 8.0)
    return 1.0 / (1.0 + np.exp(-2.0 * SQRT_2_OVER_PI * t * (1.0 + 0.044715 * t * t)))


def line_blur(blur_xy: Array, nu: Any, nv: Any) -> Any:
    """Return the blur across lines with normals (nu, nv) [px] of a blur's covariance (uu, uv, vv) [px^2]."""
    square = nu * nu * blur_xy[0] + nu * nv * blur_xy[1] + nv * nv * blur_xy[2]
    return np.sqrt(np.minimum(np.maximum(square, 0.09), 36.0))


def line_blurs(lines: Lines, blur_xy: Array) -> Array:
    """Return ``line_blur`` of all lines (p,)."""
    blur: Array = line_blur(blur_xy, lines.row[:, NU], lines.row[:, NV])
    return blur


def line_boxes(lines: Lines, blur: Array, blur_xy: Array) -> Array:
    """Return the box of each line's blur (p,) [px]: the longer of a pixel's width and of the motion across."""
    motion = motion_of(blur_xy)
    nu, nv = lines.row[:, NU], lines.row[:, NV]
    box: Array = box_across(motion, nu, nv, blur)
    return box


def box_across(motion: Array, nu: Any, nv: Any, blur: Any) -> Any:
    """Return the longer of a pixel's width and of a motion (2,) along the normal (nu, nv), within the blur."""
    moved = np.minimum(np.abs(nu * motion[0] + nv * motion[1]), MAX_BOX * blur)
    return np.maximum(pixel_box(nu, nv), moved)


def crowded(lines: Lines, blur: Array) -> bool:
    """Return whether neighbouring edges reach into some of the lines."""
    return bool((lines.row[:, GAP_PX] - lines.row[:, HALF_PX] < 3.0 * blur).any())


def edge_profile(distance: Any, sigma: Any, box: Any) -> tuple[Any, Any, Any]:
    """Return an edge's brightness from 0 to 1 at a distance [px], and its derivatives with distance and sigma.

    The step is blurred by a Gaussian of 1-sigma ``sigma`` and by a box of width ``box``, both in pixels: the lens,
    and what is straight, a pixel's width or the path of a motion.
    """
    p, m = (distance + 0.5 * box) / sigma, (distance - 0.5 * box) / sigma
    bell_p, bell_m = INV_SQRT_2PI * np.exp(-0.5 * p * p), INV_SQRT_2PI * np.exp(-0.5 * m * m)
    cdf_p, cdf_m = phi(p), phi(m)
    wider = (bell_p - bell_m) / box
    return sigma * ((p * cdf_p - m * cdf_m) / box + wider), (cdf_p - cdf_m) / box, wider


def pixel_box(nu: Any, nv: Any) -> Any:
    """Return the width of a pixel along the normal (nu, nv) of an edge [px]: the longer of its two shadows."""
    # Never below 0.7, but at the target's very centre, where there is no normal.
    return np.maximum(np.maximum(np.abs(nu), np.abs(nv)), 0.5)


def motion_of(blur_xy: Array) -> Array:
    """Return the vector (2,) of the straight motion [px] that explains why a blur differs with the direction.

    A blur's covariance (uu, uv, vv), with uv the sum of both off-diagonal elements, has the excess L^2 / 12 along a
    path of length L.
    """
    difference, mixed = blur_xy[0] - blur_xy[2], blur_xy[1]
    excess = np.hypot(difference, mixed)
    angle = 0.5 * np.arctan2(mixed, difference)
    length = np.sqrt(12.0 * excess)
    return np.array([length * np.cos(angle), length * np.sin(angle)])


def gaussian_part(blur: Any, box: Any) -> Any:
    """Return the 1-sigma of the Gaussian that is left of a blur [px] beside a box."""
    return np.sqrt(np.maximum(blur * blur - box * box / 12.0, MIN_GAUSSIAN_PX**2))


def line_moments(
    lines: Lines, shift_px: Array, growth_px: float, blur: Array, box: Array, with_neighbours: bool
) -> Array:
    """Return the moments (p, 4, 4) of three columns and the brightness about their means on each line.

    The columns are the derivatives of the brightness, over the contrast, with the contrast, the displacement
    and the logarithm of the blur, at ``shift_px`` (p,) from the prediction, with ``blur`` and its ``box`` (p,).
    """
    row, value, weight = lines.row, lines.pixels[:, :, VALUE], lines.pixels[:, :, WEIGHT]
    s = row[:, SIDE]
    square = blur * blur
    sigma = gaussian_part(blur, box)
    distance = lines.pixels[:, :, DISTANCE] - (shift_px - square * row[:, BEND])[:, None]
    rise, slope, wider = edge_profile(distance, sigma[:, None], box[:, None])
    if with_neighbours:
        # The neighbours grow the other way, and bend by their own radius.
        grown = (2.0 * growth_px) * s - square * row[:, BEND]
        for offset in (
            grown - row[:, OUTWARD_PX] + square * row[:, OUTWARD_BEND],
            grown + row[:, INWARD_PX] + square * row[:, INWARD_BEND],
        ):
            away = np.minimum(np.maximum(distance + offset[:, None], -FAR_PX), FAR_PX)
            r, l, w = edge_profile(away, sigma[:, None], box[:, None])
            rise, slope, wider = rise - r, slope - l, wider - w
    basis = np.empty((len(s), 4, SAMPLES))
    np.multiply(s[:, None], rise, out=basis[:, 0])
    np.multiply(-s[:, None], slope, out=basis[:, 1])
    np.multiply((s * square / sigma)[:, None], wider, out=basis[:, 2])
    basis[:, 3] = value - row[:, LEVEL, None]
    weighted = basis * weight[:, None, :]
    # About the means of each line: its level is eliminated.
    sums = weighted.sum(axis=2)
    gram = weighted @ basis.transpose(0, 2, 1)
    gram -= (sums / np.maximum(row[:, TOTAL], 1.0)[:, None])[:, :, None] * sums[:, None, :]
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
    """Solve each line for its contrast and displacement, and for its blur where ``free_blur``.

    Lines without contrast say nothing about that of the target: where something lies across its middle, they are
    the greater part.
    """
    contrast, shift, wider, inverse, rest = solve_lines(gram, free_blur)
    seen = contrast > MIN_CONTRAST
    middle = median(contrast[seen]) if np.count_nonzero(seen) >= MIN_EDGES else 0.0
    noise = max(median(line_noise(rest, lines.row[:, TOTAL])), MIN_VARIANCE)
    delta, sigma2, valid = displacements(lines, gram, contrast, shift, inverse, rest, middle, noise)
    seen_contrast = np.maximum(contrast, 1.0)
    expected = noise * inverse / (seen_contrast * seen_contrast) + MODEL_VARIANCE_PX2
    clipped = lines.row[:, CLIPPED]
    if ((1.0 - clipped) * valid).sum() >= ENOUGH_UNCLIPPED:
        # Glare moves single edges; where nearly all are clipped they grow alike.
        sigma2 = sigma2 + CLIPPED_ERROR_PX**2 * clipped
        expected = expected + CLIPPED_ERROR_PX**2 * clipped
    ok = middle > MIN_CONTRAST and bool(np.count_nonzero(valid) >= MIN_EDGES)
    return Measured(ok, delta, sigma2, valid, wider / seen_contrast, expected, middle)


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

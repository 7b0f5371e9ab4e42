"""The light on a small target: everything that its brightness depends on linearly.

In one light there are a level, a contrast, what the outermost edge has in addition, and gradients of level and
contrast across the target. With several lights each sector has a level and a contrast of its own, and pixels that
disagree lose their weight.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.area_model import ALL, EX, EY, FIRST, OUTERMOST, PARAMETERS, PATTERN
from vision.robust import inverted, median, normal_equations, times
from vision.view import either

Array = NDArray[np.float64]
Int = NDArray[np.int64]
Image = NDArray[np.uint8]

CLIPPED_LEVEL = 253.0
RIDGE = 1e-3
"""Keeps levels that no pixel shows from being undetermined [1 / brightness^2]."""
MIN_SCALE = 0.5


class Light(NamedTuple):
    """The light that fits best: ``columns`` (n, m) of what is linear, the contrast at each pixel (n,), what the
    outermost edge has in addition, the median contrast; residual and weight (n,), the residuals' 1-sigma ``scale``.
    """

    ok: bool
    columns: Array
    pixel_contrast: Array
    outer: float
    contrast: float
    residual: Array
    weight: Array
    scale: float
    ridge: float


def colours(image: Image, column: Int, row: Int) -> tuple[Array, Array, Array]:
    """Return blue, green and red of pixels, all (n,)."""
    seen = image[row, column].astype(np.float64)
    return seen[:, 0], seen[:, 1], seen[:, 2]


def sector_of(ex: Any, ey: Any, sectors: int) -> Any:
    """Return in which of so many equal sectors directions lie."""
    turn = np.arctan2(ey, ex) / (2.0 * np.pi)
    return np.minimum((turn - np.floor(turn)) * sectors, sectors - 1.0).astype(np.int64)


def sector_sums(sector: Int, agrees: NDArray[np.bool_], sectors: int) -> tuple[Array, Array]:
    """Return how many pixels there are in each sector and how many of them agree."""
    return (
        np.bincount(sector, minlength=sectors).astype(np.float64),
        np.bincount(sector[agrees], minlength=sectors).astype(np.float64),
    )


def light_columns(pattern: Array, sectors: int) -> Array:
    """Return the columns (n, m) of everything that is linear."""
    ex, ey, all_, first = pattern[:, EX], pattern[:, EY], pattern[:, PATTERN], pattern[:, OUTERMOST]
    if sectors == 1:
        columns = np.empty((len(ex), 7))
        columns[:, 0], columns[:, 1], columns[:, 2], columns[:, 3] = 1.0, all_, first, ex
        columns[:, 4], columns[:, 5], columns[:, 6] = ey, ex * all_, ey * all_
        return columns
    columns = np.zeros((len(ex), 2 * sectors + 1))
    sector = sector_of(ex, ey, sectors)
    for k in range(sectors):
        mine = either(sector == k, 1.0, 0.0)
        columns[:, k], columns[:, sectors + k] = mine, mine * all_
    columns[:, 2 * sectors] = first
    return columns


def solve_light(
    pattern: Array, value: Array, beyond: Array, sectors: int, limit: float, fixed_weight: Array
) -> Light:
    """Return the light under which the pattern fits the brightness best, with robust weights.

    ``limit`` is the residual beyond which a pixel in one of several lights loses its weight, where it is finite;
    ``fixed_weight`` replaces all weights where it is not empty. ``beyond`` (n,) is the share of each pixel's light that
    may come from outside the white board; what is there differs from white by about the contrast, and that is an error
    of the pixel beside its noise.
    """
    columns = light_columns(pattern, sectors)
    alone = pattern[:, PATTERN] == pattern[:, OUTERMOST]
    if alone.all():
        # A disc has one edge only.
        columns[:, 2 if sectors == 1 else 2 * sectors] = 0.0
    weight = fixed_weight if len(fixed_weight) else np.ones(len(value))
    residual, coefficients, scale = value, np.zeros(columns.shape[1]), MIN_SCALE
    for _ in range(1 if len(fixed_weight) else 3):
        matrix, vector = normal_equations(columns, weight, value)
        for k in range(columns.shape[1]):
            matrix[k, k] += RIDGE
        ok, inverse = inverted(matrix)
        if not ok:
            return Light(False, columns, value, 0.0, 0.0, value, weight, 0.0, RIDGE)
        coefficients = times(inverse, vector)
        residual = value - times(columns, coefficients)
        if len(fixed_weight):
            break
        size = np.abs(residual)
        scale = max(1.4826 * median(size), MIN_SCALE)
        if sectors == 1:
            weight = np.minimum(1.0, 2.5 * scale / np.maximum(size, 1e-9))
        else:
            bound = limit if np.isfinite(limit) else 2.5 * scale
            weight = 1.0 / (1.0 + (residual / bound) ** 4)
        strange = beyond * (np.abs(coefficients[1 if sectors == 1 else sectors]) / scale)
        weight = weight / (1.0 + strange * strange)
    if sectors == 1:
        contrast = coefficients[1] + columns[:, 3] * coefficients[5] + columns[:, 4] * coefficients[6]
        outer = coefficients[2]
    else:
        contrast, outer = np.zeros(len(value)), coefficients[2 * sectors]
        for k in range(sectors):
            contrast += columns[:, k] * coefficients[sectors + k]
    contrast = np.maximum(contrast, 0.0)
    return Light(True, columns, contrast, outer, median(contrast), residual, weight, scale, RIDGE)


def brightness_rows(pattern: Array, light: Light, free: Int) -> tuple[Array, Array]:
    """Return how the brightness changes with the ``free`` parameters and with the light (n, m), and with what is
    considered (n, 4).
    """
    n, n_free, n_light = len(pattern), len(free), light.columns.shape[1]
    rows, considered = np.empty((n, n_free + n_light)), np.empty((n, 4))
    for k in range(n_free):
        rows[:, k] = (
            pattern[:, ALL + free[k]] * light.pixel_contrast + pattern[:, FIRST + free[k]] * light.outer
        )
    for k in range(n_light):
        rows[:, n_free + k] = light.columns[:, k]
    for k in range(4):
        at = PARAMETERS + k
        considered[:, k] = pattern[:, ALL + at] * light.pixel_contrast + pattern[:, FIRST + at] * light.outer
    return rows, considered

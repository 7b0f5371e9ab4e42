"""Gauss-Newton steps on all pixels of a small target: its equations at a place, and the way to the best place."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.area_light import brightness_rows, solve_light
from vision.area_model import (
    BLUR,
    FILTER,
    GROWTH,
    PARAMETERS,
    Blur,
    Pixels,
    offsets,
    pattern_rows,
    share_beyond,
    total_blur_px,
)
from vision.area_pixels import chosen
from vision.lines import Edges
from vision.plane import rotation_xy
from vision.robust import inverted, normal_equations, times
from vision.view import View, turned

Array = NDArray[np.float64]

GROWTH_SIGMA_PX = 0.12
BLUR_LOG_SIGMA = 0.3
FILTER_SIGMA = 0.08
"""Prior 1-sigma of the growth of red, of the logarithm of the blur and of the share of a pixel that a camera's
filter gives to each neighbour."""
START_BLUR_PX = 0.62
MIN_WIDTH_PX, MAX_WIDTH_PX = 0.293, 4.0
MIN_SPILL, MAX_SPILL = -0.12, 0.24
MIN_PIXELS = 24
MIN_VARIANCE = 0.08
"""Variance of the rounding to whole numbers, the least noise of a pixel."""
LOOSE = 60.0
"""Residual beyond which a pixel loses its weight at the start, where parts may be covered [brightness]."""


class AreaModel(NamedTuple):
    """What is compared with the pixels: the target's ``edges``, the white margin around them, the plane's length per
    pixel, the prior of the tilt (zero: fixed) and the number of sectors with their own light.
    """

    edges: Edges
    margin_m: float
    unit: float
    tilt_sigma_rad: float
    sectors: int


class Place(NamedTuple):
    """Where the target is, and what blurs it. ``limit`` is the residual beyond which a pixel loses its weight."""

    camera_view: View
    centre: Array
    kappa: float
    tilt: Array
    blur: Blur
    limit: float


class Equations(NamedTuple):
    """The linearised equations: the inverse of the normal matrix times the noise's variance, the parameters' change
    (8,), residual and weight of each pixel, the rows (n, m), the prior's part of the normal matrix's diagonal (m,), how
    the rows move with what is considered (n, 4).
    """

    ok: bool
    inverse: Array
    change: Array
    residual: Array
    weight: Array
    mean_square: float
    variance: float
    contrast: float
    rows: Array
    prior: Array
    considered: Array
    limit: float


def within(model: AreaModel, pixels: Pixels, place: Place) -> Pixels:
    """Return the pixels of the target and of the white around it, as far as it is white."""
    white_px = max(place.kappa * model.margin_m / model.unit - 1.2, 0.8)
    reach = place.kappa * model.edges.radius_m[0] + min(3.0, white_px) * model.unit
    ex, ey = offsets(place.camera_view, pixels, place.centre)
    return chosen(pixels, np.sqrt(ex * ex + ey * ey) < reach)


def linearised(model: AreaModel, pixels: Pixels, place: Place, fixed_weight: Array) -> Equations:
    """Linearise at a place; not ok where the target's contrast is missing.

    ``fixed_weight`` replaces the choice of weights where it is not empty.
    """
    if len(pixels.u) < MIN_PIXELS:
        return no_equations()
    pattern = pattern_rows(place.camera_view, pixels, place.centre, place.kappa, model.edges, place.blur)
    beyond = np.zeros(len(pixels.u))
    if pixels.filtered:
        # On the way there, and where all pixels would be too many, the board is taken as endless: a place with a wrong
        # scale would have all that contradicts it beyond.
        board = place.kappa * (model.edges.radius_m[0] + model.margin_m)
        beyond = share_beyond(place.camera_view, pixels, place.centre, board, total_blur_px(place.blur))
    light = solve_light(pattern, pixels.value, beyond, model.sectors, place.limit, fixed_weight)
    contrast = light.contrast
    if not (light.ok and contrast > 4.0 and contrast + light.outer > 3.0):
        return no_equations()
    free = free_parameters(model.tilt_sigma_rad)
    n_free = len(free)
    rows, considered = brightness_rows(pattern, light, free)
    residual, weight = light.residual, light.weight
    total = weight.sum()
    squares = (weight * residual * residual).sum()
    variance = max(squares / max(total - rows.shape[1], 1.0), MIN_VARIANCE)
    prior, offset = np.zeros(PARAMETERS), np.zeros(PARAMETERS)
    blur = place.blur
    prior[GROWTH], offset[GROWTH] = 1.0 / GROWTH_SIGMA_PX**2, -blur.growth_px
    prior[BLUR], offset[BLUR] = 1.0 / BLUR_LOG_SIGMA**2, -np.log(blur.width_px / START_BLUR_PX)
    prior[FILTER], offset[FILTER] = 1.0 / FILTER_SIGMA**2, -blur.spill
    if model.tilt_sigma_rad > 0.0:
        for k in range(2):
            prior[3 + k], offset[3 + k] = 1.0 / model.tilt_sigma_rad**2, -place.tilt[k]
    matrix, vector = normal_equations(rows, weight, residual)
    pulled = np.full(rows.shape[1], light.ridge)
    for k in range(n_free):
        pulled[k] = variance * prior[free[k]]
        vector[k] += pulled[k] * offset[free[k]]
    for k in range(rows.shape[1]):
        matrix[k, k] += pulled[k]
    ok, inverse = inverted(matrix)
    if not ok:
        return no_equations()
    solved = times(inverse, vector)
    change = np.zeros(PARAMETERS)
    for k in range(n_free):
        change[free[k]] = solved[k]
    limit = place.limit
    if np.isfinite(limit):
        limit = max(0.6 * limit, 3.0 * light.scale)
    mean_square = squares / max(total, 1e-9)
    return Equations(
        True,
        inverse * variance,
        change,
        residual,
        weight,
        mean_square,
        variance,
        contrast,
        rows,
        pulled,
        considered,
        limit,
    )


def free_parameters(tilt_sigma_rad: float) -> NDArray[np.int64]:
    """Return the indices of the parameters that are estimated."""
    return np.array([0, 1, 2, 5, 6, 7]) if tilt_sigma_rad == 0.0 else np.arange(PARAMETERS)


def descend(
    model: AreaModel, pixels: Pixels, place: Place, fixed_weight: Array, iterations: int, tolerance: float
) -> tuple[Place, Equations, Pixels]:
    """Return the best place, the equations there, and the pixels that took part.

    With ``fixed_weight`` all pixels take part, with these weights.
    """
    if model.sectors > 1 and not len(fixed_weight):
        place = Place(place.camera_view, place.centre, place.kappa, place.tilt, place.blur, LOOSE)
    step, used = no_equations(), pixels
    for _ in range(iterations):
        if not len(fixed_weight):
            used = within(model, pixels, place)
        step = linearised(model, used, place, fixed_weight)
        if not step.ok:
            break
        change = step.change
        moved_x, moved_y = apparent_move(place.centre, change)
        size_without_blur = max(
            np.hypot(moved_x, moved_y) / model.unit,
            abs(change[2]) * model.edges.radius_m[0] / model.unit,
            abs(change[GROWTH]),
            np.hypot(change[3], change[4]) / 0.1,
        )
        size = max(size_without_blur, 2.0 * abs(change[BLUR]))
        share = min(1.0, 0.5 / max(size, 1e-12))
        change = change * share
        view = place.camera_view
        if model.tilt_sigma_rad > 0.0:
            view = turned(view, rotation_xy(change[3], change[4]) @ view.rotation)
        width = min(max(place.blur.width_px * np.exp(change[BLUR]), MIN_WIDTH_PX), MAX_WIDTH_PX)
        spill = min(max(place.blur.spill + change[FILTER], MIN_SPILL), MAX_SPILL)
        wider = np.log(width / place.blur.width_px)
        blur = Blur(width, place.blur.growth_px + change[GROWTH], spill)
        kappa = place.kappa + change[2]
        place = Place(view, place.centre + change[:2], kappa, place.tilt + change[3:5], blur, step.limit)
        if not (kappa > 0.0 and np.isfinite(place.centre).all()):
            return place, no_equations(), used
        # A blur that has come to its limit does not move.
        if max(size_without_blur * share, 2.0 * abs(wider)) < tolerance:
            break
    return place, step, used


def apparent_move(centre: Array, change: Array) -> tuple[float, float]:
    """Return how far the target moves in the image's plane: a tilt alone carries the plane's points along."""
    x, y = centre[0], centre[1]
    alpha, beta = change[3], change[4]
    return (
        change[0] + x * y * alpha - (1.0 + x * x) * beta,
        change[1] + (1.0 + y * y) * alpha - x * y * beta,
    )


def no_equations() -> Equations:
    """Return equations that are not ok."""
    nothing, none = np.zeros((0, 0)), np.zeros(0)
    return Equations(False, nothing, none, none, none, 0.0, 0.0, 0.0, nothing, none, nothing, 0.0)

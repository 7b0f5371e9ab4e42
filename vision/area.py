"""The photometric fit of a target so small that its edges run into each other.

All pixels of the target are compared with the sum of its blurred edges (``vision.area_model``); light and its
gradient, and the brightness of what surrounds the outermost edge, are eliminated linearly (``vision.area_light``).
Several scales are tried, because a blob says little about which of its edges it shows, and a plain disc of the same
size must fit clearly worse.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.area_covariance import sandwich
from vision.area_light import sector_of, sector_sums
from vision.area_model import GROWTH, Blur, Pixels, offsets, total_blur_px
from vision.area_pixels import take_pixels, thinned
from vision.area_steps import (
    MIN_PIXELS,
    START_BLUR_PX,
    AreaModel,
    Equations,
    Place,
    descend,
    free_parameters,
    linearised,
    within,
)
from vision.lines import Edges
from vision.plane import LevelPlane
from vision.refine import Fit
from vision.robust import normal_equations, times
from vision.view import View, units_per_pixel

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SOME_PIXELS = 1200
ROUGH_PIXELS = 300
"""About so many of a target's pixels are compared where they are too many for all, and at first."""
CLIPPED_ERROR_PX = 0.01
MAX_MISFIT = 0.2
"""Residual, as a share of the contrast, beyond which the rough fit is not refined."""
SCALES = (0.88, 0.94, 1.0, 1.06, 1.12)
"""What is tried around a scale that a search gave."""


class AreaSolution(NamedTuple):
    """What ``solve_area`` found; names as in ``Fit``, with the plane's ``rotation``. Undefined where not ``ok``."""

    ok: bool
    rotation: Array
    centre: Array
    kappa: float
    tilt: Array
    covariance: Array
    considered: Array
    residual: float
    share: float
    blur_px: float
    growth_px: float
    growth_sigma_px: float
    gain: float
    points_px: Array
    agrees: NDArray[np.bool_]
    red_slope: float
    contradicted: float


AreaSolver = Callable[[Image, View, Array, float, Edges, float, float, int, Array], AreaSolution]


def fit_area(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges: Edges,
    *,
    margin_m: float,
    tilt_sigma_rad: float = 0.0,
    sectors: int = 1,
    scales: tuple[float, ...] = SCALES,
    solver: AreaSolver | None = None,
) -> Fit | None:
    """Fit the whole target at once; parameters and result as in ``fit_profiles``.

    ``margin_m`` is the width of white around the outermost edge [m]. With ``sectors`` above one each sector
    has its own light, and pixels that disagree lose their weight: for shadows, glare and things in front of
    the target. ``solver`` is ``solve_area`` or its compiled form.
    """
    solve = solve_area if solver is None else solver
    s = solve(
        image,
        plane.view,
        centre,
        float(kappa),
        edges,
        float(margin_m),
        float(tilt_sigma_rad),
        sectors,
        np.array(scales),
    )
    if not s.ok:
        return None
    return Fit(
        LevelPlane(plane.camera, s.rotation, plane.rate_cam_radps),
        s.centre,
        s.kappa,
        s.tilt,
        s.covariance,
        s.considered,
        s.residual,
        s.share,
        tuple(range(len(edges.radius_m))),
        s.blur_px,
        s.growth_px,
        s.growth_sigma_px,
        s.gain,
        int(np.count_nonzero(s.agrees)),
        len(edges.radius_m),
        tilt_sigma_rad > 0.0,
        s.points_px,
        s.agrees,
        s.red_slope,
        s.contradicted,
        True,
    )


def solve_area(
    image: Image,
    view: View,
    centre: Array,
    kappa: float,
    edges: Edges,
    margin_m: float,
    tilt_sigma_rad: float,
    sectors: int,
    scales: Array,
) -> AreaSolution:
    """Do the work of ``fit_area`` on plain arrays."""
    unit = float(units_per_pixel(view, centre[0], centre[1]))
    model = AreaModel(edges, margin_m, unit, tilt_sigma_rad, sectors)
    pixels, clipped = take_pixels(image, view, centre, kappa * edges.radius_m[0] * scales.max(), 4.0)
    few = thinned(pixels, ROUGH_PIXELS)
    sharp = Blur(START_BLUR_PX, 0.0, 0.0)
    one_light = AreaModel(edges, margin_m, unit, 0.0, 1)
    best, start = np.inf, 0.0
    if len(few.u) >= MIN_PIXELS:
        for scale in scales:
            place = Place(view, centre, kappa * scale, np.zeros(2), sharp, np.inf)
            trial = linearised(one_light, within(one_light, few, place), place, np.zeros(0))
            if trial.ok and trial.mean_square / trial.contrast**2 < best:
                best, start = trial.mean_square / trial.contrast**2, kappa * scale
    if start == 0.0:
        return _nothing(view, centre)
    place = Place(view, centre, start, np.zeros(2), sharp, np.inf)
    place, step, used = descend(model, few, place, np.zeros(0), 8, 0.03)
    if not step.ok or step.mean_square > (MAX_MISFIT * step.contrast) ** 2:
        return _nothing(view, centre)
    if not pixels.filtered:
        pixels = thinned(pixels, SOME_PIXELS)
    place, step, used = descend(model, pixels, place, np.zeros(0), 12, 0.002)
    if not step.ok:
        return _nothing(view, centre)
    # The same pixels with the same weights, explained by a disc.
    disc = AreaModel(
        Edges(edges.radius_m[:1], edges.side[:1], edges.near_m[:1], edges.far_m[:1]),
        margin_m,
        unit,
        0.0,
        sectors,
    )
    alone_px = Pixels(used.u, used.v, used.value, used.red, used.corner, used.across, used.down, False)
    blur = Blur(total_blur_px(place.blur), 0.0, 0.0)
    alone = Place(place.camera_view, place.centre, place.kappa, np.zeros(2), blur, np.inf)
    _, plain, _ = descend(disc, alone_px, alone, step.weight, 6, 0.03)
    gain = plain.mean_square / step.mean_square if plain.ok else 1.0
    if not plain.ok:
        # Nothing holds a disc where the white around it has lost its weight.
        _, plain, _ = descend(disc, alone_px, alone, np.ones(len(used.u)), 6, 0.03)
        all_alike = (step.residual * step.residual).mean()
        gain = plain.mean_square / all_alike if plain.ok else 1.0
    return _result(model, place, step, used, gain, clipped)


def _result(
    model: AreaModel, place: Place, step: Equations, pixels: Pixels, gain: float, clipped: bool
) -> AreaSolution:
    free = free_parameters(model.tilt_sigma_rad)
    spread = sandwich(step.rows, step.weight, step.residual, step.inverse, step.variance, step.prior, pixels)
    covariance, considered = np.zeros((5, 5)), np.zeros((5, 4))
    growth_sigma = 0.0
    for i in range(len(free)):
        if free[i] == GROWTH:
            growth_sigma = np.sqrt(spread[i, i])
        if free[i] < 5:
            for j in range(len(free)):
                if free[j] < 5:
                    covariance[free[i], free[j]] = spread[i, j]
    if clipped:
        # Half of every edge is missing, and with it what keeps scale and blur apart.
        covariance[2, 2] += (CLIPPED_ERROR_PX * model.unit / model.edges.radius_m[0]) ** 2
    for k in range(4):
        _, pulled = normal_equations(step.rows, step.weight, step.considered[:, k])
        shift = times(step.inverse, pulled) / step.variance
        for i in range(len(free)):
            if free[i] < 5:
                considered[free[i], k] = -shift[i]
    agrees = np.abs(step.residual) < max(3.5 * np.sqrt(step.variance), 0.12 * step.contrast)
    ex, ey = offsets(place.camera_view, pixels, place.centre)
    inside = agrees & (np.sqrt(ex * ex + ey * ey) < 0.97 * place.kappa * model.edges.radius_m[0])
    slope = 0.0
    if np.count_nonzero(inside) > 8:
        value, red = pixels.value[inside], pixels.red[inside]
        value = value - value.mean()
        slope = (value * red).sum() / max((value * value).sum(), 1e-9)
    # What covers a target covers one side more than the other; another pattern disagrees all round.
    laid, agreeing = sector_sums(sector_of(ex, ey, 8), agrees, 8)
    share = agreeing / np.maximum(laid, 1.0)
    whole = np.count_nonzero(agrees) / len(agrees)
    even = whole < 0.9 and share.max() - share.min() < 0.2
    points = np.empty((len(pixels.u), 2))
    points[:, 0], points[:, 1] = pixels.u, pixels.v
    return AreaSolution(
        True,
        place.camera_view.rotation,
        place.centre,
        place.kappa,
        place.tilt,
        covariance,
        considered,
        np.sqrt(step.variance) / step.contrast,
        whole,
        total_blur_px(place.blur),
        place.blur.growth_px,
        growth_sigma,
        gain,
        points,
        agrees,
        slope,
        1.0 - whole if even else 0.0,
    )


def _nothing(view: View, centre: Array) -> AreaSolution:
    nothing, none = np.zeros((0, 0)), np.zeros(0)
    no = np.zeros(0, dtype=np.bool_)
    return AreaSolution(
        False, view.rotation, centre, 0.0, none, nothing, nothing, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, nothing, no, 0.0, 0.0
    )  # fmt: skip

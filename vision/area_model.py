"""The brightness of a small target, pixel by pixel, and how it changes with where the target is.

A target whose edges run into each other is the sum of its blurred edges,

    P = sum_k s_k E(d_k)      d_k = (rho - kappa r_k) / |grad rho| + sigma^2 c_k / 2 - s_k g

with rho the distance from the centre in the level plane, s_k = +1 for the outside of red and -1 for the edge of a
hole, c_k the edge's curvature in the image and g the growth of red (``vision.refine``). E is the step blurred by the
lens, a Gaussian of 1-sigma ``sigma``, and by the pixel's own square, part by part. What a camera does to the
picture after that, pixel by pixel (interpolation of colours, smoothing, sharpening), is a filter of neighbouring
pixels, (b, 1 - 2 b, b) along both axes: where rings are as narrow as pixels this is not the same as a wider lens.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.lines import Edges
from vision.profile import FAR_PX, edge_profile, phi, pixel_box
from vision.view import View, either, pixel_rays, plane_gradient, rays_to_plane, to_pixels, units_per_pixel

Array = NDArray[np.float64]

PARAMETERS = 8
"""Centre x, y, kappa, tilt x, y, growth, logarithm of the blur, and the filter of neighbouring pixels."""
GROWTH, BLUR, FILTER = 5, 6, 7
EX, EY, PATTERN, OUTERMOST = 0, 1, 2, 3
"""Columns of ``pattern_rows``: place over the outermost radius, the sum over all edges, and the outermost alone."""
ALL, FIRST, WIDTH = 4, 16, 28
"""Where the derivatives of both begin: eight parameters, then what ``Fit.considered`` names."""
MIN_LENS_PX = 0.05
PIXEL_VARIANCE = 1.0 / 12.0
FINE_PX = 24.0
"""Outer diameter below which a pixel is taken in 4x4 parts, else in 2x2: its smallest rings are no larger then."""
FAR = 5.0
"""Distance from an edge, in units of sigma, beyond which nothing is left of it."""


class Pixels(NamedTuple):
    """Pixels around the target, all (n,): coordinates, brightness (of blue and green) and red.

    They are taken from a box of ``across`` x ``down`` pixels whose first is ``corner`` (2,); with ``filtered`` the
    model's pixels are filtered with their neighbours.
    """

    u: Array
    v: Array
    value: Array
    red: Array
    corner: Array
    across: int
    down: int
    filtered: bool


class Blur(NamedTuple):
    """What blurs the target: the lens with a pixel's own ``width_px``, the ``growth_px`` of red, and the camera's
    filter, the share ``spill`` of a pixel that goes to each neighbour.
    """

    width_px: float
    growth_px: float
    spill: float


def total_blur_px(blur: Blur) -> float:
    """Return the 1-sigma of everything that blurs [px]."""
    return float(np.sqrt(max(blur.width_px**2 + 2.0 * blur.spill, MIN_LENS_PX**2)))


def lens_px(blur_px: float) -> float:
    """Return the 1-sigma of the lens beside the pixel's own width [px]."""
    return float(np.sqrt(max(blur_px * blur_px - PIXEL_VARIANCE, MIN_LENS_PX**2)))


def parts_of(diameter_px: float) -> int:
    """Return in how many parts a pixel's side is taken."""
    return 4 if diameter_px < FINE_PX else 2


def part_box(gu: Any, gv: Any, per: Any, lens: float, parts: int) -> tuple[Any, Any]:
    """Return the box and the Gaussian's 1-sigma across an edge [px] that a part of a pixel and the lens make, for the
    gradient (gu, gv) of rho and ``per`` pixels per unit of it.
    """
    box = pixel_box(gu * per, gv * per)
    return box / parts, np.sqrt(lens * lens + PIXEL_VARIANCE / parts**2 * (1.0 - box * box))


def bending_px(lens: float, parts: int) -> float:
    """Return the 1-sigma of what blurs along an edge and so bends it: the lens, and a part of a pixel."""
    return float(np.sqrt(lens * lens + PIXEL_VARIANCE / parts**2))


def edge_bend(sigma: Any, area: Any, per: Any, radius: Any) -> Any:
    """Return by how much a blur moves a curved edge inwards [px]: half its curvature times sigma^2.

    ``area`` is the plane's area per pixel, ``per`` the pixels per unit of rho, ``radius`` the edge's in the plane. The
    blur of a disc as small as itself moves its edge no further than half its radius.
    """
    lift = area * per
    return np.minimum(0.5 * sigma * sigma * lift * lift * per / radius, 0.5 * radius * per)


def edge_distance(rho: Any, radius: Any, per: Any, bend: Any, grown: Any) -> Any:
    """Return the distance from an edge [px], bounded where nothing changes any more."""
    return np.minimum(np.maximum((rho - radius) * per + bend - grown, -FAR_PX), FAR_PX)


def node_design(
    view: View, nx: Any, ny: Any, qx: Any, qy: Any, gu: Any, gv: Any, x: Any, y: Any, per: Any
) -> tuple[Any, ...]:
    """Return how far all edges move outwards [px] with centre x, y, tilt x, y, and with the relative focal length and
    the principal point.
    """
    return (
        nx * per,
        ny * per,
        (nx * qx * qy + ny * (1.0 + qy * qy)) * per,
        -(nx * (1.0 + qx * qx) + ny * qx * qy) * per,
        (gu * view.fx * x + gv * view.fy * y) * per,
        gu * per,
        gv * per,
    )


def offsets(view: View, pixels: Pixels, centre: Array) -> tuple[Array, Array]:
    """Return the places of all pixels in the level plane, from the centre, both (n,)."""
    x, y = pixel_rays(view, pixels.u, pixels.v)
    qx, qy = rays_to_plane(view, x, y, pixels.v)
    return qx - centre[0], qy - centre[1]


def share_beyond(view: View, pixels: Pixels, centre: Array, radius: float, blur_px: float) -> Array:
    """Return which share of a pixel's light may come from outside a circle of the level plane (n,), with a blur of
    1-sigma ``blur_px``: of a white board, the circle that it holds whichever way it is turned.
    """
    ex, ey = offsets(view, pixels, centre)
    stretch = radius / np.maximum(np.sqrt(ex * ex + ey * ey), 1e-9 * radius)
    u, v = to_pixels(view, centre[0] + stretch * ex, centre[1] + stretch * ey)
    away = np.sqrt((u - pixels.u) ** 2 + (v - pixels.v) ** 2)
    # From half way to the middle nothing is seen of it, and in the middle there is no direction to it.
    share: Array = either(stretch > 2.0, 0.0, phi(either(stretch < 1.0, away, -away) / blur_px))
    return share


def circle_bounds(view: View, centre: Array, radius: float) -> tuple[float, float, float, float]:
    """Return the least and largest u and v [px] of a circle of the level plane; NaN where it is not in front."""
    angle = np.arange(12) * (np.pi / 6.0)
    u, v = to_pixels(view, centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle))
    return float(u.min()), float(u.max()), float(v.min()), float(v.max())


def pattern_rows(view: View, pixels: Pixels, centre: Array, kappa: float, edges: Edges, blur: Blur) -> Array:
    """Return a row for each pixel (n, WIDTH): the pattern and its derivatives, as the columns above name them."""
    if not pixels.filtered:
        return sharp_rows(view, pixels.u, pixels.v, centre, kappa, edges, blur)
    index = np.arange(pixels.across * pixels.down)
    u = pixels.corner[0] + index % pixels.across
    v = pixels.corner[1] + index // pixels.across
    rows = sharp_rows(view, u, v, centre, kappa, edges, blur)
    at = (pixels.v - pixels.corner[1]).astype(np.int64), (pixels.u - pixels.corner[0]).astype(np.int64)
    box = rows.reshape(pixels.down, pixels.across, WIDTH)
    along_u, along_v = _second_difference(box, 1), _second_difference(box, 0)
    both = _second_difference(along_u, 0)
    out: Array = (box + blur.spill * (along_u + along_v + blur.spill * both))[at]
    out[:, EX], out[:, EY] = box[at][:, EX], box[at][:, EY]
    spilt = (along_u + along_v + 2.0 * blur.spill * both)[at]
    out[:, ALL + FILTER], out[:, FIRST + FILTER] = spilt[:, PATTERN], spilt[:, OUTERMOST]
    return out


def _second_difference(box: Array, axis: int) -> Array:
    """Return the sum of both neighbours along an axis less twice the pixel; beyond the box all is as at its border."""
    wide = np.pad(box, [(1, 1) if k == axis else (0, 0) for k in range(3)], mode="edge")
    n = box.shape[axis]
    before, after = wide.take(range(n), axis), wide.take(range(2, n + 2), axis)
    difference: Array = before + after - 2.0 * box
    return difference


def sharp_rows(
    view: View,
    u: Array,
    v: Array,
    centre: Array,
    kappa: float,
    edges: Edges,
    blur: Blur,
) -> Array:
    """Return the rows of pixels (u, v) before the camera's filter."""
    lens = lens_px(blur.width_px)
    unit = float(units_per_pixel(view, centre[0], centre[1]))
    outer = kappa * edges.radius_m[0]
    rk = kappa * edges.radius_m
    out = np.zeros((len(u), WIDTH))
    parts = parts_of(2.0 * outer / unit)
    across = bending_px(lens, parts)
    places, share = (np.arange(parts) + 0.5) / parts - 0.5, 1.0 / parts**2
    for dv in places:
        for du in places:
            x, y = pixel_rays(view, u + du, v + dv)
            qx, qy = rays_to_plane(view, x, y, v + dv)
            ex, ey = qx - centre[0], qy - centre[1]
            rho = np.maximum(np.sqrt(ex * ex + ey * ey), 1e-3 * unit)
            nx, ny = ex / rho, ey / rho
            gu, gv = plane_gradient(view, nx, ny, qx, qy, x, y)
            per = 1.0 / np.maximum(np.sqrt(gu * gu + gv * gv), 0.2 * unit)
            box, sigma = part_box(gu, gv, per, lens, parts)
            bend = edge_bend(across, unit * unit, per[:, None], rk)
            away = edge_distance(rho[:, None], rk, per[:, None], bend, edges.side * blur.growth_px)
            reach = FAR * sigma + 0.5 * box
            near = np.abs(away) < reach[:, None]
            rise, steep, wider = edge_profile(away, sigma[:, None], box[:, None])
            rise = np.where(near, rise, either(away > 0.0, 1.0, 0.0)) * edges.side
            steep = np.where(near, steep, 0.0) * edges.side
            wider = np.where(near, wider, 0.0) * edges.side * (blur.width_px**2 / sigma)[:, None]
            wider += steep * 2.0 * bend * (blur.width_px / across) ** 2
            scaled = steep * (edges.radius_m * per[:, None] + bend / kappa)
            grown = steep * edges.side
            design = node_design(view, nx, ny, qx, qy, gu, gv, x, y, per)
            out[:, EX] += share * ex / outer
            out[:, EY] += share * ey / outer
            for at, first in ((ALL, False), (FIRST, True)):
                total = [a[:, 0] if first else a.sum(axis=1) for a in (rise, steep, scaled, grown, wider)]
                out[:, PATTERN + first] += share * total[0]
                columns = node_columns(design, total[1], total[2], total[3], total[4])
                for k, column in enumerate(columns):
                    out[:, at + k] += share * column
    return out


def node_columns(design: tuple[Any, ...], steep: Any, scaled: Any, grown: Any, wider: Any) -> tuple[Any, ...]:
    """Return the derivatives of the pattern with the eight parameters and the four that are considered; that with the
    filter is zero here.
    """
    return (
        -steep * design[0],
        -steep * design[1],
        -scaled,
        -steep * design[2],
        -steep * design[3],
        -grown,
        wider,
        0.0 * steep,
        -steep * design[4],
        -steep * design[5],
        -steep * design[6],
        -steep,
    )

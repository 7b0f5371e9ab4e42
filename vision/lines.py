"""Lines of pixels across the target's edges, and how the edges move on them.

Nothing is interpolated: a line consists of the integer pixels nearest to points along the radius, each with
its exact distance from the edge through its own ray. Geometry is linearised once, where the lines are laid:
the edge's displacement on a line, in pixels, is the line's row of ``design`` times the change of the
parameters.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.view import (
    View,
    inside,
    pixel_rays,
    plane_gradient,
    rays_to_plane,
    to_pixels,
    units_per_pixel,
)

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Image = NDArray[np.uint8]

SAMPLES = 7
"""Pixels on a line across an edge."""
MIN_GAP_PX = 3.5
"""Edges closer than this to their neighbour are left out."""
MIN_RADIUS_PX = 3.5
HALF_LENGTH_PX = 3.2
MIN_HALF_LENGTH_PX = 2.6
MIN_LINES = 12
ENOUGH_SEEN, LEAST_SEEN = 0.6, 0.03
"""Share of the lines that lie in the image, below which more are laid; of a share below the second no more than for it:
near the deck a few degrees of a ring may be all that is seen.
"""
CLIPPED_LEVEL = 253
"""Brightness from which a pixel says only that it was brighter."""
STEP = 0.002
"""Size of the second circle that shows the direction of the radius, relative to the outermost edge."""


class Edges(NamedTuple):
    """A target's edges, all (k,): radius [m], side (+1 outside of red, -1 edge of a hole), and the
    distances to the nearer and to the farther neighbour [m]."""

    radius_m: Array
    side: Array
    near_m: Array
    far_m: Array


def edges_of(radii_m: Array) -> Edges:
    """Return the edges of radii that descend from the outside in."""
    steps = -np.diff(radii_m)
    outward = np.concatenate(([np.inf], steps))
    inward = np.concatenate((steps, [2.0 * radii_m[-1]]))
    return Edges(
        np.array(radii_m), edge_sides(len(radii_m)), np.minimum(outward, inward), np.maximum(outward, inward)
    )


def edge_sides(n_edges: int) -> Array:
    """Return +1 for the outside of red (even edges), -1 for the edge of a hole."""
    return np.where(np.arange(n_edges) % 2 == 0, 1.0, -1.0)


def usable_edges(edges: Edges, to_px: float, blur_px: float) -> NDArray[np.bool_]:
    """Return which edges can be measured one by one, at ``to_px`` pixels per metre and with such a blur."""
    near, far = edges.near_m * to_px, edges.far_m * to_px
    apart = (near > MIN_GAP_PX) | ((near > 0.7 * MIN_GAP_PX) & (far > 1.4 * MIN_GAP_PX))
    usable: NDArray[np.bool_] = apart & (edges.radius_m * to_px > max(MIN_RADIUS_PX, 3.0 * blur_px))
    return usable


class Lines(NamedTuple):
    """Lines of pixels across edges, p lines of m pixels.

    ``pixels`` (p, m, 4): DISTANCE of each pixel outward from the edge as predicted [px], its VALUE
    (brightness), its RED, and its WEIGHT, zero for repeated and missing pixels. ``edge`` (p,) the edge's index.
    ``row`` (p, 25): the columns named below; DESIGN begins the change of the edge's displacement with the
    centre x, y, kappa, tilt x, y and the growth of red [px], CONSIDERED that with the relative focal length, the
    principal point and an outward move of all edges [px].
    """

    pixels: Array
    edge: IntArray
    row: Array


DISTANCE, VALUE, RED, WEIGHT = 0, 1, 2, 3
TOTAL = 0
"""Sum of a line's weights."""
SIDE, LEVEL = 1, 2
"""+1 outside of red, -1 edge of a hole; mean brightness."""
HALF_PX, GAP_PX = 3, 4
"""Half the line's length; distance to the nearer neighbouring edge."""
BEND = 5
"""Curvature of the edge [1/px], halved."""
OUTWARD_PX, INWARD_PX, OUTWARD_BEND, INWARD_BEND = 6, 7, 8, 9
"""Distances to the neighbouring edges (infinite where there is none) and their bend."""
U0, V0, NU, NV = 10, 11, 12, 13
"""Place of the edge and its normal in the image."""
DESIGN, CONSIDERED = 14, 20
CLIPPED, COLUMNS = 24, 25
"""One where some pixel of the line is as bright as can be, else zero."""


def empty_lines(n: int) -> Lines:
    """Return ``n`` lines whose content is undefined."""
    return Lines(np.empty((n, SAMPLES, 4)), np.empty(n, dtype=np.int64), np.empty((n, COLUMNS)))


def line_counts(
    view: View, centre: Array, kappa: float, edges: Edges, blur_px: float, n_lines: int
) -> tuple[IntArray, Array]:
    """Return the edges that can be measured and how many lines each should have, both (k,)."""
    to_px = kappa / units_per_pixel(view, centre[0], centre[1])
    usable = np.flatnonzero(usable_edges(edges, to_px, blur_px))
    want = np.minimum(np.maximum(2.5 * to_px * edges.radius_m[usable], 10.0), 30.0)
    want *= min(1.0, n_lines / max(want.sum(), 1.0))
    return usable, np.maximum(want, 6.0)


def line_half_px(gap_px: Any, blur_px: float) -> Any:
    """Return half the length of lines across edges with this gap to the nearer neighbour."""
    longest = max(HALF_LENGTH_PX, 3.0 * blur_px)
    return np.minimum(np.maximum(0.6 * gap_px, MIN_HALF_LENGTH_PX), longest)


def lay_lines(
    image: Image,
    view: View,
    centre: Array,
    kappa: float,
    edges: Edges,
    blur_px: float,
    n_lines: int,
) -> Lines:
    """Lay lines of pixels across the edges that lie inside the image; none where there are too few."""
    usable, want = line_counts(view, centre, kappa, edges, blur_px, n_lines)
    if not len(usable):
        return empty_lines(0)
    edge, cos, sin, u, v = _place(view, centre, kappa, edges, usable, want)
    seen_line = inside(view, u[0], v[0], 1.5)
    seen = float(seen_line.mean())
    if seen < ENOUGH_SEEN:
        edge, cos, sin, u, v = _place(view, centre, kappa, edges, usable, want / max(seen, LEAST_SEEN))
        seen_line = inside(view, u[0], v[0], 1.5)
    if not seen_line.all():
        edge, cos, sin, u, v = (
            edge[seen_line],
            cos[seen_line],
            sin[seen_line],
            u[:, seen_line],
            v[:, seen_line],
        )
    if len(edge) < MIN_LINES:
        return empty_lines(0)
    u0, v0 = u[0], v[0]
    du, dv = u[1] - u0, v[1] - v0
    length = np.hypot(du, dv)
    # Pixels per metre on the target along the radius: the second circle is STEP larger.
    gap = edges.near_m[edge] * (length / (STEP * edges.radius_m[0]))
    half = line_half_px(gap, blur_px)
    reach = (half / length)[:, None] * np.linspace(-1.0, 1.0, SAMPLES)
    ui = np.rint(u0[:, None] + reach * du[:, None])
    vi = np.rint(v0[:, None] + reach * dv[:, None])
    weight = np.ones(ui.shape)
    # The same pixel twice on a line says nothing new; pixels outside the image say nothing.
    weight[:, 1:] = (np.diff(ui, axis=1) != 0.0) | (np.diff(vi, axis=1) != 0.0)
    w, h = view.width - 1.0, view.height - 1.0
    if ui.min() < 0.0 or vi.min() < 0.0 or ui.max() > w or vi.max() > h:
        weight[(ui < 0.0) | (vi < 0.0) | (ui > w) | (vi > h)] = 0.0
        ui, vi = np.clip(ui, 0.0, w), np.clip(vi, 0.0, h)
    lines = empty_lines(len(edge))
    pixels, row = lines.pixels, lines.row
    colour = image[vi.astype(np.intp), ui.astype(np.intp)]
    value = 0.5 * (colour[..., 0].astype(np.float64) + colour[..., 1])
    pixels[:, :, VALUE], pixels[:, :, RED], pixels[:, :, WEIGHT] = value, colour[..., 2], weight
    total = weight.sum(axis=1)
    row[:, TOTAL] = total
    row[:, CLIPPED] = (colour[..., :2] >= CLIPPED_LEVEL).any(axis=(1, 2))
    row[:, LEVEL] = (value * weight).sum(axis=1) / np.maximum(total, 1.0)

    x, y = pixel_rays(view, ui, vi)
    qx, qy = rays_to_plane(view, x, y, vi)
    rho = np.hypot(qx - centre[0], qy - centre[1])
    rk = kappa * edges.radius_m[edge]
    # The gradient of rho in the image, at the edge itself.
    xm, ym = pixel_rays(view, u0, v0)
    qxm, qym = centre[0] + rk * cos, centre[1] + rk * sin
    gu, gv = plane_gradient(view, cos, sin, qxm, qym, xm, ym)
    slope = np.hypot(gu, gv)
    per = 1.0 / slope
    side = edges.side[edge]
    pixels[:, :, DISTANCE] = (rho - rk[:, None]) * per[:, None]
    lines.edge[:] = edge
    for k, column in enumerate(line_design(cos, sin, qxm, qym, edges.radius_m[edge], per, side)):
        row[:, DESIGN + k] = column
    for k, column in enumerate(line_considered(view, gu, gv, xm, ym, per)):
        row[:, CONSIDERED + k] = column
    row[:, CONSIDERED + 3] = 1.0
    outward, inward = neighbours(edges)
    scale = kappa * per
    row[:, SIDE], row[:, HALF_PX], row[:, GAP_PX] = side, half, gap
    bent = bend_factor(view, qxm, qym, slope)
    row[:, BEND] = 0.5 * slope / rk * bent
    row[:, OUTWARD_PX] = (outward[edge] - edges.radius_m[edge]) * scale
    row[:, INWARD_PX] = (edges.radius_m[edge] - inward[edge]) * scale
    row[:, OUTWARD_BEND] = 0.5 / (outward[edge] * scale) * bent
    row[:, INWARD_BEND] = 0.5 / (np.maximum(inward[edge], 0.1 * edges.radius_m[-1]) * scale) * bent
    row[:, U0], row[:, V0] = u0, v0
    row[:, NU], row[:, NV] = row[:, CONSIDERED + 1], row[:, CONSIDERED + 2]
    return lines


def neighbours(edges: Edges) -> tuple[Array, Array]:
    """Return the radii of the next edge outwards (infinite for the outermost) and inwards (minus infinity),
    (k,).
    """
    outward, inward = np.full_like(edges.radius_m, np.inf), np.full_like(edges.radius_m, -np.inf)
    outward[1:] = edges.radius_m[:-1]
    inward[:-1] = edges.radius_m[1:]
    return outward, inward


def bend_factor(view: View, qx: Any, qy: Any, slope: Any) -> Any:
    """Return by how much an edge is more curved in the image than a circle of its scale along the radius.

    A circle of radius R in the plane has in the image the curvature A^2 / (slope^3 R), with A the plane's area per
    pixel at (qx, qy) and ``slope`` the gradient of the distance from the centre; without slant it is slope / R.
    """
    unit = units_per_pixel(view, qx, qy)
    ratio = unit * unit / (slope * slope)
    return ratio * ratio


def line_design(cos: Any, sin: Any, qx: Any, qy: Any, radius_m: Any, per: Any, side: Any) -> tuple[Any, ...]:
    """Return the columns of ``Lines.design`` for edge points (qx, qy) in the direction (cos, sin); ``per`` is
    in pixels per unit of the plane.
    """
    return (
        cos * per,
        sin * per,
        radius_m * per,
        (cos * qx * qy + sin * (1.0 + qy * qy)) * per,
        -(cos * (1.0 + qx * qx) + sin * qx * qy) * per,
        side,
    )


def line_considered(view: View, gu: Any, gv: Any, x: Any, y: Any, per: Any) -> tuple[Any, Any, Any]:
    """Return the columns of ``Lines.considered`` from the gradient of rho (gu, gv) and the rays (x, y)."""
    return (gu * view.fx * x + gv * view.fy * y) * per, gu * per, gv * per


def _place(
    view: View, centre: Array, kappa: float, edges: Edges, usable: IntArray, want: Array
) -> tuple[IntArray, Array, Array, Array, Array]:
    """Return edge, direction and, for the edge and a slightly larger circle, pixel coordinates (2, p)."""
    count = want.astype(np.int64)
    edge = np.repeat(usable, count)
    first = np.repeat(np.cumsum(count) - count, count)
    angle = line_angle(np.arange(len(edge)) - first, np.repeat(count, count), edge)
    cos, sin = np.cos(angle), np.sin(angle)
    radius = kappa * edges.radius_m[edge]
    both = np.stack((radius, radius + STEP * kappa * edges.radius_m[0]))
    u, v = to_pixels(view, centre[0] + both * cos, centre[1] + both * sin)
    return edge, cos, sin, u, v


def line_angle(index: Any, count: Any, edge: Any) -> Any:
    """Return the direction of the ``index``-th of ``count`` lines across an edge [rad]; edges are staggered."""
    return (index + 0.37 * edge) * (2.0 * np.pi / count)

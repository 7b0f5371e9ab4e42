"""Lines of pixels across the target's edges, and how the edges move on them.

Nothing is interpolated: a line consists of the integer pixels nearest to points along the radius, each with
its exact distance from the edge through its own ray. Geometry is linearised once, where the lines are laid:
the edge's displacement on a line, in pixels, is the line's row of ``design`` times the change of the
parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.plane import LevelPlane

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SAMPLES = 7
"""Pixels on a line across an edge."""
MIN_GAP_PX = 3.5
"""Edges closer than this to their neighbour are left out."""
MIN_RADIUS_PX = 3.5
HALF_LENGTH_PX = 3.2
MIN_HALF_LENGTH_PX = 2.6

_ALONG = np.linspace(-1.0, 1.0, SAMPLES)


@dataclass(frozen=True, slots=True)
class Edges:
    """A target's edges, all (k,): radius [m], side (+1 outside of red, -1 edge of a hole), and the
    distances to the nearer and to the farther neighbour [m]."""

    radius_m: Array
    side: Array
    near_m: Array
    far_m: Array

    @classmethod
    def of(cls, radii_m: Array) -> Edges:
        """Return the edges of radii that descend from the outside in."""
        steps = -np.diff(radii_m)
        outward = np.concatenate(([np.inf], steps))
        inward = np.concatenate((steps, [2.0 * radii_m[-1]]))
        near, far = np.minimum(outward, inward), np.maximum(outward, inward)
        return cls(radii_m, edge_sides(len(radii_m)), near, far)

    def usable(self, to_px: float, blur_px: float = 0.0) -> NDArray[np.bool_]:
        """Return which edges can be measured one by one, at ``to_px`` pixels per metre and with such a
        blur."""
        near, far = self.near_m * to_px, self.far_m * to_px
        apart: NDArray[np.bool_] = (near > MIN_GAP_PX) | (
            (near > 0.7 * MIN_GAP_PX) & (far > 1.4 * MIN_GAP_PX)
        )
        return apart & (self.radius_m * to_px > max(MIN_RADIUS_PX, 3.0 * blur_px))


def edge_sides(n_edges: int) -> Array:
    """Return +1 for the outside of red (even edges), -1 for the edge of a hole."""
    return np.where(np.arange(n_edges) % 2 == 0, 1.0, -1.0)


@dataclass(frozen=True, slots=True)
class Lines:
    """Lines of pixels across edges, p lines of m pixels.

    ``distance`` (p, m) of each pixel outward from the edge as predicted [px], ``value`` (p, m) its
    brightness less the line's mean, ``red`` (p, m) its R, ``weight`` (p, m) zero for repeated and missing
    pixels, ``total`` (p,) their sum. (p,): ``edge`` index, ``side``, ``level`` mean brightness, ``half_px``
    length, ``bend`` curvature of the edge [1/px] halved, ``gap_px`` to the nearer neighbour, ``outward_px``
    and ``inward_px`` to the neighbours (infinite where there is none) and their ``_bend``, place ``u0``,
    ``v0``, image normal ``nu``, ``nv``. ``design`` (p, 6): change of the displacement with the centre x, y,
    kappa, tilt x, y and the growth of red [px]; ``considered`` (p, 3): with the relative focal length and
    the principal point [px].
    """

    distance: Array
    value: Array
    red: Array
    weight: Array
    total: Array
    edge: NDArray[np.intp]
    side: Array
    level: Array
    half_px: Array
    bend: Array
    gap_px: Array
    outward_px: Array
    inward_px: Array
    outward_bend: Array
    inward_bend: Array
    u0: Array
    v0: Array
    nu: Array
    nv: Array
    design: Array
    considered: Array


def lay_lines(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges: Edges,
    blur_px: float,
    n_lines: int,
) -> Lines | None:
    """Lay lines of pixels across the edges that lie inside the image; None where there are too few."""
    half_length_px = max(HALF_LENGTH_PX, 3.0 * blur_px)
    to_px = kappa / float(plane.units_per_pixel(centre[0], centre[1]))
    usable = np.flatnonzero(edges.usable(to_px, blur_px))
    if not len(usable):
        return None
    want = np.clip((2.5 * to_px) * edges.radius_m[usable], 10.0, 30.0)
    want *= min(1.0, n_lines / float(want.sum()))
    edge, cos, sin, u, v = _place(plane, centre, kappa, edges, usable, np.maximum(want, 6.0))
    inside = plane.inside(u[0], v[0], 1.5)
    seen = float(inside.mean())
    if 0.0 < seen < 0.6:
        edge, cos, sin, u, v = _place(
            plane, centre, kappa, edges, usable, np.maximum(want, 6.0) / max(seen, 0.15)
        )
        inside = plane.inside(u[0], v[0], 1.5)
    if not inside.all():
        edge, cos, sin, u, v = edge[inside], cos[inside], sin[inside], u[:, inside], v[:, inside]
    if len(edge) < 12:
        return None
    u0, v0 = u[0], v[0]
    du, dv = u[1] - u0, v[1] - v0
    length = np.hypot(du, dv)
    # Pixels per metre on the target along the radius: the second circle is STEP larger.
    gap = edges.near_m[edge] * (length / (STEP * edges.radius_m[0]))
    half = np.clip(0.6 * gap, MIN_HALF_LENGTH_PX, half_length_px)
    reach = (half / length)[:, None] * _ALONG
    ui = np.rint(u0[:, None] + reach * du[:, None])
    vi = np.rint(v0[:, None] + reach * dv[:, None])
    weight = np.ones(ui.shape)
    # The same pixel twice on a line says nothing new; pixels outside the image say nothing.
    weight[:, 1:] = (np.diff(ui, axis=1) != 0.0) | (np.diff(vi, axis=1) != 0.0)
    w, h = plane.camera.width - 1.0, plane.camera.height - 1.0
    if ui.min() < 0.0 or vi.min() < 0.0 or ui.max() > w or vi.max() > h:
        weight[(ui < 0.0) | (vi < 0.0) | (ui > w) | (vi > h)] = 0.0
        ui, vi = np.clip(ui, 0.0, w), np.clip(vi, 0.0, h)
    pixels = image[vi.astype(np.intp), ui.astype(np.intp)].astype(np.float64)
    value = 0.5 * (pixels[..., 0] + pixels[..., 1])
    total = weight.sum(axis=1)
    level = (value * weight).sum(axis=1) / np.maximum(total, 1.0)
    value -= level[:, None]

    x, y = plane.rays(ui, vi)
    qx, qy = plane.from_rays(x, y, vi)
    rho = np.hypot(qx - centre[0], qy - centre[1])
    rk = kappa * edges.radius_m[edge]
    # The gradient of rho in the image, at the edge itself.
    xm, ym = plane.rays(u0, v0)
    qxm, qym = centre[0] + rk * cos, centre[1] + rk * sin
    r = plane.rotation
    depth = r[2, 0] * xm + r[2, 1] * ym + r[2, 2]
    tangent = cos * qxm + sin * qym
    gx = (cos * r[0, 0] + sin * r[1, 0] - tangent * r[2, 0]) / depth
    gy = (cos * r[0, 1] + sin * r[1, 1] - tangent * r[2, 1]) / depth
    gu, gv = gx / plane.camera.fx, gy / plane.camera.fy
    slope = np.hypot(gu, gv)
    per = 1.0 / slope
    side = edges.side[edge]
    design = np.empty((len(edge), 6))
    design[:, 0] = cos * per
    design[:, 1] = sin * per
    design[:, 2] = edges.radius_m[edge] * per
    design[:, 3] = (cos * qxm * qym + sin * (1.0 + qym * qym)) * per
    design[:, 4] = -(cos * (1.0 + qxm * qxm) + sin * qxm * qym) * per
    design[:, 5] = side
    considered = np.empty((len(edge), 3))
    considered[:, 0] = (gx * xm + gy * ym) * per
    considered[:, 1] = gu * per
    considered[:, 2] = gv * per
    radii = np.concatenate(([np.inf], edges.radius_m, [-np.inf]))
    scale = kappa * per
    return Lines(
        (rho - rk[:, None]) * per[:, None],
        value,
        pixels[..., 2],
        weight,
        total,
        edge,
        side,
        level,
        half,
        0.5 * slope / rk,
        gap,
        (radii[edge] - radii[edge + 1]) * scale,
        (radii[edge + 1] - radii[edge + 2]) * scale,
        0.5 / (radii[edge] * scale),
        0.5 / (np.maximum(radii[edge + 2], 0.1 * edges.radius_m[-1]) * scale),
        u0,
        v0,
        considered[:, 1],
        considered[:, 2],
        design,
        considered,
    )


STEP = 0.002
"""Size of the second circle that shows the direction of the radius, relative to the outermost edge."""


def _place(
    plane: LevelPlane, centre: Array, kappa: float, edges: Edges, usable: NDArray[np.intp], want: Array
) -> tuple[NDArray[np.intp], Array, Array, Array, Array]:
    """Return edge, direction and, for the edge and a slightly larger circle, pixel coordinates (2, p)."""
    count = want.astype(np.intp)
    edge = np.repeat(usable, count)
    first = np.repeat(np.cumsum(count) - count, count)
    angle = (np.arange(len(edge)) - first + 0.37 * edge) * np.repeat(2.0 * np.pi / count, count)
    cos, sin = np.cos(angle), np.sin(angle)
    radius = kappa * edges.radius_m[edge]
    both = np.stack((radius, radius + STEP * kappa * edges.radius_m[0]))
    u, v = plane.to_pixels(centre[0] + both * cos, centre[1] + both * sin)
    return edge, cos, sin, u, v

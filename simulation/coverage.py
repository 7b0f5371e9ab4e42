"""How much of a pixel lies inside a shape: exact area coverage, for anti-aliased rendering.

A pixel is a unit square. Its area on one side of a straight line is a closed formula (``half_plane``). A
curved edge is cut into sub-squares small against its radius, and the mean of its distance function over a
sub-square, which differs from the value in the middle by the curvature over 24, is used in the formula.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def half_plane(distance: Array, normal_u: Array, normal_v: Array) -> Array:
    """Return the share of unit squares on the negative side of a line.

    ``distance`` is that of the square's centre to the line (positive: centre outside) in units of the
    square's side; the unit normal of the line is (normal_u, normal_v). All of one shape; the result is in [0,
    1].
    """
    nu, nv = np.abs(normal_u), np.abs(normal_v)
    long, short = np.maximum(nu, nv), np.minimum(nu, nv)
    reach, flat = 0.5 * (long + short), 0.5 * (long - short)
    depth = np.abs(distance)
    corner = np.maximum(reach - depth, 0.0) ** 2 / np.maximum(2.0 * long * short, 1e-12)
    less = np.where(depth <= flat, 0.5 - depth / long, corner)
    return np.where(distance > 0.0, less, 1.0 - less)


class PlaneMap:
    """A map from pixels to a plane in the world, known at some pixels with its derivatives.

    The plane's coordinates are (n0 / n2, n1 / n2), with n linear in the offset (du, dv) from the pixel's
    centre: ``n = value + along_u * du + along_v * dv``, arrays of shape (3, pixels). For a pinhole this is
    exact.
    """

    def __init__(self, value: Array, along_u: Array, along_v: Array) -> None:
        self.value, self.along_u, self.along_v = value, along_u, along_v

    @cached_property
    def centre(self) -> tuple[Array, Array, Array]:
        """Coordinates and derivatives in the pixels' middles, each of shape (2, pixels)."""
        none = np.zeros((1, 1))
        point, along_u, along_v = self.at(none, none)
        return point[:, 0], along_u[:, 0], along_v[:, 0]

    @cached_property
    def step(self) -> Array:
        """Length on the plane that is no less than that of one pixel's side, in any direction; shape
        (pixels,).
        """
        _, along_u, along_v = self.centre
        length2: Array = along_u[0] ** 2 + along_u[1] ** 2 + along_v[0] ** 2 + along_v[1] ** 2
        return np.sqrt(length2)

    @cached_property
    def radius(self) -> Array:
        """Distance of the pixels' middles from the plane's origin; shape (pixels,)."""
        point = self.centre[0]
        length2: Array = point[0] * point[0] + point[1] * point[1]
        return np.sqrt(length2)

    def take(self, index: NDArray[np.intp]) -> PlaneMap:
        """Return the map at some of the pixels."""
        along = (a if a.shape[1] == 1 else a[:, index] for a in (self.along_u, self.along_v))
        return PlaneMap(self.value[:, index], *along)

    def at(self, du: Array, dv: Array) -> tuple[Array, Array, Array]:
        """Return the plane's coordinates and their derivatives along u and v, at offsets from the pixels'
        middles.

        ``du`` and ``dv`` have shape (offsets, 1), the results (2, offsets, pixels).
        """
        along_u, along_v = self.along_u[:, None], self.along_v[:, None]
        n = self.value[:, None] + du * along_u + dv * along_v
        inverse = 1.0 / n[2]
        point = n[:2] * inverse
        return (
            point,
            (along_u[:2] - point * along_u[2]) * inverse,
            (along_v[:2] - point * along_v[2]) * inverse,
        )


def disc(plane: PlaneMap, radius: float) -> Array:
    """Return the share of each pixel inside the disc of this radius around the plane's origin; shape
    (pixels,).
    """
    share: Array = (plane.radius < radius).astype(np.float64)
    near = np.flatnonzero(np.abs(plane.radius - radius) < 0.75 * plane.step)
    if near.size:
        radius_px = radius / plane.step[near]
        cuts = np.select([radius_px > 25.0, radius_px > 5.0, radius_px > 1.5], [1, 2, 4], 8)
        for n in np.unique(cuts):
            some = near[cuts == n]
            share[some] = _disc_cut(plane.take(some), radius, int(n))
    return share


def _disc_cut(plane: PlaneMap, radius: float, cuts: int) -> Array:
    """Return the share of each pixel inside the disc, from cuts x cuts sub-squares."""
    side = 1.0 / cuts
    middles = (np.arange(cuts) + 0.5) * side - 0.5
    point, along_u, along_v = plane.at(np.repeat(middles, cuts)[:, None], np.tile(middles, cuts)[:, None])
    rho = np.maximum(np.sqrt(point[0] * point[0] + point[1] * point[1]), 1e-9 * radius)
    slope_u = (point[0] * along_u[0] + point[1] * along_u[1]) / rho
    slope_v = (point[0] * along_v[0] + point[1] * along_v[1]) / rho
    slope2 = np.maximum(slope_u * slope_u + slope_v * slope_v, 1e-24)
    stretch = (along_u * along_u + along_v * along_v).sum(axis=0)
    slope = np.sqrt(slope2)
    distance = (rho - radius + side * side / 24.0 * (stretch - slope2) / rho) / (slope * side)
    share: Array = half_plane(distance, slope_u / slope, slope_v / slope).mean(axis=0)
    return share


def square(plane: PlaneMap, side: float) -> Array:
    """Return the share of each pixel inside the axis-parallel square around the plane's origin; shape
    (pixels,).

    Exact but for the four corners, where the shares of the two strips are multiplied.
    """
    away = np.maximum(np.abs(plane.centre[0][0]), np.abs(plane.centre[0][1]))
    share: Array = (away < 0.5 * side).astype(np.float64)
    near = np.flatnonzero(np.abs(away - 0.5 * side) < 0.75 * plane.step)
    if near.size:
        share[near] = 1.0
        for axis in (0, 1):
            point, along_u, along_v = (part[axis, near] for part in plane.centre)
            slope = np.maximum(np.hypot(along_u, along_v), 1e-24)
            distance = (np.abs(point) - 0.5 * side) / slope
            share[near] *= half_plane(distance, along_u / slope, along_v / slope)
    return share

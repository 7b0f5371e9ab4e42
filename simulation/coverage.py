"""How much of a pixel lies inside a shape: exact area coverage, for anti-aliased rendering.

A pixel is a unit square. Its area on one side of a straight line is a closed formula (``half_plane``). A
curved edge is cut into sub-squares small against its radius, and the mean of its distance function over a
sub-square, which differs from the value in the middle by the curvature over 24, is used in the formula.
"""

from __future__ import annotations

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

    def take(self, index: NDArray[np.intp]) -> PlaneMap:
        """Return the map at some of the pixels."""
        return PlaneMap(self.value[:, index], self.along_u[:, index], self.along_v[:, index])

    def at(self, du: float, dv: float) -> tuple[Array, Array, Array]:
        """Return the plane's coordinates, shape (2, pixels), and their derivatives along u and v, at an
        offset.
        """
        n = self.value + du * self.along_u + dv * self.along_v
        inverse = 1.0 / n[2]
        point = n[:2] * inverse
        along_u = (self.along_u[:2] - point * self.along_u[2]) * inverse
        along_v = (self.along_v[:2] - point * self.along_v[2]) * inverse
        return point, along_u, along_v


def disc(plane: PlaneMap, radius: float) -> Array:
    """Return the share of each pixel inside the disc of this radius around the plane's origin; shape
    (pixels,).
    """
    point, along_u, along_v = plane.at(0.0, 0.0)
    rho = np.maximum(np.hypot(point[0], point[1]), 1e-9 * radius)
    step = np.sqrt((along_u**2 + along_v**2).sum(axis=0))  # no less than a pixel's length
    share = (rho < radius).astype(np.float64)
    near = np.flatnonzero(np.abs(rho - radius) < 0.75 * step)
    if near.size:
        radius_px = radius / step[near]
        cuts = np.select([radius_px > 25.0, radius_px > 5.0, radius_px > 1.5], [1, 2, 4], 8)
        for n in np.unique(cuts):
            some = near[cuts == n]
            share[some] = _disc_cut(plane.take(some), radius, int(n))
    return share


def _disc_cut(plane: PlaneMap, radius: float, cuts: int) -> Array:
    """Return the share of each pixel inside the disc, from cuts x cuts sub-squares."""
    side = 1.0 / cuts
    total = np.zeros(plane.value.shape[1])
    for i in range(cuts):
        for j in range(cuts):
            point, along_u, along_v = plane.at((i + 0.5) * side - 0.5, (j + 0.5) * side - 0.5)
            rho = np.maximum(np.hypot(point[0], point[1]), 1e-9 * radius)
            slope_u = (point * along_u).sum(axis=0) / rho
            slope_v = (point * along_v).sum(axis=0) / rho
            slope2 = slope_u**2 + slope_v**2
            bend = ((along_u**2 + along_v**2).sum(axis=0) - slope2) / rho
            slope = np.sqrt(np.maximum(slope2, 1e-24))
            distance = (rho - radius + side * side / 24.0 * bend) / (slope * side)
            total += half_plane(distance, slope_u / slope, slope_v / slope)
    return total * (side * side)


def square(plane: PlaneMap, side: float) -> Array:
    """Return the share of each pixel inside the axis-parallel square around the plane's origin; shape
    (pixels,).

    Exact but for the four corners, where the shares of the two strips are multiplied.
    """
    point, along_u, along_v = plane.at(0.0, 0.0)
    share = np.ones(point.shape[1])
    for axis in (0, 1):
        slope = np.maximum(np.hypot(along_u[axis], along_v[axis]), 1e-24)
        distance = (np.abs(point[axis]) - 0.5 * side) / slope
        share *= half_plane(distance, along_u[axis] / slope, along_v[axis] / slope)
    return share

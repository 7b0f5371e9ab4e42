"""What a camera in an attitude sees of the level plane, as plain functions of pixels and points.

Every function is elementwise: it takes floats or arrays of one shape, so that the compiled kernels
(``vision.compiled``) run the very same formulas pixel by pixel.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.lens import distort

Array = NDArray[np.float64]

HORIZON = 0.05
"""Rays whose third level component is below this share of the optical axis's length do not meet the plane."""


class View(NamedTuple):
    """A camera in an attitude.

    Focal lengths, principal point and size [px]; ``lens`` (8,) OpenCV's coefficients, used where
    ``distorted``, then with ``table`` (height, width, 2) float32, the rays of all pixels (else it is empty);
    ``rotation`` (3, 3) camera to level axes; ``rate`` (3,) the camera's angular velocity in its own axes
    [rad/s], used where ``rolling``; ``row_s`` the time from one row to the next [s].
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: float
    height: float
    lens: Array
    distorted: bool
    table: NDArray[np.float32]
    rotation: Array
    rate: Array
    rolling: bool
    row_s: float


def turned(view: View, rotation: Array) -> View:
    """Return the view with another rotation (3, 3)."""
    return View(
        view.fx,
        view.fy,
        view.cx,
        view.cy,
        view.width,
        view.height,
        view.lens,
        view.distorted,
        view.table,
        rotation,
        view.rate,
        view.rolling,
        view.row_s,
    )


def whole(x: Any) -> Any:
    """Return the whole part of numbers that are not negative, as indices."""
    return x.astype(np.intp)


def either(condition: Any, a: Any, b: Any) -> Any:
    """Return ``a`` where the condition holds and ``b`` elsewhere."""
    return np.where(condition, a, b)


def pixel_rays(view: View, u: Any, v: Any) -> tuple[Any, Any]:
    """Return undistorted rays (x, y) of pixel coordinates that need not be integers."""
    if not view.distorted:
        return (u - view.cx) / view.fx, (v - view.cy) / view.fy
    table = view.table
    j = whole(np.minimum(np.maximum(u, 0.0), view.width - 2.0))
    i = whole(np.minimum(np.maximum(v, 0.0), view.height - 2.0))
    a, b = u - j, v - i
    w00, w01, w10, w11 = (1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b
    return (
        w00 * table[i, j, 0]
        + w01 * table[i, j + 1, 0]
        + w10 * table[i + 1, j, 0]
        + w11 * table[i + 1, j + 1, 0],
        w00 * table[i, j, 1]
        + w01 * table[i, j + 1, 1]
        + w10 * table[i + 1, j, 1]
        + w11 * table[i + 1, j + 1, 1],
    )


def swung(view: View, x: Any, y: Any, v: Any, sign: float) -> tuple[Any, Any]:
    """Return rays (x, y, 1) turned by the camera's motion between the middle row and rows ``v``, to second
    order.
    """
    t = (v - 0.5 * (view.height - 1.0)) * (sign * view.row_s)
    wx, wy, wz = view.rate[0], view.rate[1], view.rate[2]
    ax, ay, az = wy - wz * y, wz * x - wx, wx * y - wy * x
    bx, by, bz = wy * az - wz * ay, wz * ax - wx * az, wx * ay - wy * ax
    s = 0.5 * t * t
    z = 1.0 + t * az + s * bz
    return (x + t * ax + s * bx) / z, (y + t * ay + s * by) / z


def rays_to_plane(view: View, x: Any, y: Any, v: Any) -> tuple[Any, Any]:
    """Return (q_x, q_y) of rays (x, y, 1) exposed with rows ``v``; NaN where a ray does not meet the
    plane.
    """
    r = view.rotation
    if view.rolling:
        x, y = swung(view, x, y, v, 1.0)
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2]
    depth = either(depth < HORIZON, np.nan, depth)
    return (
        (r[0, 0] * x + r[0, 1] * y + r[0, 2]) / depth,
        (r[1, 0] * x + r[1, 1] * y + r[1, 2]) / depth,
    )


def to_pixels(view: View, qx: Any, qy: Any) -> tuple[Any, Any]:
    """Return pixel coordinates (u, v) of points of the plane; NaN behind the camera."""
    r = view.rotation
    x = r[0, 0] * qx + r[1, 0] * qy + r[2, 0]
    y = r[0, 1] * qx + r[1, 1] * qy + r[2, 1]
    z = r[0, 2] * qx + r[1, 2] * qy + r[2, 2]
    z = either(z > HORIZON, z, np.nan)
    x, y = x / z, y / z
    u, v = project(view, x, y)
    if view.rolling:
        for _ in range(3):
            row = np.minimum(np.maximum(v, 0.0), view.height - 1.0)
            xt, yt = swung(view, x, y, row, -1.0)
            u, v = project(view, xt, yt)
    return u, v


def project(view: View, x: Any, y: Any) -> tuple[Any, Any]:
    """Return the pixels of undistorted rays."""
    if view.distorted:
        x, y = distort(x, y, view.lens)
    return view.fx * x + view.cx, view.fy * y + view.cy


def inside(view: View, u: Any, v: Any, margin_px: float) -> Any:
    """Return where pixel coordinates are further than ``margin_px`` from the image's border pixels."""
    w, h = view.width - 1.0 - margin_px, view.height - 1.0 - margin_px
    return (u > margin_px) & (u < w) & (v > margin_px) & (v < h)


def units_per_pixel(view: View, qx: Any, qy: Any) -> Any:
    """Return the plane's length per pixel at points of the plane: the root of the local change of area.

    ``|dq/d(u, v)| = n / (fx fy d_z^3)`` with the ray's ``d_z``, for a camera without distortion.
    """
    r = view.rotation
    # The ray through q, scaled to camera depth 1, has level depth d_z = 1 / (R^T (q, 1))_z.
    depth = np.abs(1.0 / (r[0, 2] * qx + r[1, 2] * qy + r[2, 2]))
    return np.sqrt(1.0 / (view.fx * view.fy) / (depth * depth * depth))


def plane_gradient(view: View, cos: Any, sin: Any, qx: Any, qy: Any, x: Any, y: Any) -> tuple[Any, Any]:
    """Return d rho / d(u, v) at points of the plane whose rays are (x, y), along the direction (cos, sin)."""
    r = view.rotation
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2]
    tangent = cos * qx + sin * qy
    return (
        (cos * r[0, 0] + sin * r[1, 0] - tangent * r[2, 0]) / (depth * view.fx),
        (cos * r[0, 1] + sin * r[1, 1] - tangent * r[2, 1]) / (depth * view.fy),
    )

"""The level plane: rays of pixels cut with the plane one metre along the level frame's third axis.

For a camera attitude ``R`` (camera to level axes; ``R_nc`` for a level target) a pixel's ray ``d = R (x, y,
1)`` meets that plane in ``q = (d_x / d_z, d_y / d_z)``. A target that lies parallel to it at height ``h``
appears there to scale: its circles are circles, concentric, of radius ``r / h``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.camera import Camera

Array = NDArray[np.float64]
IntArray = NDArray[np.intp]

HORIZON = 0.05
"""Rays whose third level component is below this share of the optical axis's length do not meet the plane."""


@dataclass(frozen=True, slots=True)
class LevelPlane:
    """Maps pixels to the level plane and back.

    ``rotation`` (3, 3) takes camera axes to level axes. ``rate_cam_radps`` (3,) is the camera's angular
    velocity in its own axes: with a rolling shutter each row's ray is turned to the time of the middle row.
    """

    camera: Camera
    rotation: Array
    rate_cam_radps: Array | None = None

    def tilted(self, rotation: Array) -> LevelPlane:
        """Return the same view for another plane: ``rotation`` (3, 3) is applied after the present one."""
        return LevelPlane(self.camera, rotation @ self.rotation, self.rate_cam_radps)

    def rays(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return undistorted rays (x, y) of pixel coordinates that need not be integers."""
        if not self.camera.distortion:
            cx, cy = self.camera.centre
            return (u - cx) / self.camera.fx, (v - cy) / self.camera.fy
        table = self.camera.ray_table
        j = np.clip(u.astype(np.intp), 0, self.camera.width - 2)
        i = np.clip(v.astype(np.intp), 0, self.camera.height - 2)
        a, b = (u - j)[..., None], (v - i)[..., None]
        upper = table[i, j] * (1.0 - a) + table[i, j + 1] * a
        lower = table[i + 1, j] * (1.0 - a) + table[i + 1, j + 1] * a
        ray = upper * (1.0 - b) + lower * b
        return ray[..., 0], ray[..., 1]

    def from_pixels(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return (q_x, q_y) of pixel coordinates; NaN where the ray does not meet the plane."""
        x, y = self.rays(u, v)
        return self.from_rays(x, y, v)

    def from_rays(self, x: Array, y: Array, v: Array) -> tuple[Array, Array]:
        """Return (q_x, q_y) of rays (x, y, 1) that were exposed with rows ``v``."""
        r = self.rotation
        if self.rate_cam_radps is not None:
            x, y, z = _turn(x, y, self.camera.row_time_s(v), self.rate_cam_radps)
            x, y = x / z, y / z
        depth = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        if depth.size and depth.min() < HORIZON:
            depth = np.where(depth < HORIZON, np.nan, depth)
        return (
            (r[0, 0] * x + r[0, 1] * y + r[0, 2]) / depth,
            (r[1, 0] * x + r[1, 1] * y + r[1, 2]) / depth,
        )

    def to_pixels(self, qx: Array, qy: Array) -> tuple[Array, Array]:
        """Return pixel coordinates (u, v) of points of the plane; NaN behind the camera."""
        r = self.rotation
        x = r[0, 0] * qx + r[1, 0] * qy + r[2, 0]
        y = r[0, 1] * qx + r[1, 1] * qy + r[2, 1]
        z = r[0, 2] * qx + r[1, 2] * qy + r[2, 2]
        if z.size and not z.min() > HORIZON:
            z = np.where(z > HORIZON, z, np.nan)
        x, y = x / z, y / z
        if self.rate_cam_radps is None:
            return self._project(x, y)
        u, v = self._project(x, y)
        for _ in range(3):
            row = np.nan_to_num(np.clip(v, 0.0, self.camera.height - 1.0))
            xt, yt, zt = _turn(x, y, -self.camera.row_time_s(row), self.rate_cam_radps)
            u, v = self._project(xt / zt, yt / zt)
        return u, v

    def _project(self, x: Array, y: Array) -> tuple[Array, Array]:
        if self.camera.distortion:
            return self.camera.project(np.stack((x, y, np.ones_like(x)), axis=-1))
        cx, cy = self.camera.centre
        return self.camera.fx * x + cx, self.camera.fy * y + cy

    def inside(self, u: Array, v: Array, margin_px: float) -> NDArray[np.bool_]:
        """Return where pixel coordinates are further than ``margin_px`` from the image's border pixels."""
        w, h = self.camera.width - 1.0 - margin_px, self.camera.height - 1.0 - margin_px
        within: NDArray[np.bool_] = (u > margin_px) & (u < w) & (v > margin_px) & (v < h)
        return within

    def units_per_pixel(self, qx: Array, qy: Array) -> Array:
        """Return the plane's length per pixel at points of the plane: the root of the local change of area.

        ``|dq/d(u, v)| = n / (fx fy d_z^3)`` with the ray's ``d_z``, for a camera without distortion.
        """
        r = self.rotation
        # The ray through q, scaled to camera depth 1, has level depth d_z = 1 / (R^T (q, 1))_z.
        depth = 1.0 / (r[0, 2] * qx + r[1, 2] * qy + r[2, 2])
        scale: Array = np.sqrt(1.0 / (self.camera.fx * self.camera.fy) / np.abs(depth) ** 3)
        return scale

    def position_cam(self, centre: Array, kappa: float) -> Array:
        """Return P^c [m] of the target's centre: ``R^T (c_x, c_y, 1) / kappa``."""
        p: Array = self.rotation.T @ np.array([centre[0], centre[1], 1.0]) / kappa
        return p


def _turn(x: Array, y: Array, t: Array, w: Array) -> tuple[Array, Array, Array]:
    """Turn rays (x, y, 1) by the rotation vector ``w * t``, to second order in it."""
    ax, ay, az = w[1] - w[2] * y, w[2] * x - w[0], w[0] * y - w[1] * x
    bx, by, bz = w[1] * az - w[2] * ay, w[2] * ax - w[0] * az, w[0] * ay - w[1] * ax
    s = 0.5 * t * t
    return x + t * ax + s * bx, y + t * ay + s * by, 1.0 + t * az + s * bz


def rotation_xy(alpha: float, beta: float) -> Array:
    """Return the rotation matrix of the rotation vector (alpha, beta, 0) [rad]."""
    angle = float(np.hypot(alpha, beta))
    if angle < 1e-12:
        return np.array([[1.0, 0.0, beta], [0.0, 1.0, -alpha], [-beta, alpha, 1.0]])
    x, y = alpha / angle, beta / angle
    c, s = float(np.cos(angle)), float(np.sin(angle))
    k = 1.0 - c
    return np.array(
        [[c + k * x * x, k * x * y, s * y], [k * x * y, c + k * y * y, -s * x], [-s * y, s * x, c]]
    )


def rotation_to_level(normal: Array) -> Array:
    """Return a rotation (camera to level axes) that takes a plane's unit normal, (3,), to the third axis."""
    n = normal / np.linalg.norm(normal)
    axis = np.array([n[1], -n[0], 0.0])
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        return np.eye(3)
    angle = float(np.arctan2(sine, n[2]))
    return rotation_xy(axis[0] / sine * angle, axis[1] / sine * angle)


def rotation_vector_xy(rotation: Array) -> Array:
    """Return the rotation vector's first two entries (2,) of a rotation about an axis in the level plane.

    Of a general rotation it is the part that turns the third axis. Law: ``rotation_vector_xy(rotation_xy(a,
    b))`` is (a, b) for angles below pi.
    """
    axis = np.array([-rotation[1, 2], rotation[0, 2]])
    sine = float(np.hypot(axis[0], axis[1]))
    if sine < 1e-12:
        return np.zeros(2)
    vector: Array = axis / sine * np.arctan2(sine, rotation[2, 2])
    return vector

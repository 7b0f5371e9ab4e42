"""The level plane: rays of pixels cut with the plane one metre along the level frame's third axis.

For a camera attitude ``R`` (camera to level axes; ``R_nc`` for a level target) a pixel's ray ``d = R (x, y,
1)`` meets that plane in ``q = (d_x / d_z, d_y / d_z)``. A target that lies parallel to it at height ``h``
appears there to scale: its circles are circles, concentric, of radius ``r / h``.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision import view
from vision.camera import Camera

Array = NDArray[np.float64]
_NO_TABLE = np.empty((0, 0, 2), dtype=np.float32)
_NO_TABLE.flags.writeable = False


class LevelPlane:
    """Maps pixels of one image to the level plane and back; see ``vision.view`` for the formulas.

    ``rotation`` (3, 3) takes camera axes to level axes. ``rate_cam_radps`` (3,) is the camera's angular
    velocity in its own axes: with a rolling shutter each row's ray is turned to the time of the middle row.
    """

    __slots__ = ("camera", "rate_cam_radps", "rotation", "view")

    def __init__(self, camera: Camera, rotation: Array, rate_cam_radps: Array | None = None) -> None:
        self.camera = camera
        self.rotation = rotation
        self.rate_cam_radps = rate_cam_radps
        cx, cy = camera.centre
        distorted = bool(camera.distortion)
        self.view = view.View(
            camera.fx,
            camera.fy,
            cx,
            cy,
            float(camera.width),
            float(camera.height),
            camera.lens,
            distorted,
            camera.ray_table if distorted else _NO_TABLE,
            np.array(rotation, dtype=np.float64, order="C"),
            np.zeros(3) if rate_cam_radps is None else np.array(rate_cam_radps, dtype=np.float64),
            rate_cam_radps is not None,
            camera.readout_s / camera.height,
        )

    def tilted(self, rotation: Array) -> LevelPlane:
        """Return the same view for another plane: ``rotation`` (3, 3) is applied after the present one."""
        return LevelPlane(self.camera, rotation @ self.rotation, self.rate_cam_radps)

    def rays(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return undistorted rays (x, y) of pixel coordinates that need not be integers."""
        return view.pixel_rays(self.view, u, v)

    def from_pixels(self, u: Array, v: Array) -> tuple[Array, Array]:
        """Return (q_x, q_y) of pixel coordinates; NaN where the ray does not meet the plane."""
        x, y = self.rays(u, v)
        return self.from_rays(x, y, v)

    def from_rays(self, x: Array, y: Array, v: Array) -> tuple[Array, Array]:
        """Return (q_x, q_y) of rays (x, y, 1) that were exposed with rows ``v``."""
        return view.rays_to_plane(self.view, x, y, v)

    def to_pixels(self, qx: Array, qy: Array) -> tuple[Array, Array]:
        """Return pixel coordinates (u, v) of points of the plane; NaN behind the camera."""
        return view.to_pixels(self.view, qx, qy)

    def inside(self, u: Array, v: Array, margin_px: float) -> NDArray[np.bool_]:
        """Return where pixel coordinates are further than ``margin_px`` from the image's border pixels."""
        within: NDArray[np.bool_] = view.inside(self.view, u, v, margin_px)
        return within

    def units_per_pixel(self, qx: Array, qy: Array) -> Array:
        """Return the plane's length per pixel at points of the plane: the root of the local change of
        area.
        """
        scale: Array = view.units_per_pixel(self.view, qx, qy)
        return scale


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

"""The camera: a pinhole with OpenCV's lens model, and the ray of every pixel.

Pixel coordinates (u, v) have the centres of pixels at integers, so that the image spans -0.5 .. width - 0.5,
and the default principal point is ((width - 1) / 2, (height - 1) / 2) (seed 4.25 prints width / 2, which is
half a pixel off: erratum 14). The camera frame is X right, Y backwards (down in the image), Z along the
optical axis. A *ray* is a point (x, y) of the plane Z = 1, free of lens distortion: ``u = fx * x + cx`` for a
camera without distortion (seed 2.21).

Rolling shutter: row v is exposed at ``row_time_s(v)`` after the time the image is stamped with, which is that
of its middle row; ``readout_s`` is the time from the first row to just after the last.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vision import tables
from vision.lens import distort, undistort

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MAX_SIDE_PX = 16384
"""Largest width or height that is accepted; beyond it a file is damaged or the argument is not an image."""


@dataclass(frozen=True)
class Camera:
    """Intrinsic parameters of one camera mode.

    Parameters
    ----------
    width, height
        Size of the image [px].
    fx, fy
        Focal length [px], the ``s_c f`` of seed (2.22).
    cx, cy
        Principal point [px]; the image's centre where it is not given.
    distortion
        OpenCV's coefficients: none, (k1, k2, p1, p2), with k3, or with k3, k4, k5, k6.
    readout_s
        Read-out time of a rolling shutter [s], zero for a global one.

    Raises ``ValueError``, naming the argument, for anything that is not such a camera.

    Law: ``camera.project([*camera.rays(u, v), 1]) == (u, v)`` for every pixel of the image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float | None = None
    cy: float | None = None
    distortion: tuple[float, ...] = ()
    readout_s: float = 0.0

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            side = getattr(self, name)
            if (
                isinstance(side, bool)
                or not isinstance(side, int | np.integer)
                or not 2 <= side <= MAX_SIDE_PX
            ):
                raise ValueError(f"{name}: {side!r} is not a whole number of pixels from 2 to {MAX_SIDE_PX}")
            object.__setattr__(self, name, int(side))
        for name in ("fx", "fy"):
            focal = _number(name, getattr(self, name))
            if focal <= 0.0:
                raise ValueError(f"{name}: {focal!r} is not a positive focal length in pixels")
            object.__setattr__(self, name, focal)
        for name, side in (("cx", self.width), ("cy", self.height)):
            given = getattr(self, name)
            centre = (side - 1) / 2.0 if given is None else _number(name, given)
            if not -side <= centre <= 2 * side:
                raise ValueError(f"{name}: {centre!r} is further than the image's own size outside of it")
            object.__setattr__(self, name, centre)
        coefficients = tuple(_number("distortion", k) for k in self.distortion)
        if len(coefficients) not in (0, 4, 5, 8):
            raise ValueError(
                f"distortion: {len(coefficients)} coefficients; OpenCV's models have 0, 4, 5 or 8"
            )
        object.__setattr__(self, "distortion", coefficients if any(coefficients) else ())
        readout = _number("readout_s", self.readout_s)
        if not 0.0 <= readout <= 1.0:
            raise ValueError(f"readout_s: {readout!r} is not a time from 0 to 1 s")
        object.__setattr__(self, "readout_s", readout)

    @classmethod
    def from_fov(cls, width: int, height: int, hfov_rad: float, readout_s: float = 0.0) -> Camera:
        """Return a camera without distortion, of square pixels, from its horizontal field of view [rad]."""
        fov = _number("hfov_rad", hfov_rad)
        if not 0.0 < fov < math.pi:
            raise ValueError(f"hfov_rad: {fov!r} is not between 0 and pi; is it in degrees?")
        focal = width / 2.0 / math.tan(fov / 2.0)
        return cls(width, height, focal, focal, readout_s=readout_s)

    @classmethod
    def preset(cls, name: str) -> Camera:
        """Return a camera by name, one of ``PRESETS``; ``ValueError`` lists them where there is none."""
        if name not in PRESETS:
            raise ValueError(f"name: no camera preset {name!r}; there are {', '.join(sorted(PRESETS))}")
        return PRESETS[name]

    @property
    def hfov_rad(self) -> float:
        """Horizontal field of view [rad] of the pinhole, without distortion."""
        return 2.0 * math.atan(self.width / 2.0 / self.fx)

    @property
    def vfov_rad(self) -> float:
        """Vertical field of view [rad] of the pinhole, without distortion."""
        return 2.0 * math.atan(self.height / 2.0 / self.fy)

    @cached_property
    def lens(self) -> Array:
        """Lens coefficients k1, k2, p1, p2, k3, k4, k5, k6, shape (8,), those that are not given zero."""
        return np.array(self.distortion + (0.0,) * (8 - len(self.distortion)))

    @property
    def matrix(self) -> Array:
        """The camera matrix K of seed (2.22), shape (3, 3)."""
        return np.array([[self.fx, 0.0, self.centre[0]], [0.0, self.fy, self.centre[1]], [0.0, 0.0, 1.0]])

    @property
    def centre(self) -> tuple[float, float]:
        """Principal point (cx, cy) [px]."""
        assert self.cx is not None and self.cy is not None  # filled in by __post_init__
        return self.cx, self.cy

    def rays(self, u: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """Return the undistorted ray (x, y) of pixel coordinates of any equal shapes (floats, not only
        centres).
        """
        x = (np.asarray(u, dtype=np.float64) - self.centre[0]) / self.fx
        y = (np.asarray(v, dtype=np.float64) - self.centre[1]) / self.fy
        if not self.distortion:
            x, y = np.broadcast_arrays(x, y)
            return x.copy(), y.copy()
        x, y = np.broadcast_arrays(x, y)
        return undistort(x, y, self.lens)

    def project(self, points_m: ArrayLike) -> tuple[Array, Array]:
        """Return the pixel (u, v) of points in the camera frame, shape (..., 3); NaN behind the camera (Z <=
        0).
        """
        p = np.asarray(points_m, dtype=np.float64)
        if p.shape[-1:] != (3,):
            raise ValueError(f"points_m: shape {p.shape} does not end in 3")
        z = np.where(p[..., 2] > 0.0, p[..., 2], np.nan)
        x, y = p[..., 0] / z, p[..., 1] / z
        if self.distortion:
            x, y = distort(x, y, self.lens)
        return self.fx * x + self.centre[0], self.fy * y + self.centre[1]

    @cached_property
    def ray_table(self) -> NDArray[np.float32]:
        """Rays of all pixel centres, shape (height, width, 2), float32, read-only; computed once."""
        u, v = np.meshgrid(np.arange(self.width), np.arange(self.height))
        table = np.stack(self.rays(u, v), axis=-1).astype(np.float32)
        if not np.isfinite(table).all():
            raise ValueError("distortion: the lens model cannot be inverted inside the image")
        table.flags.writeable = False
        return table

    def row_time_s(self, v: ArrayLike) -> Array:
        """Return when rows v are exposed [s], relative to the middle row, whose time is the image's."""
        return (np.asarray(v, dtype=np.float64) - (self.height - 1) / 2.0) * (self.readout_s / self.height)

    def check_image(self, image: object) -> Image:
        """Return ``image`` if it is one of this camera's: BGR, uint8, contiguous; else ``ValueError`` says
        why not.
        """
        if not isinstance(image, np.ndarray):
            raise ValueError(f"image: a {type(image).__name__}, not a NumPy array; was the file read?")
        if image.size == 0:
            raise ValueError(f"image: empty, shape {image.shape}")
        if image.ndim != 3 or image.shape[2] != 3:
            raise ValueError(
                f"image: shape {image.shape} is not (height, width, 3); grey has no red to search for"
            )
        if image.dtype != np.uint8:
            raise ValueError(f"image: {image.dtype} per channel, not uint8; scale it to 0..255 first")
        if image.shape[:2] != (self.height, self.width):
            raise ValueError(
                f"image: {image.shape[1]}x{image.shape[0]} pixels, but the camera has "
                f"{self.width}x{self.height}; use the calibration of the mode that recorded it"
            )
        if not image.flags.c_contiguous:
            raise ValueError("image: not contiguous in memory; pass numpy.ascontiguousarray(image)")
        return image

    def to_toml(self) -> str:
        """Return the text of a ``camera.toml``. Law: ``Camera.from_toml(c.to_toml()) == c``."""
        lines = [
            "# Camera intrinsics; pixel centres are at integers, distortion is k1 k2 p1 p2 [k3 [k4 k5 k6]]."
        ]
        for name in ("width", "height", "fx", "fy", "cx", "cy"):
            lines.append(f"{name} = {getattr(self, name)!r}")
        lines.append(f"distortion = [{', '.join(repr(k) for k in self.distortion)}]")
        lines.append(f"readout_s = {self.readout_s!r}")
        return "\n".join(lines) + "\n"

    @classmethod
    def from_toml(cls, text: str) -> Camera:
        """Read a ``camera.toml``; unknown or missing fields and wrong types are a ``ValueError`` naming the
        field.
        """
        return tables.from_toml(text, cls, "camera")

    @classmethod
    def load(cls, path: str | Path) -> Camera:
        """Read a ``camera.toml`` file; ``ValueError`` names the file."""
        return tables.load(path, cls, "camera")

    def to_camera_info(self) -> dict[str, Any]:
        """Return the fields of sensor_msgs/CameraInfo that describe this camera (read-out time has none
        there).
        """
        u0, v0 = self.centre
        d = list(self.distortion) or [0.0] * 5
        return {
            "width": self.width,
            "height": self.height,
            "distortion_model": "rational_polynomial" if len(d) == 8 else "plumb_bob",
            "d": d + [0.0] * (5 - len(d)),
            "k": [self.fx, 0.0, u0, 0.0, self.fy, v0, 0.0, 0.0, 1.0],
            "r": [1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
            "p": [self.fx, 0.0, u0, 0.0, 0.0, self.fy, v0, 0.0, 0.0, 0.0, 1.0, 0.0],
        }

    @classmethod
    def from_camera_info(cls, info: Mapping[str, Any], readout_s: float = 0.0) -> Camera:
        """Return the camera of a sensor_msgs/CameraInfo given as a mapping with width, height, k, d.

        Fisheye ("equidistant") models, skew and uncalibrated messages (k all zero) are a ``ValueError``.
        """
        try:
            k = [_number("k", value) for value in info["k"]]
            d = tuple(_number("d", value) for value in info["d"])
            width, height = int(info["width"]), int(info["height"])
            model = str(info.get("distortion_model") or "plumb_bob")
        except (KeyError, TypeError) as error:
            raise ValueError(f"info: field {error} is missing or of the wrong type") from error
        if model not in ("plumb_bob", "rational_polynomial"):
            raise ValueError(f"info: distortion_model {model!r} is neither plumb_bob nor rational_polynomial")
        return cls.from_matrix(width, height, k, d, readout_s)

    @classmethod
    def from_matrix(
        cls,
        width: int,
        height: int,
        matrix: ArrayLike,
        distortion: Sequence[float] = (),
        readout_s: float = 0.0,
    ) -> Camera:
        """Return the camera of a matrix K (3x3, or its nine values row by row) and OpenCV coefficients.

        Zeros on the diagonal, NaN, skew or a last row other than 0 0 1 are a ``ValueError`` naming
        ``matrix``.
        """
        k = np.asarray(matrix, dtype=np.float64)
        if k.size != 9:
            raise ValueError(f"matrix: {k.size} values instead of 3x3")
        k = k.reshape(3, 3)
        if not np.isfinite(k).all():
            raise ValueError("matrix: not finite")
        if k[0, 0] <= 0.0 or k[1, 1] <= 0.0:
            raise ValueError(
                f"matrix: focal lengths {k[0, 0]:g}, {k[1, 1]:g} are not positive; is it calibrated?"
            )
        if abs(k[0, 1]) > 1e-9 * k[0, 0] or k[1, 0] != 0.0 or not np.array_equal(k[2], [0.0, 0.0, 1.0]):
            raise ValueError("matrix: not of the form fx 0 cx, 0 fy cy, 0 0 1")
        return cls(
            width,
            height,
            float(k[0, 0]),
            float(k[1, 1]),
            float(k[0, 2]),
            float(k[1, 2]),
            tuple(float(c) for c in np.asarray(distortion, dtype=np.float64).ravel()),
            readout_s,
        )


def check_rotation(matrix: ArrayLike, name: str = "R_nc") -> Array:
    """Return ``matrix`` as a float64 rotation, shape (3, 3); ``ValueError`` naming it where it is none."""
    try:
        r = np.asarray(matrix, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: not an array of numbers") from error
    if r.shape != (3, 3):
        raise ValueError(f"{name}: shape {r.shape} is not (3, 3)")
    if not np.isfinite(r).all():
        raise ValueError(f"{name}: not finite")
    if np.abs(r @ r.T - np.eye(3)).max() > 1e-6 or np.linalg.det(r) < 0.0:
        raise ValueError(f"{name}: not a rotation (not orthogonal, or a mirror image)")
    return r


def _number(name: str, value: Any) -> float:
    """Return a finite float or raise ``ValueError`` naming the argument."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{name}: {value!r} is not a number") from error
    if not math.isfinite(number):
        raise ValueError(f"{name}: {value!r} is not finite")
    return number


def _raspberry_pi_v2(width: int, height: int, columns: int, rows_read: int) -> Camera:
    """Return a mode of the Raspberry Pi Camera v2 (IMX219) that shows ``columns`` of its 3280 sensor columns.

    The full width is 62.2 deg; a row takes 18.9 us to read (3448 pixel clocks at 182.4 MHz).
    """
    full_view_focal_px = 1640.0 / math.tan(math.radians(62.2) / 2.0)
    focal = full_view_focal_px * width / columns
    return Camera(width, height, focal, focal, readout_s=rows_read * 3448 / 182.4e6)


PRESETS: dict[str, Camera] = {
    "rpi-v2-640x480": _raspberry_pi_v2(640, 480, 3280, 1232),
    "rpi-v2-640x480-crop": _raspberry_pi_v2(640, 480, 1280, 480),
    "rpi-v2-1640x1232": _raspberry_pi_v2(1640, 1232, 3280, 1232),
    "rpi-v2-1920x1080": _raspberry_pi_v2(1920, 1080, 1920, 1080),
    "rpi-v2-3280x2464": _raspberry_pi_v2(3280, 2464, 3280, 2464),
}
"""Cameras by name, before calibration.

The Raspberry Pi Camera v2 has a trap (erratum 16): a picture of 640x480 pixels can be either the whole field
of view scaled down (``rpi-v2-640x480``: 62.2 deg, f = 530 px; the 1640x1232 mode, resized) or the sensor's
*native* 640x480 mode, which shows only the middle 1280x960 of its 3280x2464 pixels (``rpi-v2-640x480-crop``:
26.5 deg, f = 1359 px). Mistaking one for the other is a factor of 2.56 in every distance. In libcamera ask
for the 1640x1232 raw mode; to tell from pictures, see how wide a known length at a known distance appears.
"""

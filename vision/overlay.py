"""A picture of what the detector saw: red boundaries, compared places, rings, centre and its uncertainty."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.camera import Camera
from vision.fix import NoFix, VisionFix
from vision.redness import red_mask
from vision.target import RingTarget

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

_GREEN, _ORANGE, _BLUE, _GREY = (80, 220, 60), (0, 150, 255), (255, 150, 30), (200, 200, 200)


def draw_overlay(camera: Camera, target: RingTarget, image_bgr: Image, result: VisionFix | NoFix) -> Image:
    """Return a copy of the image, (height, width, 3) uint8 BGR, with what was found drawn into it.

    Grey: boundaries of red regions. Green and orange dots: places that agree with the target and that do
    not. Blue: the fitted edges, the centre, and the centre's 3-sigma ellipse (at least 2 px, so that it can
    be seen). Text: the position and its 1-sigma, or why there is no fix. Raises ``ValueError`` for an image
    that is not the camera's.
    """
    import cv2

    picture = camera.check_image(image_bgr).copy()
    contours, _ = cv2.findContours(red_mask(picture), cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    cv2.drawContours(picture, contours, -1, _GREY, 1)
    if isinstance(result, NoFix):
        _write(picture, [f"no fix: {result.reason}"])
        return picture
    if result.points_px is not None and result.agrees is not None:
        for point, agrees in zip(result.points_px, result.agrees, strict=True):
            place = (round(float(point[0])), round(float(point[1])))
            cv2.circle(picture, place, 1, _GREEN if agrees else _ORANGE, -1)
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    for radius in target.edges_m:
        circle = np.stack((radius * np.cos(angle), radius * np.sin(angle), np.zeros_like(angle)), axis=1)
        u, v = camera.project(circle @ result.rotation + result.position_cam_m)
        _curve(picture, u, v)
    u0, v0 = camera.project(result.position_cam_m)
    values, vectors = np.linalg.eigh(centre_ellipse(camera, result))
    axes = np.maximum(3.0 * np.sqrt(np.maximum(values, 0.0)), 2.0)
    ring = (vectors * axes) @ np.stack((np.cos(angle), np.sin(angle)))
    _curve(picture, u0 + ring[0], v0 + ring[1])
    cv2.drawMarker(picture, (round(float(u0)), round(float(v0))), _BLUE, cv2.MARKER_CROSS, 9, 1, cv2.LINE_AA)
    sigma_m = np.sqrt(np.diag(result.covariance_m2))
    x, y, z = result.position_cam_m
    lines = [
        f"x {x:.3f}  y {y:.3f}  z {z:.3f} m",
        f"1-sigma {' '.join(f'{1e3 * s:.1f}' for s in sigma_m)} mm",
    ]
    if result.tilt_rad is not None:
        lines.append(f"deck tilted by {np.degrees(np.hypot(*result.tilt_rad)):.1f} deg")
    _write(picture, lines)
    return picture


def centre_ellipse(camera: Camera, fix: VisionFix) -> Array:
    """Return the covariance (2, 2) [px^2] of the centre's place in the image."""
    x, y, z = fix.position_cam_m
    jacobian = np.array(
        [[camera.fx / z, 0.0, -camera.fx * x / z**2], [0.0, camera.fy / z, -camera.fy * y / z**2]]
    )
    covariance: Array = jacobian @ fix.covariance_m2 @ jacobian.T
    return covariance


def _curve(picture: Image, u: Array, v: Array) -> None:
    import cv2

    seen = np.isfinite(u) & np.isfinite(v) & (np.abs(u) < 1e5) & (np.abs(v) < 1e5)
    points = np.rint(16.0 * np.stack((u[seen], v[seen]), axis=1)).astype(np.int32)
    if len(points) > 1:
        cv2.polylines(picture, [points], False, _BLUE, 1, cv2.LINE_AA, 4)


def _write(picture: Image, lines: list[str]) -> None:
    import cv2

    for i, line in enumerate(lines):
        place = (6, picture.shape[0] - 8 - 16 * (len(lines) - 1 - i))
        cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 0, 0), 3, cv2.LINE_AA)
        cv2.putText(picture, line, place, cv2.FONT_HERSHEY_SIMPLEX, 0.42, (255, 255, 255), 1, cv2.LINE_AA)

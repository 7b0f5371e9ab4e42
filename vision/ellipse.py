"""The plane of a circle from its image: for cameras whose attitude is not known."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.plane import rotation_to_level

Array = NDArray[np.float64]


def plane_rotations(x: Array, y: Array, max_rms: float) -> list[Array]:
    """Return the rotations (camera to plane axes, (3, 3)) of the planes in which rays (x, y) form a circle.

    ``x``, ``y`` (n,) are undistorted rays of points on one circle. The cone through them is cut in circles
    by two families of planes (eigenvectors of its matrix); those that face the camera are returned, none
    where the points are no ellipse to ``max_rms`` (in units of rays).
    """
    conic = fit_conic(x, y)
    if conic is None:
        return []
    c, rms = conic
    if rms > max_rms:
        return []
    values, vectors = np.linalg.eigh(c)
    # An ellipse's cone has two eigenvalues of one sign; make them positive and the single one negative.
    if (values > 0.0).sum() == 1:
        values, vectors = -values[::-1], vectors[:, ::-1]
    if (values > 0.0).sum() != 2:
        return []
    l3, l2, l1 = values  # ascending: l3 < 0 < l2 <= l1
    a = np.sqrt(max(l1 - l2, 0.0) / (l1 - l3))
    b = np.sqrt((l2 - l3) / (l1 - l3))
    rotations: list[Array] = []
    for sign in (1.0, -1.0):
        normal = sign * a * vectors[:, 2] + b * vectors[:, 0]
        if normal[2] < 0.0:
            normal = -normal
        if normal[2] > 0.3:
            rotations.append(rotation_to_level(normal))
    return rotations


def fit_conic(x: Array, y: Array) -> tuple[Array, float] | None:
    """Return the symmetric matrix (3, 3) of the ellipse through points and their rms distance from it.

    Direct least squares (Fitzgibbon) through OpenCV, on centred and scaled points.
    """
    if len(x) < 8:
        return None
    mx, my = float(x.mean()), float(y.mean())
    scale = float(np.sqrt(((x - mx) ** 2 + (y - my) ** 2).mean()))
    if not scale > 0.0:
        return None
    points = np.stack(((x - mx) / scale, (y - my) / scale), axis=1).astype(np.float32)
    (cx, cy), (width, height), angle = cv2.fitEllipseDirect(points)
    if not (np.isfinite([cx, cy, width, height, angle]).all() and min(width, height) > 1e-3):
        return None
    cos, sin = np.cos(np.radians(angle)), np.sin(np.radians(angle))
    turn = np.array([[cos, sin], [-sin, cos]])
    quadratic = turn.T @ np.diag([4.0 / width**2, 4.0 / height**2]) @ turn
    centre = np.array([cx, cy])
    d = points.astype(np.float64) - centre
    level = np.sqrt(np.einsum("ni,ij,nj->n", d, quadratic, d))
    rms = float(np.sqrt((((level - 1.0) * 0.5 * np.sqrt(width * height)) ** 2).mean())) * scale
    shift = np.array(
        [[1.0 / scale, 0.0, -mx / scale - cx], [0.0, 1.0 / scale, -my / scale - cy], [0.0, 0.0, 1.0]]
    )
    middle = np.eye(3)
    middle[:2, :2] = quadratic
    middle[2, 2] = -1.0
    return shift.T @ middle @ shift, rms

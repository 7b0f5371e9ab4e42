"""The vision system of the thesis, equation by equation: seed chapter 4 with Table 5.4.

It is the baseline that the ring detector is compared with. Where a function departs from print it names the
erratum. What the thesis assumes stays: the target is equally spaced and seen from above (one Z for all of it,
erratum 12, and the middle of a box is the middle of the target, erratum 13), and the lens has no distortion.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from vision.camera import Camera, check_rotation
from vision.redness import Image, RgbThresholds, ratio_table, red_mask, sum_table
from vision.target import RingTarget

Array = NDArray[np.float64]
Contour = NDArray[np.int32]
"""Pixels (u, v) of a boundary, shape (n, 2)."""


@dataclass(frozen=True)
class ContourFilter:
    """Parameters of the contour filter; the defaults are Table 5.4.

    ``k1`` .. ``k4`` widen (4.7) and (4.8), ``min_circumference`` is the T_c of (4.4), ``min_area`` and
    ``max_area`` are the alphas of (4.9), as shares of the image. ``min_contours`` is step 5 of seed 4.3,
    printed as "greater than 2 (the algorithm needs at least 2)"; two can be measured, if they are the
    target's (erratum 11). The thesis takes every contour that passes for one; here successive ones must also
    be concentric, to ``max_offset`` of the smaller one's diameter, and evenly spaced, to a factor
    ``max_uneven`` (erratum 10). Infinity for both is the thesis as it was.
    """

    k1: float = -0.5416
    k2: float = 0.0656
    k3: float = 0.0079
    k4: float = 5 * 0.0079
    min_circumference: float = 100.0
    min_area: float = 0.1 / 100.0
    max_area: float = 20.0 / 100.0
    min_contours: int = 2
    max_offset: float = 0.25
    max_uneven: float = 1.6

    def __post_init__(self) -> None:
        if not (self.k1 <= self.k2 and self.k3 <= self.k4):
            raise ValueError("k1, k3: above k2, k4; no contour can pass")
        if not 0.0 < self.min_area < self.max_area < 1.0:
            raise ValueError(
                f"min_area, max_area: {self.min_area}, {self.max_area} do not ascend between 0 and 1"
            )
        if self.min_contours < 2:
            raise ValueError(f"min_contours: {self.min_contours}; a distance needs two contours")
        if not (self.max_offset > 0.0 and self.max_uneven >= 1.0):
            raise ValueError(f"max_offset, max_uneven: {self.max_offset}, {self.max_uneven} let nothing pass")


class Extremes(NamedTuple):
    """Extreme pixel coordinates of a contour, seed (4.16), (4.17)."""

    u_min: float
    u_max: float
    v_min: float
    v_max: float


@dataclass(frozen=True)
class ThesisResult:
    """What came of one image.

    ``position_cam_m`` is P^c, shape (3,), or None, and then ``reason`` says why; ``relative_ned_m`` is (4.31)
    where an attitude was given. ``contours`` are those that passed the filter, largest first; ``traced`` is
    how many there were.
    """

    position_cam_m: Array | None
    relative_ned_m: Array | None
    contours: tuple[Contour, ...]
    traced: int
    reason: str


def circumference(contour: Contour) -> int:
    """Return c_blob, the number of boundary pixels, seed (4.3); about 2 sqrt(2) d for a circle, not pi d
    (erratum 7).
    """
    return len(contour)


def passes_circumference(contour: Contour, minimum: float) -> bool:
    """Return whether c_blob > T_c, seed (4.4)."""
    return circumference(contour) > minimum


def extremes(contour: Contour) -> Extremes:
    """Return the least and greatest u and v of a contour, seed (4.16), (4.17)."""
    (u_min, v_min), (u_max, v_max) = contour.min(axis=0), contour.max(axis=0)
    return Extremes(float(u_min), float(u_max), float(v_min), float(v_max))


def diameter(contour: Contour) -> float:
    """Return d_blob [px], seed (4.5): the mean of the extents in u and v.

    Printed with a division by two, which is a radius, and then no disc passes (4.7) (erratum 6); the extent
    of pixels a..b is b - a + 1.
    """
    box = extremes(contour)
    return 0.5 * ((box.u_max - box.u_min + 1.0) + (box.v_max - box.v_min + 1.0))


def area(contour: Contour) -> float:
    """Return A_blob = pi (d / 2)^2 [px^2], seed (4.6)."""
    return math.pi * (diameter(contour) / 2.0) ** 2


def passes_diameter_ratio(contour: Contour, k1: float, k2: float) -> bool:
    """Return whether c / d is within [k1, k2] of pi, seed (4.7)."""
    return k1 + math.pi <= circumference(contour) / diameter(contour) <= k2 + math.pi


def passes_area_ratio(contour: Contour, k3: float, k4: float) -> bool:
    """Return whether A / c^2 is within [k3, k4] of 1 / (4 pi), seed (4.8)."""
    return k3 + 0.25 / math.pi <= area(contour) / circumference(contour) ** 2 <= k4 + 0.25 / math.pi


def passes_area(contour: Contour, image_area: float, minimum: float, maximum: float) -> bool:
    """Return whether A is between the shares alpha of the image's area, seed (4.9)."""
    return minimum * image_area <= area(contour) <= maximum * image_area


def passes_filter(contour: Contour, image_area: float, limits: ContourFilter) -> bool:
    """Return whether a contour passes (4.4), (4.7), (4.8) and (4.9)."""
    return (
        passes_circumference(contour, limits.min_circumference)
        and passes_diameter_ratio(contour, limits.k1, limits.k2)
        and passes_area_ratio(contour, limits.k3, limits.k4)
        and passes_area(contour, image_area, limits.min_area, limits.max_area)
    )


def trace_contours(mask: Image, min_circumference: float = 0.0) -> list[Contour]:
    """Return the boundaries of the blobs of a mask and of their holes, as Matlab's ``bwboundaries`` does.

    A hole's boundary runs on the hole's own pixels. OpenCV's runs on the blob's around it, which makes every
    second distance one pixel too short and the others too long: +3.5 % of Z at 5 m, +21 % at 10 m for 1 m
    (erratum 8). Blobs connect across corners, holes do not. Holes whose box is too small for
    ``min_circumference`` are not traced.
    """
    import cv2

    outer, tree = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    contours = [
        np.asarray(c[:, 0], dtype=np.int32)
        for c, link in zip(outer, tree[0] if len(outer) else (), strict=True)
        if link[3] < 0
    ]
    _, labels, stats, _ = cv2.connectedComponentsWithStats(cv2.bitwise_not(mask), connectivity=4)
    u, v, du, dv, _ = stats.T
    inside = (u > 0) & (v > 0) & (u + du < mask.shape[1]) & (v + dv < mask.shape[0])
    inside[0] = False  # what is red
    for k in np.flatnonzero(inside & (2 * (du + dv) > min_circumference)):
        hole = (labels[v[k] : v[k] + dv[k], u[k] : u[k] + du[k]] == k).astype(np.uint8)
        corner = np.array([u[k], v[k]], dtype=np.int32)
        for c in cv2.findContours(hole, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
            contours.append(np.asarray(c[:, 0], dtype=np.int32) + corner)
    return contours


def project(
    point_cam_m: ArrayLike, focal_px: float, optical_centre: tuple[float, float]
) -> tuple[float, float]:
    """Return (u, v) of a point P^c, seed (4.10) to (4.12) (with Pi_2 Pi_1 in this order, erratum 5)."""
    x, y, z = np.asarray(point_cam_m, dtype=np.float64)
    return focal_px * x / z + optical_centre[0], focal_px * y / z + optical_centre[1]


def depth_from_pair(real_m: float, pixels: float, focal_px: float) -> float:
    """Return Z^c of two points |real_m| apart along a row (4.13), (4.14) or a column (4.15), |pixels| in the
    image.
    """
    return focal_px * abs(real_m) / abs(pixels)


def spacings_u(boxes: list[Extremes]) -> Array:
    """Return the 2 (N - 1) distances between successive contours in u [px], seed (4.18); boxes sorted by
    size.
    """
    steps = [(abs(a.u_min - b.u_min), abs(a.u_max - b.u_max)) for a, b in itertools.pairwise(boxes)]
    return np.asarray(steps, dtype=np.float64).ravel()


def spacings_v(boxes: list[Extremes]) -> Array:
    """Return the 2 (N - 1) distances between successive contours in v [px], seed (4.19); boxes sorted by
    size.
    """
    steps = [(abs(a.v_min - b.v_min), abs(a.v_max - b.v_max)) for a, b in itertools.pairwise(boxes)]
    return np.asarray(steps, dtype=np.float64).ravel()


def depth_from_spacings(spacings_px: Array, real_m: float, focal_px: float) -> float:
    """Return Z_u or Z_v [m] of all distances in one direction, seed (4.20), (4.21).

    One ratio of sums: the printed mean of reciprocals of small integers is biased, and infinite where one of
    them is zero (erratum 9). Not finite where all are zero.
    """
    total = float(spacings_px.sum())
    return math.inf if total <= 0.0 else real_m * focal_px * spacings_px.size / total


def mean_depth(depth_u_m: float, depth_v_m: float) -> float:
    """Return Z^c, seed (4.22)."""
    return 0.5 * (depth_u_m + depth_v_m)


def target_centre(boxes: list[Extremes]) -> tuple[float, float]:
    """Return (u, v) of the target as the mean of all extremes, seed (4.23), (4.24)."""
    return (
        sum(b.u_max + b.u_min for b in boxes) / (2.0 * len(boxes)),
        sum(b.v_max + b.v_min for b in boxes) / (2.0 * len(boxes)),
    )


def optical_centre(camera: Camera) -> tuple[float, float]:
    """Return (u0, v0), seed (4.25): the calibrated principal point, (U - 1) / 2 without one (erratum 14)."""
    return camera.centre


def lateral(depth_m: float, pixel: float, optical: float, focal_px: float) -> float:
    """Return X^c of a u, seed (4.26), or Y^c of a v, seed (4.27)."""
    return depth_m * (pixel - optical) / focal_px


def back_project(pixel: tuple[float, float], depth_m: float, matrix: Array) -> Array:
    """Return P^c = K^-1 (u, v, 1) / lambda with 1 / lambda = Z^c, seed (4.28)."""
    return np.asarray(depth_m * np.linalg.solve(matrix, np.array([pixel[0], pixel[1], 1.0])))


def camera_position(rotation: ArrayLike, translation: ArrayLike) -> Array:
    """Return the camera's position in the world, C = -R' T, seed (4.29)."""
    return np.asarray(-np.asarray(rotation).T @ np.asarray(translation))


def camera_relative(R_nc: ArrayLike, position_cam_m: ArrayLike) -> Array:
    """Return P_cam^n - P_target^n = -R_c^n P^c, seed (4.30)."""
    return np.asarray(-np.asarray(R_nc) @ np.asarray(position_cam_m))


def vehicle_relative(R_nb: ArrayLike, R_cb: ArrayLike, position_cam_m: ArrayLike) -> Array:
    """Return P_uav,rel^n = -R_b^n (R_c^b P^c), seed (4.31); ``R_cb`` is (2.8). Its Z is negative above the
    target.
    """
    return np.asarray(-np.asarray(R_nb) @ (np.asarray(R_cb).T @ np.asarray(position_cam_m)))


def doubt(boxes: list[Extremes], limits: ContourFilter) -> str:
    """Return why these contours, sorted by size, cannot be one equally spaced target, or nothing (erratum
    10).
    """
    middles = [np.array([b.u_min + b.u_max, b.v_min + b.v_max]) / 2.0 for b in boxes]
    extents = [0.5 * (b.u_max - b.u_min + b.v_max - b.v_min) + 1.0 for b in boxes]
    for k in range(1, len(boxes)):
        if float(np.linalg.norm(middles[k] - middles[k - 1])) > limits.max_offset * extents[k]:
            return "the contours that pass the filter are not concentric"
    steps = -np.diff(extents)
    if steps.size and float(steps.max()) > limits.max_uneven * float(steps.min()):
        return "the contours that pass the filter are not equally spaced"
    return ""


def thesis_detect(
    camera: Camera,
    target: RingTarget,
    image_bgr: Image,
    R_nc: ArrayLike | None = None,
    thresholds: RgbThresholds | None = None,
    limits: ContourFilter | None = None,
) -> ThesisResult:
    """Find the target and its position as seed 4.3 does, steps 2 to 8.

    ``R_nc`` (camera to NED) is used for ``relative_ned_m`` alone: the thesis does not use attitude to
    measure. Raises ``ValueError`` naming the argument for an image that is not the camera's, a matrix that is
    no rotation, or a target that is not equally spaced.
    """
    spacing = target.spacing_m
    if spacing is None:
        raise ValueError(
            "target: its edges are not equally spaced, which the method of the thesis needs (seed 4.18)"
        )
    image = camera.check_image(image_bgr)
    attitude = None if R_nc is None else check_rotation(R_nc, "R_nc")
    chosen = ContourFilter() if limits is None else limits
    colour = RgbThresholds() if thresholds is None else thresholds
    mask = red_mask(image, ratio_table(colour.t1, 0), sum_table(colour.t2))
    traced = trace_contours(mask, chosen.min_circumference)
    passed = [c for c in traced if passes_filter(c, float(mask.size), chosen)]
    passed.sort(key=diameter, reverse=True)

    def result(position: Array | None, reason: str) -> ThesisResult:
        relative = None if position is None or attitude is None else camera_relative(attitude, position)
        return ThesisResult(position, relative, tuple(passed), len(traced), reason)

    if len(passed) < chosen.min_contours:
        return result(
            None, f"{len(passed)} of {len(traced)} contours pass the filter, {chosen.min_contours} needed"
        )
    boxes = [extremes(c) for c in passed]
    why_not = doubt(boxes, chosen)
    if why_not:
        return result(None, why_not)
    depth = mean_depth(
        depth_from_spacings(spacings_u(boxes), spacing, camera.fx),
        depth_from_spacings(spacings_v(boxes), spacing, camera.fy),
    )
    if not math.isfinite(depth):
        return result(None, "the contours that pass the filter have no distance between them")
    (u, v), (u0, v0) = target_centre(boxes), optical_centre(camera)
    return result(np.array([lateral(depth, u, u0, camera.fx), lateral(depth, v, v0, camera.fy), depth]), "")

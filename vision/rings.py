"""From an image to hypotheses about the target: red mask, contours, circles in the level plane, ring labels.

With a known attitude every pixel's ray is turned into the level frame and cut with the plane one metre
below the camera: ``q = (d_x / d_z, d_y / d_z)``. There the target's edges are exact, concentric circles of
radius ``r_k * kappa`` about ``c = (X / h, Y / h)`` with ``kappa = 1 / h``, whatever the camera's roll and
pitch were; the perspective bias of ellipse centres and the foreshortening of seed 4.2 do not arise.

Two ways lead to a hypothesis. ``identify_circles`` takes whole contours as circles and labels them by their
ratio of radii and by their type (outside of red, or edge of a hole). ``identify_votes`` takes single
boundary points with their normals, which pass through the common centre, and so works where every ring is
cut by the frame, a bar or a shadow. Both return several hypotheses, best first; the photometric fit decides.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.plane import LevelPlane

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Image = NDArray[np.uint8]

CONTOUR_INSET_PX = 0.45
"""How far inside the red region a contour point lies, in pixels of the mask (half a pixel less the
threshold's overshoot: a ratio threshold of 1.3 trips at 38 % red)."""


@dataclass(frozen=True, slots=True)
class Contours:
    """Boundary points of red regions.

    ``u``, ``v`` (n,) full-resolution pixel coordinates; contour ``i`` is ``start[i]:start[i + 1]``;
    ``hole`` (m,) tells the edge of a hole from an outside edge; ``step_px`` is the size of a mask pixel in
    image pixels.
    """

    u: Array
    v: Array
    start: IntArray
    hole: NDArray[np.bool_]
    step_px: float

    def __len__(self) -> int:
        """Return the number of contours."""
        return len(self.hole)


@dataclass(frozen=True, slots=True)
class Hypothesis:
    """A place and scale of the target in the level plane.

    ``centre`` (2,) and ``kappa`` [1/m] give edge ``k`` the circle ``|q - centre| = kappa * r_k``; ``edges``
    are the labels that support it; ``score`` is comparable within one image (share of the expected boundary
    that was found).
    """

    centre: Array
    kappa: float
    edges: tuple[int, ...]
    score: float


def halve(image: Image) -> Image:
    """Return the image averaged over blocks of 2x2 pixels; block (i, j) is centred at (2 j + 0.5, 2 i +
    0.5)."""
    height, width = image.shape[:2]
    even = image[: height - height % 2, : width - width % 2]
    return np.asarray(cv2.resize(even, (width // 2, height // 2), interpolation=cv2.INTER_AREA))


def find_contours(mask: Image, half: bool, min_points: int = 6, max_contours: int = 48) -> Contours:
    """Trace the boundaries of a mask; the longest ``max_contours`` with at least ``min_points`` are kept."""
    found, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    step = 2.0 if half else 1.0
    keep = [i for i, points in enumerate(found) if len(points) >= min_points]
    if len(keep) > max_contours:
        keep = sorted(keep, key=lambda i: -len(found[i]))[:max_contours]
    if not keep:
        empty = np.empty(0)
        return Contours(empty, empty, np.zeros(1, dtype=np.int64), np.empty(0, dtype=bool), step)
    xy = np.concatenate([found[i] for i in keep]).reshape(-1, 2).astype(np.float64)
    start = np.zeros(len(keep) + 1, dtype=np.int64)
    np.cumsum([len(found[i]) for i in keep], out=start[1:])
    parents = np.asarray(hierarchy).reshape(-1, 4)[:, 3]
    if half:
        xy *= 2.0
        xy += 0.5
    return Contours(xy[:, 0], xy[:, 1], start, parents[keep] >= 0, step)


@dataclass(frozen=True, slots=True)
class Circles:
    """Circles through whole contours, in the level plane: centres (m, 2), radii (m,), radial spread (m,)."""

    centre: Array
    radius: Array
    spread: Array
    count: IntArray


def fit_circles(qx: Array, qy: Array, start: IntArray) -> Circles:
    """Fit a circle to each run of points by linear least squares (Kasa), all runs at once.

    ``qx``, ``qy`` (n,); run ``i`` is ``start[i]:start[i + 1]``. The radius is the mean distance from the
    centre, the spread the standard deviation of that distance.
    """
    first = start[:-1]
    count = np.diff(start)
    mx = np.add.reduceat(qx, first) / count
    my = np.add.reduceat(qy, first) / count
    x = qx - np.repeat(mx, count)
    y = qy - np.repeat(my, count)
    xx, yy = x * x, y * y
    z = xx + yy
    sums = np.add.reduceat(np.stack((xx, yy, x * y, x * z, y * z)), first, axis=1)
    sxx, syy, sxy, sxz, syz = sums
    determinant = sxx * syy - sxy * sxy
    determinant = np.where(determinant > 1e-12 * (sxx + syy) ** 2, determinant, np.inf)
    ax = 0.5 * (sxz * syy - syz * sxy) / determinant
    ay = 0.5 * (syz * sxx - sxz * sxy) / determinant
    rho = np.hypot(x - np.repeat(ax, count), y - np.repeat(ay, count))
    s1, s2 = np.add.reduceat(np.stack((rho, rho * rho)), first, axis=1) / count
    spread = np.sqrt(np.maximum(s2 - s1 * s1, 0.0))
    return Circles(np.stack((ax + mx, ay + my), axis=1), s1, spread, count)


def identify_circles(
    contours: Contours, plane: LevelPlane, edges_m: Array, tolerance: float = 0.06, limit: int = 4
) -> list[Hypothesis]:
    """Label whole contours as edges of the target and return hypotheses, best first.

    Every contour that is a circle to within ``tolerance`` of its radius (plus a pixel) is tried as every
    edge of its type; the other circles about the same centre then have to lie at that scale's radii. A
    single small disc is offered as the outermost edge, with a low score.
    """
    if not len(contours):
        return []
    qx, qy = plane.from_pixels(contours.u, contours.v)
    inside = plane.inside(contours.u, contours.v, margin_px=contours.step_px)
    start = contours.start
    hole = contours.hole
    if not inside.all():
        counts = np.add.reduceat(inside, start[:-1])
        qx, qy = qx[inside], qy[inside]
        hole = hole[counts >= 6]
        few = np.repeat(counts < 6, counts)
        qx, qy = qx[~few], qy[~few]
        start = np.concatenate(([0], np.cumsum(counts[counts >= 6])))
        if len(start) < 2:
            return []
    circles = fit_circles(qx, qy, start)
    unit = contours.step_px * plane.units_per_pixel(circles.centre[:, 0], circles.centre[:, 1])
    side = np.where(hole, -1.0, 1.0)
    radius = circles.radius + CONTOUR_INSET_PX * side * unit
    good = (circles.spread < tolerance * circles.radius + 0.45 * unit) & (radius > 0.3 * unit)
    good &= np.isfinite(radius)
    if not good.any():
        return []
    return _label(
        circles.centre[good], radius[good], side[good], circles.count[good], unit[good], edges_m, limit
    )


def _label(
    centre: Array, radius: Array, side: Array, count: IntArray, unit: Array, edges_m: Array, limit: int
) -> list[Hypothesis]:
    edge_side = np.where(np.arange(len(edges_m)) % 2 == 0, 1.0, -1.0)
    trial_circle, trial_edge = np.nonzero(side[:, None] == edge_side[None, :])
    kappa = radius[trial_circle] / edges_m[trial_edge]
    # Each trial against each circle: nearest edge of the circle's type, and the distance between centres.
    predicted = kappa[:, None] * edges_m[None, :]
    misfit = np.abs(predicted[:, None, :] - radius[None, :, None])
    misfit = np.where(side[None, :, None] == edge_side[None, None, :], misfit, np.inf)
    label = np.argmin(misfit, axis=2)
    error = np.take_along_axis(misfit, label[:, :, None], axis=2)[:, :, 0]
    apart = np.hypot(
        centre[trial_circle, 0][:, None] - centre[None, :, 0],
        centre[trial_circle, 1][:, None] - centre[None, :, 1],
    )
    slack = 0.6 * unit[None, :]
    match = (error < 0.035 * radius[None, :] + slack) & (apart < 0.12 * radius[None, :] + 1.5 * slack)
    weight = np.where(match, count[None, :] * unit[None, :], 0.0)
    support = weight.sum(axis=1)
    # The support that a complete target would have: circumference of the edges that are large enough to be
    # traced.
    visible = predicted > 1.5 * unit[trial_circle][:, None]
    expected = 2.0 * np.pi * (predicted * visible).sum(axis=1) + 1e-12
    n_matched = match.sum(axis=1)
    score = support / expected * np.minimum(1.0, 0.5 * n_matched)
    lonely = (n_matched < 2) & ~((trial_edge == 0) & (radius[trial_circle] < 25.0 * unit[trial_circle]))
    score[lonely] = 0.0
    # Nothing red lies outside the outermost edge, about the same centre.
    outside = (apart < 0.15 * radius[None, :]) & (side[None, :] > 0.0)
    outside &= radius[None, :] > 1.15 * predicted[:, :1] + unit[None, :]
    score[outside.any(axis=1)] = 0.0
    hypotheses: list[Hypothesis] = []
    clear = int(np.argmax(score))
    if score[clear] > 0.6 and n_matched[clear] >= min(4, len(edges_m)):
        limit = 1
    for t in np.argsort(-score, kind="stable"):
        if score[t] <= 0.0 or len(hypotheses) == limit:
            break
        m = match[t]
        w = count[m] / unit[m]
        r = edges_m[label[t, m]]
        scale = float((w * r * radius[m]).sum() / (w * r * r).sum())
        place = (w[:, None] * centre[m]).sum(axis=0) / w.sum()
        if any(
            abs(h.kappa / scale - 1.0) < 0.05 and np.hypot(*(h.centre - place)) < 0.2 * scale * edges_m[0]
            for h in hypotheses
        ):
            continue
        labels = tuple(sorted({int(k) for k in label[t, m]}))
        hypotheses.append(Hypothesis(place, scale, labels, float(score[t])))
    return hypotheses

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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from vision.lines import edge_sides
from vision.view import View, either, inside, pixel_rays, rays_to_plane, units_per_pixel

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Image = NDArray[np.uint8]

CONTOUR_INSET_PX = 0.45
"""How far inside the red region a contour point lies, in pixels of the mask (half a pixel less the
threshold's overshoot: a ratio threshold of 1.3 trips at 38 % red)."""
MIN_POINTS = 6
"""Fewest points of a contour that is looked at."""
ENOUGH_POINTS = 100
"""Points of a contour beyond which not all are used."""
TOLERANCE = 0.06
"""Spread of a circle's radius, relative to it, up to which a contour is taken for one."""


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


def find_contours(mask: Image, half: bool, min_points: int = MIN_POINTS, max_contours: int = 48) -> Contours:
    """Trace the boundaries of a mask; the longest ``max_contours`` with at least ``min_points`` are kept."""
    found, hierarchy = cv2.findContours(mask, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    step = 2.0 if half else 1.0
    keep = [i for i, points in enumerate(found) if len(points) >= min_points]
    if len(keep) > max_contours:
        keep = sorted(keep, key=lambda i: -len(found[i]))[:max_contours]
    if not keep:
        empty = np.empty(0)
        return Contours(empty, empty, np.zeros(1, dtype=np.int64), np.empty(0, dtype=bool), step)
    xy = np.concatenate([found[i] for i in keep]).reshape(-1, 2).T.astype(np.float64, order="C")
    start = np.zeros(len(keep) + 1, dtype=np.int64)
    np.cumsum([len(found[i]) for i in keep], out=start[1:])
    parents = np.asarray(hierarchy).reshape(-1, 4)[:, 3]
    if half:
        xy *= 2.0
        xy += 0.5
    return Contours(xy[0], xy[1], start, parents[keep] >= 0, step)


def contour_sums(
    view: View, u: Array, v: Array, start: IntArray, stride: IntArray, margin_px: float
) -> tuple[Array, IntArray]:
    """Fit a circle to each contour's points inside the image, in the level plane, by linear least squares
    (Kasa).

    Contour ``i`` is ``start[i]:start[i + 1]`` of the pixels ``u``, ``v`` (n,), of which every
    ``stride[i]``-th is used. Returned are (m, 4) centre x, y, radius (the mean distance from the centre) and
    spread (the standard deviation of that distance), and how many points (m,); contours of fewer than
    ``MIN_POINTS`` have zeros.
    """
    length = np.diff(start)
    index = np.arange(len(u)) - np.repeat(start[:-1], length)
    seen = inside(view, u, v, margin_px) & (index % np.repeat(stride, length) == 0)
    count = np.add.reduceat(seen, start[:-1], dtype=np.int64)
    out = np.zeros((len(count), 4))
    many = count >= MIN_POINTS
    use = seen & np.repeat(many, length)
    if not use.any():
        return out, count
    u, v, n = u[use], v[use], count[many]
    x, y = pixel_rays(view, u, v)
    qx, qy = rays_to_plane(view, x, y, v)
    first = np.cumsum(n) - n
    mx = np.add.reduceat(qx, first) / n
    my = np.add.reduceat(qy, first) / n
    x = qx - np.repeat(mx, n)
    y = qy - np.repeat(my, n)
    xx, yy = x * x, y * y
    z = xx + yy
    sums = np.add.reduceat(np.stack((xx, yy, x * y, x * z, y * z)), first, axis=1)
    ax, ay = kasa_centre(sums[0], sums[1], sums[2], sums[3], sums[4])
    rho = np.hypot(x - np.repeat(ax, n), y - np.repeat(ay, n))
    s1, s2 = np.add.reduceat(np.stack((rho, rho * rho)), first, axis=1) / n
    out[many] = np.stack((ax + mx, ay + my, s1, np.sqrt(np.maximum(s2 - s1 * s1, 0.0))), axis=1)
    return out, count


def kasa_centre(sxx: Any, syy: Any, sxy: Any, sxz: Any, syz: Any) -> tuple[Any, Any]:
    """Return the centre of a circle from moments about the points' mean, with z = x^2 + y^2."""
    determinant = sxx * syy - sxy * sxy
    determinant = either(determinant > 1e-12 * (sxx + syy) ** 2, determinant, np.inf)
    return 0.5 * (sxz * syy - syz * sxy) / determinant, 0.5 * (syz * sxx - sxz * sxy) / determinant


def identify_circles(
    contours: Contours, view: View, edges_m: Array, labeller: Labeller | None = None, limit: int = 4
) -> list[Hypothesis]:
    """Label whole contours as edges of the target and return hypotheses, best first.

    Every contour that is a circle (to within ``TOLERANCE`` of its radius plus about half a pixel) is tried as
    every edge of its type; the other circles about the same centre then have to lie at that scale's radii. A
    single small disc is offered as the outermost edge, with a low score. ``labeller`` is ``label_circles`` or
    its compiled form.
    """
    if not len(contours):
        return []
    label = label_circles if labeller is None else labeller
    found, edges = label(
        view, contours.u, contours.v, contours.start, contours.hole, contours.step_px, edges_m, limit
    )
    return [
        Hypothesis(row[:2], float(row[2]), tuple(np.flatnonzero(seen).tolist()), float(row[3]))
        for row, seen in zip(found, edges, strict=True)
    ]


def label_circles(
    view: View,
    u: Array,
    v: Array,
    start: IntArray,
    hole: NDArray[np.bool_],
    step_px: float,
    edges_m: Array,
    limit: int,
) -> tuple[Array, NDArray[np.bool_]]:
    """Do the work of ``identify_circles`` on plain arrays: (h, 4) centre x, y, kappa and score, and (h, k) which
    edges support each.
    """
    n_edges = len(edges_m)
    stride = np.maximum(np.diff(start) // ENOUGH_POINTS, 1)
    sums, points = contour_sums(view, u, v, start, stride, step_px)
    good = np.zeros(len(points), dtype=np.bool_)
    side, unit, radii = np.zeros(len(points)), np.zeros(len(points)), np.zeros(len(points))
    for i in range(len(points)):
        if points[i] >= MIN_POINTS:
            side[i] = -1.0 if hole[i] else 1.0
            unit[i] = step_px * units_per_pixel(view, sums[i, 0], sums[i, 1])
            radii[i] = sums[i, 2] + CONTOUR_INSET_PX * side[i] * unit[i]
            # Not true of NaN.
            good[i] = sums[i, 3] < TOLERANCE * sums[i, 2] + 0.45 * unit[i] and radii[i] > 0.3 * unit[i]
    chosen = np.flatnonzero(good)
    centre, radius, side, unit = sums[chosen, :2].copy(), radii[chosen], side[chosen], unit[chosen]
    count = points[chosen] * stride[chosen]
    length = count * unit
    # Each circle as each edge of its type.
    trials = [(i, e) for i in range(len(chosen)) for e in range(n_edges) if (e % 2 == 0) == (side[i] > 0.0)]
    if not trials:
        return np.zeros((0, 4)), np.zeros((0, n_edges), dtype=np.bool_)
    circle = np.array([trial[0] for trial in trials])
    edge = np.array([trial[1] for trial in trials])
    score, label, matched = match_trials(centre, radius, side, length, unit, circle, edge, edges_m)
    return _distinct(centre, radius, count / unit, score, label, matched, edges_m, limit)


Labeller = Callable[
    [View, Array, Array, IntArray, NDArray[np.bool_], float, Array, int], tuple[Array, NDArray[np.bool_]]
]


def is_match(error: Any, apart: Any, radius: Any, unit: Any) -> Any:
    """Return whether a circle lies where the target has an edge: ``error`` of its radius, ``apart`` its centre."""
    return (error < 0.035 * radius + 0.6 * unit) & (apart < 0.12 * radius + 0.9 * unit)


def is_around(apart: Any, radius: Any, side: Any, unit: Any, outermost: Any) -> Any:
    """Return whether a circle is red outside of the outermost edge, about the same centre: there is none."""
    return (apart < 0.15 * radius) & (side > 0.0) & (radius > 1.15 * outermost + unit)


def match_trials(
    centre: Array,
    radius: Array,
    side: Array,
    length: Array,
    unit: Array,
    circle: IntArray,
    edge: IntArray,
    edges_m: Array,
) -> tuple[Array, IntArray, NDArray[np.bool_]]:
    """Score the trials "circle ``circle[i]`` is edge ``edge[i]``" (t,) by how much boundary agrees with each.

    Returned are the scores (t,), and for each circle its nearest edge and whether it matches it (t, m).
    """
    edge_side = edge_sides(len(edges_m))
    kappa = radius[circle] / edges_m[edge]
    predicted = kappa[:, None] * edges_m
    misfit = np.abs(predicted[:, None, :] - radius[None, :, None])
    misfit = np.where(side[None, :, None] == edge_side, misfit, np.inf)
    label = np.argmin(misfit, axis=2)
    error = np.take_along_axis(misfit, label[:, :, None], axis=2)[:, :, 0]
    apart = np.hypot(
        centre[circle, 0][:, None] - centre[None, :, 0], centre[circle, 1][:, None] - centre[None, :, 1]
    )
    matched = is_match(error, apart, radius[None, :], unit[None, :])
    support = np.where(matched, length[None, :], 0.0).sum(axis=1)
    # The support that a complete target would have: circumference of the edges that are large enough to be
    # traced.
    traceable = predicted > 1.5 * unit[circle][:, None]
    expected = 2.0 * np.pi * (predicted * traceable).sum(axis=1) + 1e-12
    n_matched = matched.sum(axis=1)
    score = support / expected * np.minimum(1.0, 0.5 * n_matched)
    score[(n_matched < 2) & ~((edge == 0) & (radius[circle] < 25.0 * unit[circle]))] = 0.0
    score[is_around(apart, radius[None, :], side[None, :], unit[None, :], predicted[:, :1]).any(axis=1)] = 0.0
    return score, label, matched


def _distinct(
    centre: Array,
    radius: Array,
    weight: Array,
    score: Array,
    label: IntArray,
    matched: NDArray[np.bool_],
    edges_m: Array,
    limit: int,
) -> tuple[Array, NDArray[np.bool_]]:
    """Return the best hypotheses that differ from each other, fitted to the circles that support them."""
    found, edges = np.zeros((limit, 4)), np.zeros((limit, len(edges_m)), dtype=np.bool_)
    n = 0
    best = int(np.argmax(score))
    if score[best] > 0.6 and np.count_nonzero(matched[best]) >= min(4, len(edges_m)):
        limit = 1
    for t in np.argsort(-score, kind="mergesort"):
        if score[t] <= 0.0 or n == limit:
            break
        total, x, y, wr, wrr = 0.0, 0.0, 0.0, 0.0, 0.0
        for j in np.flatnonzero(matched[t]):
            w, r = weight[j], edges_m[label[t, j]]
            total += w
            x += w * centre[j, 0]
            y += w * centre[j, 1]
            wr += w * r * radius[j]
            wrr += w * r * r
        kappa, x, y = wr / wrr, x / total, y / total
        known = False
        for i in range(n):
            near = np.hypot(found[i, 0] - x, found[i, 1] - y) < 0.2 * kappa * edges_m[0]
            known = known or (near and abs(found[i, 2] / kappa - 1.0) < 0.05)
        if not known:
            found[n, 0], found[n, 1], found[n, 2], found[n, 3] = x, y, kappa, score[t]
            for j in np.flatnonzero(matched[t]):
                edges[n, label[t, j]] = True
            n += 1
    return found[:n], edges[:n]

"""The target from single boundary points and their normals, where no ring is whole."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.plane import LevelPlane
from vision.rings import CONTOUR_INSET_PX, Contours, Hypothesis

Array = NDArray[np.float64]


def identify_votes(
    contours: Contours, plane: LevelPlane, edges_m: Array, *, n_pairs: int = 400, limit: int = 4
) -> list[Hypothesis]:
    """Find the common centre of arcs, then the scale, from single boundary points and their normals.

    For targets of which no ring is whole: cut by the image's border, a bar, a shadow's edge or glare. Pairs
    of normals vote for centres; along the radius the signed edges (outside of red, edge of a hole) are
    matched with the target's for every scale. The draw of pairs is fixed, so that equal images give equal
    answers.
    """
    points = _boundary_points(contours, plane)
    if points is None:
        return []
    p, normal, unit = points
    rng = np.random.default_rng(20260131)
    hypotheses: list[Hypothesis] = []
    for _ in range(3):
        if len(p) < 24:
            break
        found = _common_centre(p, normal, unit, rng, n_pairs)
        if found is None:
            break
        centre, votes = found
        hypotheses += _scales(p[votes], normal[votes], unit[votes], centre, plane, edges_m, limit)
        p, normal, unit = p[~votes], normal[~votes], unit[~votes]
    hypotheses.sort(key=lambda h: -h.score)
    return hypotheses[:limit]


def _boundary_points(
    contours: Contours, plane: LevelPlane, max_points: int = 900
) -> tuple[Array, Array, Array] | None:
    """Return points in the level plane (n, 2), unit normals from red to not red (n, 2), and the mask's
    pixel (n,)."""
    count = np.diff(contours.start)
    if not len(count) or count.max() < 16:
        return None
    qx, qy = plane.from_pixels(contours.u, contours.v)
    first = np.repeat(contours.start[:-1], count)
    length = np.repeat(count, count)
    index = np.arange(len(qx)) - first
    reach = np.clip(length // 6, 2, 5)
    ahead, behind = first + (index + reach) % length, first + (index - reach) % length
    tx, ty = qx[ahead] - qx[behind], qy[ahead] - qy[behind]
    norm = np.hypot(tx, ty)
    after = first + (index + 1) % length
    area = np.add.reduceat(qx * qy[after] - qx[after] * qy, contours.start[:-1])
    side = np.where((area > 0.0) == contours.hole, -1.0, 1.0)
    side = np.repeat(side, count)
    margin = 2.0 * contours.step_px
    keep = (
        plane.inside(contours.u, contours.v, margin)
        & plane.inside(contours.u[ahead], contours.v[ahead], margin)
        & plane.inside(contours.u[behind], contours.v[behind], margin)
        & (norm > 0.0)
        & np.isfinite(norm)
        & (length >= 16)
    )
    chosen = np.flatnonzero(keep)
    if len(chosen) < 24:
        return None
    if len(chosen) > max_points:
        chosen = chosen[np.linspace(0, len(chosen) - 1, max_points).astype(np.intp)]
    with np.errstate(invalid="ignore"):
        normal = np.stack((ty, -tx), axis=1)[chosen] * (side[chosen] / norm[chosen])[:, None]
    p = np.stack((qx, qy), axis=1)[chosen]
    unit = contours.step_px * plane.units_per_pixel(p[:, 0], p[:, 1])
    return p, normal, unit


def _common_centre(
    p: Array, normal: Array, unit: Array, rng: np.random.Generator, n_pairs: int
) -> tuple[Array, NDArray[np.bool_]] | None:
    n = len(p)
    i = rng.integers(0, n, n_pairs)
    # Half of the partners are near on the list, and so mostly on the same contour.
    near = (i + rng.integers(8, max(9, n // 6), n_pairs)) % n
    j = np.where(np.arange(n_pairs) % 2 == 0, near, rng.integers(0, n, n_pairs))
    cross = normal[i, 0] * normal[j, 1] - normal[i, 1] * normal[j, 0]
    good = np.abs(cross) > 0.35
    i, j, cross = i[good], j[good], cross[good]
    if not len(i):
        return None
    d = p[j] - p[i]
    t = (d[:, 0] * normal[j, 1] - d[:, 1] * normal[j, 0]) / cross
    centre = p[i] + t[:, None] * normal[i]
    sub = np.arange(0, n, max(1, n // 300))
    best = _votes(centre, p[sub], normal[sub], unit[sub]).sum(axis=1).argmax()
    c = centre[best]
    votes = _votes(c[None], p, normal, unit)[0]
    for _ in range(4):
        if votes.sum() < 16:
            return None
        nx, ny = normal[votes, 0], normal[votes, 1]
        rho = np.hypot(*(p[votes] - c).T)
        w = 1.0 / (rho + 2.0 * unit[votes]) ** 2
        # The line through each point along its normal passes through c: (-n_y, n_x) . c = (-n_y, n_x) . p
        a = np.stack((-ny, nx), axis=1)
        b = (a * p[votes]).sum(axis=1)
        normal_matrix = (a * w[:, None]).T @ a
        if np.linalg.cond(normal_matrix) > 1e4:
            return None
        c = np.linalg.solve(normal_matrix, (a * w[:, None]).T @ b)
        votes = _votes(c[None], p, normal, unit)[0]
    return c, votes


def _votes(centre: Array, p: Array, normal: Array, unit: Array) -> NDArray[np.bool_]:
    """Return which points' normals pass through which centres, shape (centres, points)."""
    dx = p[None, :, 0] - centre[:, 0, None]
    dy = p[None, :, 1] - centre[:, 1, None]
    miss = np.abs(dx * normal[None, :, 1] - dy * normal[None, :, 0])
    hit: NDArray[np.bool_] = miss < 0.12 * np.hypot(dx, dy) + 0.4 * unit[None, :]
    return hit


def _scales(
    p: Array, normal: Array, unit: Array, centre: Array, plane: LevelPlane, edges_m: Array, limit: int
) -> list[Hypothesis]:
    d = p - centre
    rho = np.hypot(d[:, 0], d[:, 1])
    side = np.sign((d * normal).sum(axis=1))
    rho = rho + side * CONTOUR_INSET_PX * unit
    # A straight piece of boundary can pass the vote; what lies within a pixel of the centre says nothing.
    use = rho > 1.5 * unit
    if use.sum() < 16:
        return []
    rho, side, unit, d = rho[use], side[use], unit[use], d[use]
    edge_side = np.where(np.arange(len(edges_m)) % 2 == 0, 1.0, -1.0)
    high, low = float(np.quantile(rho, 0.97)), float(np.quantile(rho, 0.05))
    kappas = np.geomspace(0.7 * high / edges_m[0], 1.15 * max(high / edges_m[-1], low / edges_m[-1]), 160)
    tolerance = 0.02 * rho + 0.5 * unit
    score = np.zeros(len(kappas))
    for sign in (1.0, -1.0):
        mine = side == sign
        radii = kappas[:, None] * edges_m[None, edge_side == sign]
        if not mine.any() or not radii.size:
            continue
        error = np.abs(radii[:, :, None] - rho[None, None, mine]).min(axis=1) / tolerance[mine]
        score += np.exp(-0.5 * error * error).sum(axis=1)
    visible = _visible_length(plane, centre, kappas, edges_m, float(np.median(unit)))
    share = score * float(np.median(unit)) / np.maximum(visible, 6.0 * float(np.median(unit)))
    rank = np.minimum(share, 1.0) * score / len(rho)
    peaks = np.flatnonzero((rank >= np.roll(rank, 1)) & (rank > np.roll(rank, -1)) & (rank > 0.02))
    hypotheses = []
    for k in peaks[np.argsort(-rank[peaks])][:limit]:
        kappa, place = float(kappas[k]), centre
        edges: tuple[int, ...] = ()
        for _ in range(2):
            d2 = p[use] - place
            r = np.hypot(d2[:, 0], d2[:, 1]) + side * CONTOUR_INSET_PX * unit
            gap = np.abs(r[:, None] - kappa * edges_m[None, :])
            gap = np.where(side[:, None] == edge_side[None, :], gap, np.inf)
            label = gap.argmin(axis=1)
            near = gap[np.arange(len(r)), label] < 0.04 * r + 1.0 * unit
            if near.sum() < 12:
                break
            a = np.stack((d2[near, 0] / r[near], d2[near, 1] / r[near], edges_m[label[near]]), axis=1)
            moved = np.linalg.lstsq(a, r[near] - kappa * edges_m[label[near]], rcond=None)[0]
            place, kappa = place + moved[:2], kappa + float(moved[2])
            edges = tuple(sorted({int(i) for i in label[near]}))
        if kappa > 0.0 and len(edges) >= 2:
            hypotheses.append(Hypothesis(place, kappa, edges, float(rank[k])))
    return hypotheses


def _visible_length(plane: LevelPlane, centre: Array, kappas: Array, edges_m: Array, unit: float) -> Array:
    """Return the length of the target's edges inside the image [plane units] for each scale."""
    angle = np.arange(16) * (np.pi / 8.0)
    radius = kappas[:, None, None] * edges_m[None, :, None]
    u, v = plane.to_pixels(centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle))
    inside = plane.inside(u, v, 3.0).mean(axis=2) * (radius[:, :, 0] > 1.5 * unit)
    length: Array = (2.0 * np.pi * radius[:, :, 0] * inside).sum(axis=1)
    return length

"""The photometric fit of the target's edges, and its covariance.

Nothing is interpolated: integer pixels are compared, through their exact rays, with the model

    I = a + b * sum_k s_k * Phi((rho - rho_k) / sigma)      rho_k = kappa r_k - sigma^2 / (2 kappa r_k) +
    s_k g

where rho is the pixel's distance from the centre in the level plane, s_k = +1 for the outside of red and -1
for the edge of a hole, sigma the blur, and g the *growth* of red: whatever moves both edges of a ring apart
(white that clips, gamma, ink that bleeds) moves them by the same pixels, so that it is estimated instead of
biasing the scale. sigma^2 / (2 R) is the inward shift of a blurred edge of radius R.

``fit_profiles`` does this on lines of pixels across single edges. Every line has its own a and b (light,
shadow and glare need no model) and yields the edge's displacement; the displacements give the geometry by
weighted least squares, and their scatter about it, not the pixel noise, gives the covariance. ``fit_area``
does it on all pixels of a target so small that its edges run into each other.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.plane import LevelPlane, rotation_xy

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

SAMPLES = 9
"""Pixels on a line across an edge."""
MIN_GAP_PX = 3.5
"""Edges closer than this to their neighbour are left out of the line fit."""
MIN_RADIUS_PX = 3.5
GROWTH_SIGMA_PX = 0.3
"""Prior 1-sigma of the growth of red."""
_SQRT_2_OVER_PI = 0.7978845608028654
INV_SQRT_2PI = 0.3989422804014327


@dataclass(frozen=True, slots=True)
class Fit:
    """The result of a photometric fit.

    ``plane`` is the plane that was fitted, tilted where the tilt was free; ``centre`` (2,), ``kappa`` [1/m];
    ``tilt`` (2,) rotation vector about the level x and y axes [rad]; ``information_inverse`` the covariance
    of (centre x, y, kappa, tilt x, y), shape (5, 5), zero rows for a fixed tilt; ``considered`` (5, 3) the
    change of those per relative error of the focal length and per pixel of the principal point;
    ``residual_px`` the root-mean-square displacement of the edges; ``share`` of the visible edge length
    that agrees with the model; ``edges`` that were seen, of ``n_visible`` that should be; ``chi2`` the mean
    weighted square of the displacements (of an area fit: how many times worse a plain disc fits);
    ``points_px`` (n, 2) what was compared, and whether it ``agrees``. ``red_slope`` is the change of R per
    change of (G + B) / 2: about zero or positive between red and white, about -1 between red and blue.
    ``contradicted`` is the share of the places where an edge should be and plain white is, or (of an area
    fit) what disagrees evenly all round.
    """

    plane: LevelPlane
    centre: Array
    kappa: float
    tilt: Array
    covariance: Array
    considered: Array
    residual_px: float
    share: float
    edges: tuple[int, ...]
    blur_px: float
    growth_px: float
    chi2: float
    count: int
    n_visible: int
    tilt_free: bool
    points_px: Array
    agrees: NDArray[np.bool_]
    red_slope: float
    contradicted: float
    is_area: bool = False


@dataclass(frozen=True, slots=True)
class _Lines:
    """Lines of pixels across edges: rays ``x``, ``y``, rows ``v``, ``weight`` and ``value`` less its mean
    (p, m); the rest (p,)."""

    x: Array
    y: Array
    v: Array
    weight: Array
    total: Array
    value: Array
    level: Array
    red: Array
    edge: NDArray[np.intp]
    half_px: Array
    u0: Array
    v0: Array


def edge_sides(n_edges: int) -> Array:
    """Return +1 for the outside of red (even edges), -1 for the edge of a hole."""
    return np.where(np.arange(n_edges) % 2 == 0, 1.0, -1.0)


def edge_gaps(edges_m: Array) -> Array:
    """Return the distance of each edge to its nearest neighbour (or, for the innermost, to the centre)
    [m]."""
    steps = -np.diff(edges_m)
    return np.minimum(np.concatenate(([np.inf], steps)), np.concatenate((steps, [2.0 * edges_m[-1]])))


def usable_edges(edges_m: Array, to_px: float) -> NDArray[np.bool_]:
    """Return which edges can be measured one by one, at ``to_px`` pixels per metre."""
    steps = -np.diff(edges_m) * to_px
    outside = np.concatenate(([np.inf], steps))
    inside = np.concatenate((steps, [2.0 * edges_m[-1] * to_px]))
    near, far = np.minimum(outside, inside), np.maximum(outside, inside)
    apart: NDArray[np.bool_] = (near > MIN_GAP_PX) | ((near > 0.7 * MIN_GAP_PX) & (far > 1.4 * MIN_GAP_PX))
    return apart & (edges_m * to_px > MIN_RADIUS_PX)


def phi(t: Array) -> Array:
    """Return the normal distribution function, to 3e-4 (Page's formula with tanh)."""
    return 0.5 + 0.5 * np.tanh(_SQRT_2_OVER_PI * t * (1.0 + 0.044715 * t * t))


def _median(values: Array) -> float:
    """Return the upper median: ``numpy.median`` takes five times as long on a hundred values."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def sample_lines(
    image: Image, plane: LevelPlane, centre: Array, kappa: float, edges_m: Array, widen: float, n_lines: int
) -> _Lines | None:
    """Lay lines of pixels across the edges that lie inside the image; None where there are too few."""
    to_px = kappa / float(plane.units_per_pixel(centre[0], centre[1]))
    radius_px = to_px * edges_m
    usable = np.flatnonzero(usable_edges(edges_m, to_px))
    if not len(usable):
        return None
    want = np.clip(2.5 * radius_px[usable], 10.0, 30.0)
    want *= min(1.0, n_lines / want.sum())
    lines = None
    for _ in range(2):
        lines = _place(plane, centre, kappa, edges_m, usable, np.maximum(want, 6).astype(np.intp))
        seen = len(lines[0]) / want.sum()
        if seen > 0.6 or seen == 0.0:
            break
        want = want / max(seen, 0.15)
    assert lines is not None
    edge, u0, v0, du, dv, gap = lines
    if len(edge) < 12:
        return None
    half = np.clip(0.6 * gap, 2.6, widen)
    offset = np.linspace(-1.0, 1.0, SAMPLES)[None, :] * half[:, None]
    u = np.rint(u0[:, None] + offset * du[:, None]).astype(np.intp)
    v = np.rint(v0[:, None] + offset * dv[:, None]).astype(np.intp)
    weight = np.ones(u.shape)
    # The same pixel twice on a line says nothing new; pixels outside the image say nothing.
    weight[:, 1:][(u[:, 1:] == u[:, :-1]) & (v[:, 1:] == v[:, :-1])] = 0.0
    w, h = plane.camera.width - 1, plane.camera.height - 1
    uc, vc = np.clip(u, 0, w), np.clip(v, 0, h)
    weight[(uc != u) | (vc != v)] = 0.0
    pixels = image[vc, uc].astype(np.float64)
    value = 0.5 * (pixels[..., 0] + pixels[..., 1])
    total = np.maximum(weight.sum(axis=1), 1.0)
    level = (value * weight).sum(axis=1) / total
    value -= level[:, None]
    rows = vc.astype(np.float64)
    x, y = plane.rays(uc.astype(np.float64), rows)
    return _Lines(x, y, rows, weight, total, value, level, pixels[..., 2], edge, half, u0, v0)


def _place(
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges_m: Array,
    usable: NDArray[np.intp],
    count: NDArray[np.intp],
) -> tuple[NDArray[np.intp], Array, Array, Array, Array, Array]:
    edge = np.repeat(usable, count)
    first = np.repeat(np.cumsum(count) - count, count)
    angle = (np.arange(len(edge)) - first + 0.37 * edge) * (2.0 * np.pi / np.repeat(count, count))
    r = kappa * edges_m[edge]
    step = 0.002 * kappa * edges_m[0]
    x, y = np.cos(angle), np.sin(angle)
    rr = np.stack((r, r + step))
    u, v = plane.to_pixels(centre[0] + rr * x, centre[1] + rr * y)
    du, dv = u[1] - u[0], v[1] - v[0]
    length = np.hypot(du, dv)
    inside = plane.inside(u[0], v[0], 1.5)
    gap = edge_gaps(edges_m)[edge] * kappa * length / step
    du, dv = du / length, dv / length
    if inside.all():
        return edge, u[0], v[0], du, dv, gap
    return edge[inside], u[0][inside], v[0][inside], du[inside], dv[inside], gap[inside]


def fit_profiles(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges_m: Array,
    *,
    tilt_sigma_rad: float = 0.0,
    tilt: Array | None = None,
    n_lines: int = 84,
    iterations: int = 5,
    start_blur_px: float = 0.7,
) -> Fit | None:
    """Fit centre, scale, blur and growth (and the plane's tilt, with a prior of ``tilt_sigma_rad``, if not
    zero).

    ``image`` BGR; ``centre`` (2,), ``kappa`` [1/m] the start, good to about 1.5 px at the edges. None where
    too few edges are in view or the fit leaves the start.
    """
    lines = sample_lines(image, plane, centre, kappa, edges_m, 4.0, n_lines)
    if lines is None:
        return None
    sides = edge_sides(len(edges_m))
    start_tilt = np.zeros(2) if tilt is None else tilt
    state = _State(plane, np.array(centre), float(kappa), start_tilt, start_blur_px, 0.0)
    resampled = False
    solved: _Solved | None = None
    for i in range(iterations):
        solved = _step(state, lines, edges_m, sides, tilt_sigma_rad, free_blur=i < iterations - 1)
        if solved is None:
            return None
        done = solved.moved_px < 0.01 and i >= 1
        wide = state.blur_px > 1.25 and lines.half_px.max() < 3.2 * state.blur_px
        if not resampled and i < iterations - 2 and (wide or solved.moved_px > 1.0):
            again = sample_lines(
                image, state.plane, state.centre, state.kappa, edges_m, max(4.0, 3.2 * state.blur_px), n_lines
            )
            if again is None:
                return None
            lines, resampled, done = again, True, False
        if done:
            break
    assert solved is not None
    return _result(state, solved, lines, edges_m)


@dataclass(slots=True)
class _State:
    plane: LevelPlane
    centre: Array
    kappa: float
    tilt: Array
    blur_px: float
    growth_px: float


@dataclass(slots=True)
class _Solved:
    inverse: Array
    design: Array
    considered: Array
    weight: Array
    residual: Array
    inlier: NDArray[np.bool_]
    moved_px: float
    free: list[int]
    chi2_reduced: float
    contrast: float


def _step(
    state: _State, lines: _Lines, edges_m: Array, sides: Array, tilt_sigma_rad: float, free_blur: bool
) -> _Solved | None:
    plane, blur = state.plane, state.blur_px
    k = lines.edge
    s = sides[k]
    x, y = lines.x, lines.y
    qx, qy = plane.from_rays(x, y, lines.v)
    ex, ey = qx - state.centre[0], qy - state.centre[1]
    rho = np.sqrt(ex * ex + ey * ey)
    # Gradient of rho in the image, at the middle of each line.
    mid = SAMPLES // 2
    r0 = rho[:, mid]
    nx, ny = ex[:, mid] / r0, ey[:, mid] / r0
    xm, ym, qxm, qym = x[:, mid], y[:, mid], qx[:, mid], qy[:, mid]
    r = plane.rotation
    depth = r[2, 0] * xm + r[2, 1] * ym + r[2, 2]
    tangent = nx * qxm + ny * qym
    gx = (nx * r[0, 0] + ny * r[1, 0] - tangent * r[2, 0]) / depth
    gy = (nx * r[0, 1] + ny * r[1, 1] - tangent * r[2, 1]) / depth
    slope = np.hypot(gx / plane.camera.fx, gy / plane.camera.fy)  # plane units per pixel along the normal
    unit = slope * blur
    rk = state.kappa * edges_m[k]
    target = rk - unit * unit / (2.0 * rk) + s * (state.growth_px * slope)
    t = (rho - target[:, None]) / unit[:, None]
    gap = edge_gaps(edges_m)
    near = bool((gap[k] * state.kappa / slope - lines.half_px < 3.0 * blur).any())
    bell = np.exp(-0.5 * t * t)
    step_ = phi(t)
    slope_ = bell
    spread = t * bell
    if near:
        for side in (-1, 1):
            j = k + side
            has = (j >= 0) & (j < len(edges_m))
            rj = state.kappa * edges_m[np.clip(j, 0, len(edges_m) - 1)]
            tj = (rho - (rj - unit * unit / (2.0 * rj) - s * state.growth_px * slope)[:, None]) / unit[
                :, None
            ]
            tj = np.where(has[:, None], tj, 9.0 * side)
            bj = np.exp(-0.5 * tj * tj)
            step_ = step_ - phi(tj)
            slope_ = slope_ - bj * (rj / rk)[:, None]
            spread = spread - tj * bj
    w = lines.weight
    basis = np.empty((len(k), 4, SAMPLES))
    np.multiply(s[:, None], step_, out=basis[:, 0])
    np.multiply((-INV_SQRT_2PI / blur) * s[:, None], slope_, out=basis[:, 1])
    np.multiply(-INV_SQRT_2PI * s[:, None], spread, out=basis[:, 2])
    basis[:, 3] = lines.value
    total = lines.total
    weighted = basis * w[:, None, :]
    # Sums of products about the means of each line: its level is eliminated.
    sums = weighted.sum(axis=2)
    gram = weighted @ basis.transpose(0, 2, 1)
    gram -= (sums / total[:, None])[:, :, None] * sums[:, None, :]
    power = gram[:, 3, 3]
    if free_blur:
        solution, inverse_11 = _solve3(gram)
    else:
        solution, inverse_11 = _solve2(gram)
    contrast = solution[:, 0]
    rest = power - (solution * gram[:, :3, 3]).sum(axis=1)
    dof = np.maximum(total - (4.0 if free_blur else 3.0), 1.0)
    variance = np.maximum(rest, 0.0) / dof
    middle = _median(contrast)
    if not middle > 4.0:
        return None
    noise = max(_median(variance), 0.08)
    with np.errstate(all="ignore"):
        delta = solution[:, 1] / contrast
        sigma2 = np.maximum(variance, noise) * inverse_11 / (contrast * contrast)
        valid = (contrast > max(4.0, 0.3 * middle)) & (rest < np.maximum(0.15 * power, 8.0 * noise * dof))
        valid &= np.isfinite(delta) & (np.abs(delta) < lines.half_px) & (sigma2 < 1.0) & (total >= 5.0)
    if valid.sum() < 10:
        return None
    delta = np.where(valid, delta, 0.0)
    sigma2 = np.where(valid, sigma2, 1.0)
    # Rows: change of the displacement [px] with centre x, y, kappa, tilt x, y, growth.
    design = np.empty((len(k), 6))
    design[:, 0] = nx / slope
    design[:, 1] = ny / slope
    design[:, 2] = edges_m[k] / slope
    design[:, 3] = (nx * qxm * qym + ny * (1.0 + qym * qym)) / slope
    design[:, 4] = -(nx * (1.0 + qxm * qxm) + ny * qxm * qym) / slope
    design[:, 5] = s
    considered = np.empty((len(k), 3))
    considered[:, 0] = (gx * xm + gy * ym) / slope
    considered[:, 1] = gx / plane.camera.fx / slope
    considered[:, 2] = gy / plane.camera.fy / slope
    free = [0, 1, 2, 5] if tilt_sigma_rad == 0.0 else [0, 1, 2, 3, 4, 5]
    prior = np.zeros((6, 6))
    offset = np.zeros(6)
    prior[5, 5] = 1.0 / GROWTH_SIGMA_PX**2
    offset[5] = -state.growth_px
    if tilt_sigma_rad > 0.0:
        prior[3, 3] = prior[4, 4] = 1.0 / tilt_sigma_rad**2
        offset[3:5] = -state.tilt
    a = design[:, free]
    prior_free = prior[np.ix_(free, free)]
    pull = prior_free @ offset[free]
    weight = valid / (sigma2 + 1e-4)
    change = np.zeros(len(free))
    residual = delta
    for pass_ in range(3):
        aw = a * weight[:, None]
        try:
            inverse = np.linalg.inv(aw.T @ a + prior_free)
        except np.linalg.LinAlgError:
            return None
        change = inverse @ (aw.T @ delta + pull)
        residual = delta - a @ change
        size = np.abs(residual)
        scale = max(1.4826 * _median(size[valid]), 0.01)
        if pass_ == 2:
            break
        # Lines that disagree lose their weight altogether: they lie on something else.
        huber = np.minimum(1.0, 2.0 * scale / np.maximum(size, 1e-12))
        huber[size > max(5.0 * scale, 0.1)] = 0.0
        weight = valid * huber / (sigma2 + 1e-4)
    inlier = valid & (size < max(5.0 * scale, 0.25))
    used = weight > 0.0
    n = int(used.sum())
    if n < 10:
        return None
    chi2 = float((weight[used] * residual[used] ** 2).sum()) / max(n - len(free), 1)
    full = np.zeros(6)
    full[free] = change
    state.centre = state.centre + full[:2]
    state.kappa += full[2]
    state.growth_px += full[5]
    if tilt_sigma_rad > 0.0:
        state.tilt = state.tilt + full[3:5]
        state.plane = plane.tilted(rotation_xy(full[3], full[4]))
    if free_blur:
        with np.errstate(all="ignore"):
            ratio = _median((solution[:, 2] / contrast)[used])
        if np.isfinite(ratio):
            state.blur_px = float(np.clip(blur * np.exp(np.clip(ratio, -0.5, 0.5)), 0.3, 6.0))
    if not (state.kappa > 0.0 and np.isfinite(state.centre).all()):
        return None
    moved = float(np.abs(a @ change).max())
    return _Solved(inverse, design, considered, weight, residual, inlier, moved, free, chi2, middle)


def _solve3(gram: Array) -> tuple[Array, Array]:
    """Solve the 3x3 systems ``gram[:, :3, :3] x = gram[:, :3, 3]``; also return element (1, 1) of the
    inverse."""
    a, b, c = gram[:, 0, 0], gram[:, 0, 1], gram[:, 0, 2]
    d, e, f = gram[:, 1, 1], gram[:, 1, 2], gram[:, 2, 2] * 1.05 + 1e-12
    c00, c01, c02 = d * f - e * e, c * e - b * f, b * e - c * d
    c11, c12, c22 = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * c00 + b * c01 + c * c02
    determinant = np.where(determinant > 1e-12 * a * d * f, determinant, np.inf)
    h0, h1, h2 = gram[:, 0, 3], gram[:, 1, 3], gram[:, 2, 3]
    x = np.stack(
        (c00 * h0 + c01 * h1 + c02 * h2, c01 * h0 + c11 * h1 + c12 * h2, c02 * h0 + c12 * h1 + c22 * h2)
    )
    return (x / determinant).T, c11 / determinant


def _solve2(gram: Array) -> tuple[Array, Array]:
    """Solve the 2x2 systems without the blur; the third element of the solution is zero."""
    a, b, d = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    determinant = a * d - b * b
    determinant = np.where(determinant > 1e-12 * a * d, determinant, np.inf)
    h0, h1 = gram[:, 0, 3], gram[:, 1, 3]
    x = np.stack((d * h0 - b * h1, a * h1 - b * h0, np.zeros_like(a)))
    return (x / determinant).T, a / determinant


def _result(state: _State, solved: _Solved, lines: _Lines, edges_m: Array) -> Fit:
    free = solved.free
    a = solved.design[:, free]
    weight = solved.weight
    aw = a * weight[:, None]
    # Scatter of the displacements about the model scales the covariance, up and down.
    covariance_free = solved.inverse * solved.chi2_reduced
    gain = -solved.inverse @ (aw.T @ solved.considered)
    rows = [i for i in free if i < 5]
    keep = [n for n, i in enumerate(free) if i < 5]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(rows, rows)] = covariance_free[np.ix_(keep, keep)]
    considered = np.zeros((5, 3))
    considered[rows] = gain[keep]
    inlier = solved.inlier
    laid = np.bincount(lines.edge, minlength=len(edges_m))
    agreeing = np.bincount(lines.edge, weights=inlier, minlength=len(edges_m))
    seen = np.flatnonzero(agreeing > 0.4 * laid)
    inner = inlier & (lines.edge > 0)
    wv = (lines.weight * lines.value)[inner]
    slope = float((wv * lines.red[inner]).sum() / max(float((wv * lines.value[inner]).sum()), 1e-9))
    contradicted = 0.0
    if not inlier.all() and inlier.any():
        white = _median(lines.level[inlier]) + 0.5 * solved.contrast
        flat = np.abs(lines.value).max(axis=1) < 0.2 * solved.contrast
        plain = flat & (np.abs(lines.level - white) < 0.15 * solved.contrast) & (lines.level < 248.0)
        contradicted = float((plain & ~inlier).mean())
    rms = float(np.sqrt(np.mean(solved.residual[inlier] ** 2))) if inlier.any() else float("inf")
    return Fit(
        state.plane,
        state.centre,
        state.kappa,
        state.tilt,
        covariance,
        considered,
        rms,
        float(inlier.mean()),
        tuple(seen.tolist()),
        state.blur_px,
        state.growth_px,
        solved.chi2_reduced,
        int(inlier.sum()),
        int((laid > 0).sum()),
        3 in free,
        np.stack((lines.u0, lines.v0), axis=1),
        inlier,
        slope,
        contradicted,
    )

"""The photometric fit of a target so small that its edges run into each other.

All pixels of the target are compared with the sum of its blurred edges (``vision.refine`` has the model); light and
its gradient, and the brightness of what surrounds the outermost edge, are eliminated linearly. Several scales are
tried, because a blob says little about which of its edges it shows, and a plain disc of the same size must fit
clearly worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.plane import LevelPlane, rotation_xy
from vision.refine import _INV_SQRT_2PI, Fit, brightness, edge_sides, phi

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

GROWTH_SIGMA_PX = 0.15
BLUR_LOG_SIGMA = 0.5
START_BLUR_PX = 0.62


@dataclass(slots=True)
class _Patch:
    """Pixels around the target: ``u``, ``v``, rays, brightness, all (n,)."""

    u: NDArray[np.intp]
    v: NDArray[np.intp]
    x: Array
    y: Array
    value: Array


def _patch(image: Image, plane: LevelPlane, centre: Array, radius: float, border_px: float) -> _Patch | None:
    angle = np.arange(12) * (np.pi / 6.0)
    u, v = plane.to_pixels(centre[0] + radius * np.cos(angle), centre[1] + radius * np.sin(angle))
    if not (np.isfinite(u).all() and np.isfinite(v).all()):
        return None
    w, h = plane.camera.width - 1, plane.camera.height - 1
    u0, u1 = int(max(0.0, u.min() - border_px)), int(min(w, u.max() + border_px + 1))
    v0, v1 = int(max(0.0, v.min() - border_px)), int(min(h, v.max() + border_px + 1))
    if u1 - u0 < 4 or v1 - v0 < 4 or (u1 - u0) * (v1 - v0) > 20000:
        return None
    vv, uu = np.mgrid[v0 : v1 + 1, u0 : u1 + 1]
    uu, vv = uu.ravel(), vv.ravel()
    x, y = plane.rays(uu, vv)
    return _Patch(uu, vv, x, y, brightness(image, uu, vv))


def fit_area(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges_m: Array,
    *,
    margin_m: float,
    tilt_sigma_rad: float = 0.0,
    scales: tuple[float, ...] = (0.86, 0.9, 0.95, 1.0, 1.05, 1.1, 1.16),
) -> Fit | None:
    """Fit the whole target at once; parameters and result as in ``fit_profiles``.

    ``margin_m`` is the width of white around the outermost edge [m].
    """
    unit = float(plane.units_per_pixel(centre[0], centre[1]))
    patch = _patch(image, plane, centre, kappa * edges_m[0] * max(scales), 4.0)
    if patch is None:
        return None
    fits = []
    starts = []
    for scale in scales:
        state = _State(plane, np.array(centre), kappa * scale, np.zeros(2), START_BLUR_PX, 0.0)
        equations = _equations(state, patch, edges_m, margin_m, unit, 0.0)
        if equations is not None:
            starts.append((equations.mean_square, kappa * scale))
    starts.sort()
    for _, start in starts[:2]:
        state = _State(plane, np.array(centre), start, np.zeros(2), START_BLUR_PX, 0.0)
        solved = _descend(state, patch, edges_m, margin_m, unit, tilt_sigma_rad)
        if solved is not None:
            fits.append((solved.mean_square, len(fits), state, solved))
    if not fits:
        return None
    _, _, state, solved = min(fits)
    disc = _State(plane, state.centre.copy(), state.kappa, np.zeros(2), state.blur_px, 0.0)
    plain = _descend(disc, patch, edges_m[:1], margin_m, unit, 0.0)
    gain = np.inf if plain is None else plain.mean_square / solved.mean_square
    return _result(state, solved, gain, edges_m, patch)


@dataclass(slots=True)
class _State:
    plane: LevelPlane
    centre: Array
    kappa: float
    tilt: Array
    blur_px: float
    growth_px: float


@dataclass(slots=True)
class _Equations:
    inverse: Array
    change: Array
    free: list[int]
    residual: Array
    weight: Array
    mean_square: float
    contrast: float
    outer_contrast: float
    rows: Array
    considered: Array
    used: NDArray[np.bool_]


N_LINEAR = 7


def _equations(
    state: _State, patch: _Patch, edges_m: Array, margin_m: float, unit: float, tilt_sigma_rad: float
) -> _Equations | None:
    plane, kappa, blur = state.plane, state.kappa, state.blur_px
    reach = kappa * edges_m[0] + min(3.0 * unit, max(kappa * margin_m - 1.2 * unit, 0.8 * unit))
    qx, qy = plane.from_rays(patch.x, patch.y, patch.v)
    ex, ey = qx - state.centre[0], qy - state.centre[1]
    rho = np.sqrt(ex * ex + ey * ey)
    used = rho < reach
    if used.sum() < 24:
        return None
    x, y, qx, qy, ex, ey, rho = (a[used] for a in (patch.x, patch.y, qx, qy, ex, ey, rho))
    value = patch.value[used]
    rho = np.maximum(rho, 1e-3 * unit)
    nx, ny = ex / rho, ey / rho
    r = plane.rotation
    depth = r[2, 0] * x + r[2, 1] * y + r[2, 2]
    tangent = nx * qx + ny * qy
    gx = (nx * r[0, 0] + ny * r[1, 0] - tangent * r[2, 0]) / depth
    gy = (nx * r[0, 1] + ny * r[1, 1] - tangent * r[2, 1]) / depth
    slope = np.hypot(gx / plane.camera.fx, gy / plane.camera.fy)
    width = slope * blur
    sides = edge_sides(len(edges_m))
    rk = kappa * edges_m
    bend = np.minimum((width * width)[:, None] / (2.0 * rk), 0.5 * rk)
    t = (rho[:, None] - rk + bend - sides * (state.growth_px * slope)[:, None]) / width[:, None]
    cdf = phi(t) * sides
    bell = np.exp(-0.5 * t * t) * (_INV_SQRT_2PI * sides)
    linear = np.empty((len(rho), N_LINEAR))
    linear[:, 0] = 1.0
    linear[:, 1] = cdf[:, 0]
    linear[:, 2] = cdf[:, 1:].sum(axis=1)
    span = kappa * edges_m[0]
    both = linear[:, 1] + linear[:, 2]
    linear[:, 3], linear[:, 4] = ex / span, ey / span
    linear[:, 5], linear[:, 6] = ex / span * both, ey / span * both
    n_lin = N_LINEAR
    if len(edges_m) == 1:
        linear[:, 2] = 0.0
    ridge = np.full(n_lin, 1e-9)
    ridge[3:] = 1e-2
    # Linear part first, robustly, to have contrasts for the derivatives.
    weight = np.ones(len(rho))
    coefficients = np.zeros(n_lin)
    for _ in range(3):
        lw = linear * weight[:, None]
        coefficients = np.linalg.solve(lw.T @ linear + np.diag(ridge), lw.T @ value)
        rest = value - linear @ coefficients
        scale = max(1.4826 * float(np.median(np.abs(rest))), 0.5)
        weight = np.minimum(1.0, 2.5 * scale / np.maximum(np.abs(rest), 1e-9))
    outer, inner = coefficients[1], coefficients[2]
    if not (outer > 3.0 and (inner > 3.0 or len(edges_m) == 1)):
        return None
    gain = np.full(len(edges_m), inner)
    gain[0] = outer
    pull = bell * gain / width[:, None]  # d I / d rho of each edge
    steep = pull.sum(axis=1)
    columns = np.empty((len(rho), 7))
    columns[:, 0] = -steep * nx
    columns[:, 1] = -steep * ny
    columns[:, 2] = -(pull * edges_m).sum(axis=1)
    columns[:, 3] = -steep * (nx * qx * qy + ny * (1.0 + qy * qy))
    columns[:, 4] = steep * (nx * (1.0 + qx * qx) + ny * qx * qy)
    columns[:, 5] = -(pull * sides).sum(axis=1) * slope
    columns[:, 6] = -(pull * (t * width[:, None] - 2.0 * bend)).sum(axis=1)
    considered = np.empty((len(rho), 3))
    considered[:, 0] = -steep * (gx * x + gy * y)
    considered[:, 1] = -steep * gx / plane.camera.fx
    considered[:, 2] = -steep * gy / plane.camera.fy
    free = [0, 1, 2, 5, 6] if tilt_sigma_rad == 0.0 else [0, 1, 2, 3, 4, 5, 6]
    rows = np.concatenate((columns[:, free], linear), axis=1)
    dof = max(float(weight.sum()) - rows.shape[1], 1.0)
    variance = max(float((weight * rest * rest).sum()) / dof, 0.08)
    prior = np.zeros(rows.shape[1])
    centre_of_prior = np.zeros(rows.shape[1])
    at = {i: n for n, i in enumerate(free)}
    prior[at[5]] = variance / GROWTH_SIGMA_PX**2
    centre_of_prior[at[5]] = -state.growth_px
    prior[at[6]] = variance / BLUR_LOG_SIGMA**2
    centre_of_prior[at[6]] = -np.log(blur / START_BLUR_PX)
    if tilt_sigma_rad > 0.0:
        for i in (3, 4):
            prior[at[i]] = variance / tilt_sigma_rad**2
            centre_of_prior[at[i]] = -state.tilt[i - 3]
    prior[len(free) :] = ridge
    rw = rows * weight[:, None]
    try:
        inverse = np.linalg.inv(rw.T @ rows + np.diag(prior))
    except np.linalg.LinAlgError:
        return None
    change = inverse @ (rw.T @ rest + prior * centre_of_prior)
    return _Equations(
        inverse * variance,
        change[: len(free)],
        free,
        rest,
        weight,
        float((weight * rest * rest).sum() / weight.sum()),
        float(inner),
        float(outer),
        rows,
        considered,
        used,
    )


def _descend(
    state: _State, patch: _Patch, edges_m: Array, margin_m: float, unit: float, tilt_sigma_rad: float
) -> _Equations | None:
    equations = None
    for _ in range(15):
        equations = _equations(state, patch, edges_m, margin_m, unit, tilt_sigma_rad)
        if equations is None:
            return None
        full = np.zeros(7)
        full[equations.free] = equations.change
        size = max(
            float(np.hypot(full[0], full[1])) / unit,
            abs(full[2]) * edges_m[0] / unit,
            abs(full[5]),
            2.0 * abs(full[6]),
            float(np.hypot(full[3], full[4])) / 0.1,
        )
        full *= min(1.0, 0.5 / max(size, 1e-12))
        state.centre = state.centre + full[:2]
        state.kappa += full[2]
        state.growth_px += full[5]
        state.blur_px = float(np.clip(state.blur_px * np.exp(full[6]), 0.25, 4.0))
        if tilt_sigma_rad > 0.0:
            state.tilt = state.tilt + full[3:5]
            state.plane = state.plane.tilted(rotation_xy(full[3], full[4]))
        if not (state.kappa > 0.0 and np.isfinite(state.centre).all()):
            return None
        if size < 0.003:
            break
    return equations


def _result(state: _State, solved: _Equations, gain: float, edges_m: Array, patch: _Patch) -> Fit:
    free = solved.free
    at = [n for n, i in enumerate(free) if i < 5]
    rows = [i for i in free if i < 5]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(rows, rows)] = solved.inverse[np.ix_(at, at)]
    variance = solved.mean_square
    rw = solved.rows * solved.weight[:, None]
    shift = -(solved.inverse / max(variance, 1e-9)) @ (rw.T @ solved.considered)
    considered = np.zeros((5, 3))
    considered[rows] = shift[at]
    contrast = min(solved.contrast, solved.outer_contrast)
    agrees = np.abs(solved.residual) < max(3.5 * np.sqrt(variance), 0.12 * contrast)
    lines = np.stack((patch.u[solved.used], patch.v[solved.used]), axis=1).astype(np.float64)
    return Fit(
        state.plane,
        state.centre,
        state.kappa,
        state.tilt,
        covariance,
        considered,
        float(np.sqrt(variance)) / contrast,
        float(agrees.mean()),
        tuple(range(len(edges_m))),
        state.blur_px,
        state.growth_px,
        gain,
        int(agrees.sum()),
        len(edges_m),
        3 in free,
        lines,
        agrees,
        True,
    )

"""The photometric fit of a target so small that its edges run into each other.

All pixels of the target are compared with the sum of its blurred edges (``vision.refine`` has the model);
light and its gradient, and the brightness of what surrounds the outermost edge, are eliminated linearly.
Several scales are tried, because a blob says little about which of its edges it shows, and a plain disc of
the same size must fit clearly worse.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from vision.lines import edge_sides
from vision.plane import LevelPlane, rotation_xy
from vision.profile import edge_profile, gaussian_part, pixel_box
from vision.refine import Fit

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

GROWTH_SIGMA_PX = 0.12
BLUR_LOG_SIGMA = 0.3
START_BLUR_PX = 0.62
MAX_PIXELS = 1600
CLIPPED = 253.0
CLIPPED_ERROR_PX = 0.01
MAX_MISFIT = 0.2
"""Residual, as a share of the contrast, beyond which the rough fit is not refined."""


@dataclass(slots=True)
class _Patch:
    """Pixels around the target: ``u``, ``v``, rays, brightness, all (n,)."""

    u: NDArray[np.intp]
    v: NDArray[np.intp]
    x: Array
    y: Array
    value: Array
    red: Array
    clipped: bool

    def thinned(self, limit: int) -> _Patch:
        """Return at most about ``limit`` of the pixels, spread evenly."""
        step = -(-len(self.u) // limit)
        if step <= 1:
            return self
        # A step that shares no factor with the rows' length would leave stripes; a fixed shuffle does not.
        pick = np.sort(np.random.default_rng(len(self.u)).permutation(len(self.u))[: len(self.u) // step])
        return _Patch(
            self.u[pick],
            self.v[pick],
            self.x[pick],
            self.y[pick],
            self.value[pick],
            self.red[pick],
            self.clipped,
        )


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
    pixels = image[vv, uu].astype(np.float64)
    # What has clipped says only that it was brighter.
    open_ = pixels[:, :2].max(axis=1) < CLIPPED
    clipped = bool(0.3 < open_.mean() < 0.9)
    if clipped:
        uu, vv, x, y, pixels = uu[open_], vv[open_], x[open_], y[open_], pixels[open_]
    return _Patch(uu, vv, x, y, 0.5 * (pixels[:, 0] + pixels[:, 1]), pixels[:, 2], clipped)


@dataclass(slots=True)
class _State:
    plane: LevelPlane
    centre: Array
    kappa: float
    tilt: Array
    blur_px: float
    growth_px: float
    scale: float = np.inf
    """Residual beyond which a pixel loses its weight [brightness]; infinite at the start."""


@dataclass(slots=True)
class _Equations:
    inverse: Array
    change: Array
    free: list[int]
    residual: Array
    weight: Array
    mean_square: float
    contrast: float
    rows: Array
    considered: Array
    used: NDArray[np.bool_]


def fit_area(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges_m: Array,
    *,
    margin_m: float,
    tilt_sigma_rad: float = 0.0,
    sectors: int = 1,
    scales: tuple[float, ...] = (0.88, 0.94, 1.0, 1.06, 1.12),
) -> Fit | None:
    """Fit the whole target at once; parameters and result as in ``fit_profiles``.

    ``margin_m`` is the width of white around the outermost edge [m]. With ``sectors`` above one each sector
    has its own light, and pixels that disagree lose their weight: for shadows, glare and things in front of
    the target.
    """
    unit = float(plane.units_per_pixel(centre[0], centre[1]))
    patch = _patch(image, plane, centre, kappa * edges_m[0] * max(scales), 4.0)
    if patch is None:
        return None
    model = _Model(patch, edges_m, margin_m, unit, sectors, tilt_sigma_rad)
    coarse = _Model(patch.thinned(300), edges_m, margin_m, unit, 1, 0.0)
    starts = []
    for scale in scales:
        equations = coarse.equations(_State(plane, centre, kappa * scale, np.zeros(2), START_BLUR_PX, 0.0))
        if equations is not None:
            starts.append((equations.mean_square / equations.contrast**2, kappa * scale))
    if not starts:
        return None
    starts.sort()
    rough = _State(plane, centre, starts[0][1], np.zeros(2), START_BLUR_PX, 0.0)
    model = _Model(patch.thinned(300), edges_m, margin_m, unit, sectors, tilt_sigma_rad)
    solved = model.descend(rough, 8, 0.03)
    if solved is None or solved.mean_square > (MAX_MISFIT * solved.contrast) ** 2:
        return None
    state = _State(rough.plane, rough.centre, rough.kappa, rough.tilt, rough.blur_px, rough.growth_px)
    model = _Model(patch.thinned(MAX_PIXELS), edges_m, margin_m, unit, sectors, tilt_sigma_rad)
    solved = model.descend(state, 12, 0.002)
    if solved is None:
        return None
    # The same pixels with the same weights, explained by a disc.
    disc = _State(state.plane, state.centre, state.kappa, np.zeros(2), state.blur_px, 0.0)
    plain = _Model(
        model.patch, edges_m[:1], margin_m, unit, sectors, 0.0, solved.used, solved.weight
    ).descend(disc, 6, 0.03)
    gain = 1.0 if plain is None else plain.mean_square / solved.mean_square
    return _result(state, solved, gain, edges_m, model.patch)


@dataclass(slots=True)
class _Model:
    """The equations of one patch. ``fixed_pixels`` and ``fixed_weight`` replace the choice of pixels, if
    given."""

    patch: _Patch
    edges_m: Array
    margin_m: float
    unit: float
    sectors: int
    tilt_sigma_rad: float
    fixed_pixels: NDArray[np.bool_] | None = None
    fixed_weight: Array | None = None

    def equations(self, state: _State) -> _Equations | None:
        """Linearise at ``state``; None where the target's contrast is missing."""
        patch, edges_m = self.patch, self.edges_m
        plane, kappa, blur = state.plane, state.kappa, state.blur_px
        white_px = max(kappa * self.margin_m / self.unit - 1.2, 0.8)
        reach = kappa * edges_m[0] + min(3.0, white_px) * self.unit
        qx, qy = plane.from_rays(patch.x, patch.y, patch.v.astype(np.float64))
        ex, ey = qx - state.centre[0], qy - state.centre[1]
        rho = np.sqrt(ex * ex + ey * ey)
        used = rho < reach if self.fixed_pixels is None else self.fixed_pixels
        if used.sum() < 24:
            return None
        x, y, qx, qy, ex, ey, rho = (a[used] for a in (patch.x, patch.y, qx, qy, ex, ey, rho))
        value = patch.value[used]
        rho = np.maximum(rho, 1e-3 * self.unit)
        nx, ny = ex / rho, ey / rho
        r = plane.rotation
        depth = r[2, 0] * x + r[2, 1] * y + r[2, 2]
        tangent = nx * qx + ny * qy
        gx = (nx * r[0, 0] + ny * r[1, 0] - tangent * r[2, 0]) / depth
        gy = (nx * r[0, 1] + ny * r[1, 1] - tangent * r[2, 1]) / depth
        slope = np.maximum(np.hypot(gx / plane.camera.fx, gy / plane.camera.fy), 0.2 * self.unit)
        width = (slope * blur)[:, None]
        sides = edge_sides(len(edges_m))
        rk = kappa * edges_m
        bend = np.minimum(width * width / (2.0 * rk), 0.5 * rk)
        # Everything along the gradient, in pixels: distance, a pixel's width, and the blur without it.
        box = pixel_box(gx / plane.camera.fx / slope, gy / plane.camera.fy / slope)[:, None]
        sigma = gaussian_part(blur, box)
        away = (rho[:, None] - rk + bend) / slope[:, None] - sides * state.growth_px
        rise, steepness, wider = edge_profile(away, sigma, box)
        cdf = rise * sides
        bell = steepness * sides / slope[:, None]
        linear = self._light(ex / (kappa * edges_m[0]), ey / (kappa * edges_m[0]), cdf)
        n_lin = linear.shape[1]
        ridge = np.full(n_lin, 1e-3)
        coefficients, rest, weight, scale = self._solve_light(linear, value, ridge, state.scale)
        contrast_of_pixel, outer = self._contrasts(linear, cdf, coefficients)
        contrast = float(np.median(contrast_of_pixel))
        if not (contrast > 4.0 and contrast + outer > 3.0):
            return None
        # d I / d rho of each edge: the outermost one may border on something else than white.
        pull = bell * contrast_of_pixel[:, None]
        pull[:, 0] += bell[:, 0] * outer
        steep = pull.sum(axis=1)
        columns = np.empty((len(rho), 7))
        columns[:, 0] = -steep * nx
        columns[:, 1] = -steep * ny
        columns[:, 2] = -pull @ edges_m
        columns[:, 3] = -steep * (nx * qx * qy + ny * (1.0 + qy * qy))
        columns[:, 4] = steep * (nx * (1.0 + qx * qx) + ny * qx * qy)
        columns[:, 5] = -(pull @ sides) * slope
        widened = wider * sides * (blur * blur / sigma) * contrast_of_pixel[:, None]
        widened[:, 0] += wider[:, 0] * (blur * blur / sigma[:, 0]) * outer
        columns[:, 6] = widened.sum(axis=1) + 2.0 * (pull * bend).sum(axis=1)
        considered = np.empty((len(rho), 4))
        considered[:, 0] = -steep * (gx * x + gy * y)
        considered[:, 1] = -steep * gx / plane.camera.fx
        considered[:, 2] = -steep * gy / plane.camera.fy
        considered[:, 3] = -steep * slope
        free = [0, 1, 2, 5, 6] if self.tilt_sigma_rad == 0.0 else [0, 1, 2, 3, 4, 5, 6]
        rows = np.concatenate((columns[:, free], linear), axis=1)
        total = float(weight.sum())
        variance = max(float(weight @ (rest * rest)) / max(total - rows.shape[1], 1.0), 0.08)
        prior, offset = np.zeros(7), np.zeros(7)
        prior[5], offset[5] = variance / GROWTH_SIGMA_PX**2, -state.growth_px
        prior[6], offset[6] = variance / BLUR_LOG_SIGMA**2, -np.log(blur / START_BLUR_PX)
        if self.tilt_sigma_rad > 0.0:
            prior[3:5], offset[3:5] = variance / self.tilt_sigma_rad**2, -state.tilt
        precision = np.concatenate((prior[free], ridge))
        pull_back = np.concatenate((prior[free] * offset[free], np.zeros(n_lin)))
        rw = rows * weight[:, None]
        try:
            inverse = np.linalg.inv(rw.T @ rows + np.diag(precision))
        except np.linalg.LinAlgError:
            return None
        change = inverse @ (rw.T @ rest + pull_back)
        if np.isfinite(state.scale):
            state.scale = max(0.6 * state.scale, 3.0 * scale)
        return _Equations(
            inverse * variance,
            change[: len(free)],
            free,
            rest,
            weight,
            float(weight @ (rest * rest)) / max(total, 1e-9),
            contrast,
            rows,
            considered,
            used,
        )

    def _light(self, ex: Array, ey: Array, cdf: Array) -> Array:
        """Return the columns of everything that is linear: levels, contrasts, and how they vary over the
        target."""
        pattern = cdf.sum(axis=1)
        outermost = cdf[:, 0] if cdf.shape[1] > 1 else np.zeros_like(ex)
        if self.sectors == 1:
            return np.stack(
                (np.ones_like(ex), pattern, outermost, ex, ey, ex * pattern, ey * pattern), axis=1
            )
        sector = ((np.arctan2(ey, ex) / (2.0 * np.pi) % 1.0) * self.sectors).astype(np.intp) % self.sectors
        one_hot = np.zeros((len(ex), self.sectors))
        one_hot[np.arange(len(ex)), sector] = 1.0
        return np.concatenate((one_hot, one_hot * pattern[:, None], outermost[:, None]), axis=1)

    def _solve_light(
        self, linear: Array, value: Array, ridge: Array, limit: float
    ) -> tuple[Array, Array, Array, float]:
        weight = np.ones(len(value)) if self.fixed_weight is None else self.fixed_weight
        scale = 0.5
        for _ in range(1 if self.fixed_weight is not None else 3):
            lw = linear * weight[:, None]
            coefficients = np.asarray(np.linalg.solve(lw.T @ linear + np.diag(ridge), lw.T @ value))
            rest = value - linear @ coefficients
            if self.fixed_weight is not None:
                break
            size = np.abs(rest)
            scale = max(1.4826 * float(np.median(size)), 0.5)
            if self.sectors == 1:
                weight = np.minimum(1.0, 2.5 * scale / np.maximum(size, 1e-9))
            else:
                bound = limit if np.isfinite(limit) else 2.5 * scale
                weight = 1.0 / (1.0 + (rest / bound) ** 4)
        return coefficients, rest, weight, scale

    def _contrasts(self, linear: Array, cdf: Array, coefficients: Array) -> tuple[Array, float]:
        """Return the contrast at each pixel and what the outermost edge has in addition."""
        n = len(linear)
        if self.sectors == 1:
            varying = coefficients[1] + linear[:, 3] * coefficients[5] + linear[:, 4] * coefficients[6]
            return np.maximum(varying, 0.0), float(coefficients[2])
        s = self.sectors
        return np.maximum(linear[:n, :s] @ coefficients[s : 2 * s], 0.0), float(coefficients[2 * s])

    def descend(self, state: _State, iterations: int, tolerance: float) -> _Equations | None:
        """Move ``state`` to the best fit and return the equations there."""
        equations = None
        if self.sectors > 1:
            state.scale = 60.0
        for _ in range(iterations):
            equations = self.equations(state)
            if equations is None:
                return None
            full = np.zeros(7)
            full[equations.free] = equations.change
            size = max(
                float(np.hypot(*_move(state.centre, full))) / self.unit,
                abs(full[2]) * self.edges_m[0] / self.unit,
                abs(full[5]),
                2.0 * abs(full[6]),
                float(np.hypot(full[3], full[4])) / 0.1,
            )
            full *= min(1.0, 0.5 / max(size, 1e-12))
            state.centre = state.centre + full[:2]
            state.kappa += full[2]
            state.growth_px += full[5]
            state.blur_px = float(np.clip(state.blur_px * np.exp(full[6]), 0.3, 4.0))
            if self.tilt_sigma_rad > 0.0:
                state.tilt = state.tilt + full[3:5]
                state.plane = state.plane.tilted(rotation_xy(full[3], full[4]))
            if not (state.kappa > 0.0 and np.isfinite(state.centre).all()):
                return None
            if size < tolerance:
                break
        return equations


def _move(centre: Array, change: Array) -> tuple[float, float]:
    """Return how far the target moves in the image's plane: a tilt alone carries the plane's points along."""
    x, y = centre
    alpha, beta = change[3], change[4]
    return (
        float(change[0] + x * y * alpha - (1.0 + x * x) * beta),
        float(change[1] + (1.0 + y * y) * alpha - x * y * beta),
    )


def _result(state: _State, solved: _Equations, gain: float, edges_m: Array, patch: _Patch) -> Fit:
    free = solved.free
    at = [n for n, i in enumerate(free) if i < 5]
    rows = [i for i in free if i < 5]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(rows, rows)] = solved.inverse[np.ix_(at, at)]
    if patch.clipped:
        # Half of every edge is missing, and with it what keeps scale and blur apart.
        unit = float(state.plane.units_per_pixel(state.centre[0], state.centre[1]))
        covariance[2, 2] += (CLIPPED_ERROR_PX * unit / edges_m[0]) ** 2
    total = float(solved.weight.sum())
    variance = max(solved.mean_square * total / max(total - solved.rows.shape[1], 1.0), 0.08)
    rw = solved.rows * solved.weight[:, None]
    shift = -(solved.inverse / variance) @ (rw.T @ solved.considered)
    considered = np.zeros((5, 4))
    considered[rows] = shift[at]
    agrees = np.abs(solved.residual) < max(3.5 * np.sqrt(variance), 0.12 * solved.contrast)
    v = patch.v[solved.used]
    qx, qy = state.plane.from_rays(patch.x[solved.used], patch.y[solved.used], v.astype(np.float64))
    ex, ey = qx - state.centre[0], qy - state.centre[1]
    inside = agrees & (np.hypot(ex, ey) < 0.97 * state.kappa * edges_m[0])
    value, red = patch.value[solved.used][inside], patch.red[solved.used][inside]
    slope = float(np.cov(red, value)[0, 1] / max(float(value.var()), 1e-9)) if inside.sum() > 8 else 0.0
    # What covers a target covers one side more than the other; another pattern disagrees all round.
    sector = ((np.arctan2(ey, ex) / (2.0 * np.pi) % 1.0) * 8.0).astype(np.intp) % 8
    share = np.bincount(sector, weights=agrees, minlength=8) / np.maximum(np.bincount(sector, minlength=8), 1)
    even = float(agrees.mean()) < 0.9 and float(np.ptp(share)) < 0.2
    points = np.stack((patch.u[solved.used], patch.v[solved.used]), axis=1).astype(np.float64)
    return Fit(
        state.plane,
        state.centre,
        state.kappa,
        state.tilt,
        covariance,
        considered,
        float(np.sqrt(variance)) / solved.contrast,
        float(agrees.mean()),
        tuple(range(len(edges_m))),
        state.blur_px,
        state.growth_px,
        float(np.sqrt(solved.inverse[free.index(5), free.index(5)])),
        gain,
        int(agrees.sum()),
        len(edges_m),
        3 in free,
        points,
        agrees,
        slope,
        1.0 - float(agrees.mean()) if even else 0.0,
        True,
    )

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

from vision.lines import Edges, Lines, lay_lines
from vision.plane import LevelPlane, rotation_xy

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

GROWTH_SIGMA_PX = 0.3
"""Prior 1-sigma of the growth of red."""
START_BLUR_PX = 0.65
CLOSE_PX = 0.12
"""Displacements below this are linear enough to need no second step."""
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
    ``contradicted`` is the share of the places where an edge should be and plain white or red is, or (of an
    area fit) what disagrees evenly all round.
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


def phi(t: Array) -> Array:
    """Return the normal distribution function, to 3e-4 (Page's formula with tanh)."""
    return 0.5 + 0.5 * np.tanh(_SQRT_2_OVER_PI * t * (1.0 + 0.044715 * t * t))


def _median(values: Array) -> float:
    """Return the upper median: ``numpy.median`` takes five times as long on a hundred values."""
    k = len(values) // 2
    return float(np.partition(values, k)[k])


def fit_profiles(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges: Edges,
    *,
    tilt_sigma_rad: float = 0.0,
    tilt: Array | None = None,
    n_lines: int = 54,
) -> Fit | None:
    """Fit centre, scale, blur and growth (and the plane's tilt, with a prior of ``tilt_sigma_rad``, if not
    zero).

    ``image`` BGR; ``centre`` (2,), ``kappa`` [1/m] the start, good to about 1.5 px at the edges. None where
    too few edges are in view or the fit leaves the start. ``tilt`` (2,) is the tilt that ``plane`` already
    has.
    """
    state = _State(plane, centre, kappa, np.zeros(2) if tilt is None else tilt, START_BLUR_PX, 0.0)
    free = [0, 1, 2, 5] if tilt_sigma_rad == 0.0 else [0, 1, 2, 3, 4, 5]
    laid_blur = START_BLUR_PX
    lines: Lines | None = None
    solved: _Solved | None = None
    # A tilt of degrees is far from linear, a move of the centre by a pixel a little.
    near_enough_px = 0.35 if tilt_sigma_rad == 0.0 else 0.04
    for _ in range(8):
        lines = lay_lines(image, state.plane, state.centre, state.kappa, edges, laid_blur, n_lines)
        if lines is None:
            return None
        solved = _fit_lines(state, lines, free, tilt_sigma_rad)
        if solved is None:
            return None
        state.move(solved.moved)
        if not (state.kappa > 0.0 and np.isfinite(state.centre).all()):
            return None
        if solved.moved_px < near_enough_px and max(state.blur_px, 1.1) < 1.25 * max(laid_blur, 1.1):
            break
        laid_blur = state.blur_px
    assert lines is not None and solved is not None
    return _result(state, solved, lines, edges, free)


@dataclass(slots=True)
class _State:
    plane: LevelPlane
    centre: Array
    kappa: float
    tilt: Array
    blur_px: float
    growth_px: float
    blur_xy: Array | None = None
    """The blur's covariance (uu, uv, vv) [px^2], where it differs with the direction."""

    def move(self, change: Array) -> None:
        """Apply a change of centre x, y, kappa, tilt x, y, growth."""
        self.centre = self.centre + change[:2]
        self.kappa += float(change[2])
        self.growth_px += float(change[5])
        if change[3] != 0.0 or change[4] != 0.0:
            self.tilt = self.tilt + change[3:5]
            self.plane = self.plane.tilted(rotation_xy(change[3], change[4]))

    def blur_of(self, lines: Lines) -> Array:
        """Return the blur on each line (p,) [px]."""
        if self.blur_xy is None:
            return np.full(len(lines.edge), self.blur_px)
        uu, uv, vv = self.blur_xy
        square = lines.nu * lines.nu * uu + lines.nu * lines.nv * uv + lines.nv * lines.nv * vv
        return np.asarray(np.sqrt(np.clip(square, 0.09, 36.0)))


@dataclass(slots=True)
class _Solved:
    inverse: Array
    weight: Array
    residual: Array
    inlier: NDArray[np.bool_]
    moved: Array
    moved_px: float
    chi2_reduced: float
    contrast: float


def _fit_lines(state: _State, lines: Lines, free: list[int], tilt_sigma_rad: float) -> _Solved | None:
    """Fit the parameters to one set of lines; ``state`` keeps its place, only its blur is updated."""
    a = lines.design[:, free]
    precision = np.zeros(len(free))
    precision[-1] = 1.0 / GROWTH_SIGMA_PX**2
    start = np.zeros(len(free))
    start[-1] = state.growth_px
    if len(free) == 6:
        precision[3:5] = 1.0 / tilt_sigma_rad**2
        start[3:5] = state.tilt
    prior = np.diag(precision)
    total = np.zeros(len(free))
    # Growth is a parameter of the edges' places, which were laid without it.
    total[-1] = state.growth_px
    base = total.copy()
    solved: _Solved | None = None
    for i in range(5):
        measured = _displacements(state, lines, a @ total, float(total[-1]), free_blur=i < 4)
        if measured is None:
            return None
        delta, sigma2, valid, contrast, ratio = measured
        pull = precision * (base - start - total)
        solved = _least_squares(a, delta, sigma2, valid, prior, pull)
        if solved is None:
            return None
        solved.contrast = contrast
        total = total + solved.moved
        step_px = float(np.abs(a @ solved.moved).max())
        blur_before = state.blur_px
        _update_blur(state, lines, ratio, solved.weight > 0.0)
        if step_px < CLOSE_PX and 0.8 < state.blur_px / blur_before < 1.25:
            break
    assert solved is not None
    change = np.zeros(6)
    change[free] = total - base
    solved.moved_px = float(np.abs(a[:, :-1] @ (total - base)[:-1]).max())
    solved.moved = change
    return solved


def _displacements(
    state: _State, lines: Lines, shift_px: Array, growth_px: float, free_blur: bool
) -> tuple[Array, Array, NDArray[np.bool_], float, Array] | None:
    """Measure each line's edge: displacement from ``shift_px`` [px], its variance, whether it is one at all.

    Also returned: the contrast, and each line's change of the logarithm of the blur.
    """
    blur = state.blur_of(lines)
    s = lines.side
    per = (1.0 / blur)[:, None]
    distance = lines.distance - (shift_px - blur * blur * lines.bend)[:, None]
    t = distance * per
    bell = np.exp(-0.5 * t * t)
    rise = phi(t)
    spread = t * bell
    if (lines.gap_px - lines.half_px < 3.0 * blur).any():
        # The neighbours grow the other way, and bend by their own radius.
        grown = (2.0 * growth_px) * s - blur * blur * lines.bend
        for offset in (
            grown - lines.outward_px + blur * blur * lines.outward_bend,
            grown + lines.inward_px + blur * blur * lines.inward_bend,
        ):
            tj = np.clip((distance + offset[:, None]) * per, -9.0, 9.0)
            bj = np.exp(-0.5 * tj * tj)
            rise = rise - phi(tj)
            bell = bell - bj
            spread = spread - tj * bj
    basis = np.empty((len(s), 4, t.shape[1]))
    np.multiply(s[:, None], rise, out=basis[:, 0])
    np.multiply((-INV_SQRT_2PI * s)[:, None] * per, bell, out=basis[:, 1])
    np.multiply((-INV_SQRT_2PI * s)[:, None], spread, out=basis[:, 2])
    basis[:, 3] = lines.value
    weighted = basis * lines.weight[:, None, :]
    # Sums of products about the means of each line: its level is eliminated.
    sums = weighted.sum(axis=2)
    gram = weighted @ basis.transpose(0, 2, 1)
    gram -= (sums / np.maximum(lines.total, 1.0)[:, None])[:, :, None] * sums[:, None, :]
    power = gram[:, 3, 3]
    solution, inverse_11 = _solve3(gram) if free_blur else _solve2(gram)
    contrast = solution[0]
    rest = power - (solution * gram[:, :3, 3].T).sum(axis=0)
    dof = np.maximum(lines.total - 4.0, 1.0)
    variance = np.maximum(rest, 0.0) / dof
    middle = _median(contrast)
    if not middle > 4.0:
        return None
    noise = max(_median(variance), 0.08)
    seen = np.maximum(contrast, 1.0)
    delta = solution[1] / seen
    sigma2 = np.maximum(variance, noise) * inverse_11 / (seen * seen)
    valid = (contrast > max(4.0, 0.3 * middle)) & (rest < np.maximum(0.15 * power, 8.0 * noise * dof))
    valid &= (np.abs(delta) < lines.half_px) & (sigma2 < 1.0) & (lines.total >= 5.0)
    if np.count_nonzero(valid) < 10:
        return None
    return delta, sigma2, valid, middle, solution[2] / seen


def _least_squares(
    a: Array, delta: Array, sigma2: Array, valid: NDArray[np.bool_], prior: Array, pull: Array
) -> _Solved | None:
    """Solve for the change of the parameters, robustly; lines that disagree lose their weight altogether."""
    full = valid / (sigma2 + 1e-4)
    delta = np.where(valid, delta, 0.0)
    weight = full
    for last in (False, False, True):
        aw = a * weight[:, None]
        try:
            inverse = np.asarray(np.linalg.inv(aw.T @ a + prior))
        except np.linalg.LinAlgError:
            return None
        change = inverse @ (aw.T @ delta + pull)
        residual = delta - a @ change
        size = np.abs(residual)
        scale = max(1.4826 * _median(size[valid]), 0.01)
        largest = float(size[valid].max())
        if last or largest < 2.5 * scale:
            break
        huber = np.minimum(1.0, 2.0 * scale / np.maximum(size, 1e-12))
        weight = full * huber * (size < max(5.0 * scale, 0.1))
    inlier = valid & (size < max(5.0 * scale, 0.25))
    n = int(np.count_nonzero(weight))
    if n < 10:
        return None
    chi2 = float(weight @ (residual * residual)) / float(max(n - change.size, 1))
    return _Solved(inverse, weight, residual, inlier, change, 0.0, chi2, 0.0)


def _update_blur(state: _State, lines: Lines, ratio: Array, used: NDArray[np.bool_]) -> None:
    """Move the blur by what the lines say; a blur that is not small may differ with the direction
    (motion)."""
    step = np.clip(ratio, -0.5, 0.5)
    state.blur_px = min(6.0, max(0.3, state.blur_px * float(np.exp(_median(step[used])))))
    if state.blur_px < 0.85:
        state.blur_xy = None
        return
    square = (state.blur_of(lines) * np.exp(step))[used] ** 2
    nu, nv = lines.nu[used], lines.nv[used]
    columns = np.stack((nu * nu, nu * nv, nv * nv), axis=1)
    keep = np.ones(len(square), dtype=np.bool_)
    for _ in range(2):
        if keep.sum() < 10:
            return
        found = np.asarray(np.linalg.lstsq(columns[keep], square[keep], rcond=None)[0])
        off = np.abs(square - columns @ found)
        keep = off < 3.0 * _median(off) + 1e-6
    if np.isfinite(found).all():
        state.blur_xy = found


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
    return x / determinant, c11 / determinant


def _solve2(gram: Array) -> tuple[Array, Array]:
    """Solve the 2x2 systems without the blur; the third element of the solution is zero."""
    a, b, d = gram[:, 0, 0], gram[:, 0, 1], gram[:, 1, 1]
    determinant = a * d - b * b
    determinant = np.where(determinant > 1e-12 * a * d, determinant, np.inf)
    h0, h1 = gram[:, 0, 3], gram[:, 1, 3]
    x = np.stack((d * h0 - b * h1, a * h1 - b * h0, np.zeros_like(a)))
    return x / determinant, a / determinant


def _result(state: _State, solved: _Solved, lines: Lines, edges: Edges, free: list[int]) -> Fit:
    n_edges = len(edges.radius_m)
    a = lines.design[:, free]
    weight = solved.weight
    aw = a * weight[:, None]
    # Scatter of the displacements about the model scales the covariance, up and down.
    covariance_free = solved.inverse * solved.chi2_reduced
    gain = -solved.inverse @ (aw.T @ lines.considered)
    rows = [i for i in free if i < 5]
    keep = [n for n, i in enumerate(free) if i < 5]
    covariance = np.zeros((5, 5))
    covariance[np.ix_(rows, rows)] = covariance_free[np.ix_(keep, keep)]
    considered = np.zeros((5, 3))
    considered[rows] = gain[keep]
    inlier = solved.inlier
    laid = np.bincount(lines.edge, minlength=n_edges)
    agreeing = np.bincount(lines.edge, weights=inlier, minlength=n_edges)
    seen = np.flatnonzero(agreeing > 0.4 * laid)
    inner = inlier & (lines.edge > 0)
    wv = (lines.weight * lines.value)[inner].ravel()
    slope = float(wv @ lines.red[inner].ravel()) / max(float(wv @ lines.value[inner].ravel()), 1e-9)
    contradicted, share = 0.0, 1.0
    if not inlier.all() and inlier.any():
        white = _median(lines.level[inlier]) + 0.5 * solved.contrast
        flat = np.abs(lines.value).max(axis=1) < 0.2 * solved.contrast
        plain = flat & (np.abs(lines.level - white) < 0.15 * solved.contrast) & (lines.level < 248.0)
        red = flat & (lines.red.mean(axis=1) > 1.3 * lines.level + 4.0)
        contradicted = float(((plain | red) & ~inlier).mean())
        # Each line stands for a piece of its edge.
        length = edges.radius_m[lines.edge] / laid[lines.edge]
        share = float(length @ inlier) / float(length.sum())
    n_inlier = int(np.count_nonzero(inlier))
    misses = solved.residual[inlier]
    rms = float(np.sqrt(misses @ misses / n_inlier)) if n_inlier else float("inf")
    return Fit(
        state.plane,
        state.centre,
        state.kappa,
        state.tilt,
        covariance,
        considered,
        rms,
        share,
        tuple(seen.tolist()),
        state.blur_px,
        state.growth_px,
        solved.chi2_reduced,
        n_inlier,
        int((laid > 0).sum()),
        3 in free,
        np.stack((lines.u0, lines.v0), axis=1),
        inlier,
        slope,
        contradicted,
    )

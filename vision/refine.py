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

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from vision.lines import (
    CONSIDERED,
    DESIGN,
    LEVEL,
    MIN_LINES,
    RED,
    U0,
    V0,
    VALUE,
    WEIGHT,
    Edges,
    Lines,
    lay_lines,
)
from vision.plane import LevelPlane, rotation_xy
from vision.profile import crowded, line_blurs, line_boxes, line_moments, measure, updated_blur
from vision.robust import Solved, least_squares, median, normal_equations, scatter_covariance, times
from vision.view import View, turned

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

GROWTH_SIGMA_PX = 0.3
"""Prior 1-sigma of the growth of red."""
START_BLUR_PX = 0.65
CLOSE_PX = 0.12
"""Displacements below this are linear enough to need no second step."""
N_LINES = 64
"""About how many lines are laid over all edges."""


@dataclass(frozen=True, slots=True)
class Fit:
    """The result of a photometric fit.

    ``plane`` is the plane that was fitted, tilted where the tilt was free; ``centre`` (2,), ``kappa`` [1/m];
    ``tilt`` (2,) rotation vector about the level x and y axes [rad]; ``covariance`` that
    of (centre x, y, kappa, tilt x, y), shape (5, 5), zero rows for a fixed tilt; ``considered`` (5, 4) the
    change of those per relative error of the focal length, per pixel of the principal point, and per pixel by
    which all edges lie further out than the model says;
    ``residual_px`` the root-mean-square displacement of the edges; ``share`` of the visible edge length
    that agrees with the model; ``edges`` that were seen, of ``n_visible`` that should be; ``chi2`` the mean
    weighted square of the displacements (of an area fit: how many times worse a plain disc fits);
    ``growth_sigma_px`` how well the growth is known;
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
    growth_sigma_px: float
    chi2: float
    count: int
    n_visible: int
    tilt_free: bool
    points_px: Array
    agrees: NDArray[np.bool_]
    red_slope: float
    contradicted: float
    is_area: bool = False


class Solution(NamedTuple):
    """What ``solve_profiles`` found; names as in ``Fit``, with the plane's ``rotation`` and ``seen`` (k,) for
    each edge. Undefined where it is not ``ok``.
    """

    ok: bool
    rotation: Array
    centre: Array
    kappa: float
    tilt: Array
    covariance: Array
    considered: Array
    residual_px: float
    share: float
    seen: NDArray[np.bool_]
    blur_px: float
    growth_px: float
    growth_sigma_px: float
    chi2: float
    n_inlier: int
    n_visible: int
    points_px: Array
    agrees: NDArray[np.bool_]
    red_slope: float
    contradicted: float


Solver = Callable[[Image, View, Array, float, Array, Edges, float, int], Solution]


def fit_profiles(
    image: Image,
    plane: LevelPlane,
    centre: Array,
    kappa: float,
    edges: Edges,
    *,
    tilt_sigma_rad: float = 0.0,
    tilt: Array | None = None,
    n_lines: int = N_LINES,
    solver: Solver | None = None,
) -> Fit | None:
    """Fit centre, scale, blur and growth (and the plane's tilt, with a prior of ``tilt_sigma_rad``, if not
    zero).

    ``image`` BGR; ``centre`` (2,), ``kappa`` [1/m] the start, good to about 1.5 px at the edges. None where
    too few edges are in view or the fit leaves the start. ``tilt`` (2,) is the tilt that ``plane`` already
    has. ``solver`` is ``solve_profiles`` or its compiled form.
    """
    solve = solve_profiles if solver is None else solver
    start = np.zeros(2) if tilt is None else tilt
    s = solve(image, plane.view, centre, float(kappa), start, edges, float(tilt_sigma_rad), n_lines)
    if not s.ok:
        return None
    return Fit(
        LevelPlane(plane.camera, s.rotation, plane.rate_cam_radps),
        s.centre,
        s.kappa,
        s.tilt,
        s.covariance,
        s.considered,
        s.residual_px,
        s.share,
        tuple(np.flatnonzero(s.seen).tolist()),
        s.blur_px,
        s.growth_px,
        s.growth_sigma_px,
        s.chi2,
        s.n_inlier,
        s.n_visible,
        tilt_sigma_rad > 0.0,
        s.points_px,
        s.agrees,
        s.red_slope,
        s.contradicted,
    )


def solve_profiles(
    image: Image,
    view: View,
    centre: Array,
    kappa: float,
    tilt: Array,
    edges: Edges,
    tilt_sigma_rad: float,
    n_lines: int,
) -> Solution:
    """Do the work of ``fit_profiles`` on plain arrays."""
    free = np.array([0, 1, 2, 5]) if tilt_sigma_rad == 0.0 else np.arange(6)
    # A tilt of degrees is far from linear, a move of the centre by a pixel a little.
    near_enough_px = 0.35 if tilt_sigma_rad == 0.0 else 0.04
    blur_px, growth_px = START_BLUR_PX, 0.0
    blur_xy = np.array([blur_px * blur_px, 0.0, blur_px * blur_px])
    laid_blur = blur_px
    for attempt in range(8):
        lines = lay_lines(image, view, centre, kappa, edges, laid_blur, n_lines)
        if len(lines.edge) < MIN_LINES:
            return _no_solution()
        step = _fit_lines(lines, free, tilt, tilt_sigma_rad, blur_px, blur_xy, growth_px)
        if not step.ok:
            return _no_solution()
        change = step.change
        blur_px, blur_xy = step.blur_px, step.blur_xy
        centre = centre + change[:2]
        kappa = kappa + change[2]
        growth_px = growth_px + change[5]
        if tilt_sigma_rad > 0.0:
            tilt = tilt + change[3:5]
            view = turned(view, rotation_xy(change[3], change[4]) @ view.rotation)
        if not (kappa > 0.0 and np.isfinite(centre).all()):
            return _no_solution()
        settled = step.moved_px < near_enough_px and max(blur_px, 1.1) < 1.25 * max(laid_blur, 1.1)
        if settled or attempt == 7:
            break
        laid_blur = blur_px
    return _result(view, centre, kappa, tilt, blur_px, growth_px, step, lines, edges, free)


class _Step(NamedTuple):
    ok: bool
    solved: Solved
    change: Array
    moved_px: float
    contrast: float
    blur_px: float
    blur_xy: Array
    precision: Array
    expected: Array


def _fit_lines(
    lines: Lines,
    free: NDArray[np.int64],
    tilt: Array,
    tilt_sigma_rad: float,
    blur_px: float,
    blur_xy: Array,
    growth_px: float,
) -> _Step:
    """Fit the parameters to one set of lines: the change of centre x, y, kappa, tilt x, y and growth."""
    a = lines.row[:, DESIGN + free]
    n = len(free)
    precision, start, base = np.zeros(n), np.zeros(n), np.zeros(n)
    precision[n - 1] = 1.0 / GROWTH_SIGMA_PX**2
    # Growth is a parameter of the edges' places, which were laid without it.
    base[n - 1] = growth_px
    if n == 6:
        precision[3:5] = 1.0 / tilt_sigma_rad**2
        start[3:5] = tilt
    total = base.copy()
    for i in range(5):
        shift = times(a, total)
        blur = line_blurs(lines, blur_xy)
        box = line_boxes(lines, blur, blur_xy)
        gram = line_moments(lines, shift, total[n - 1], blur, box, crowded(lines, blur))
        measured = measure(lines, gram, i < 4)
        pull = precision * (base - start - total)
        solved = least_squares(a, measured.delta, measured.sigma2, measured.valid, precision, pull)
        ok = measured.ok and solved.ok
        if not ok:
            break
        total = total + solved.change
        step_px = float(np.abs(times(a, solved.change)).max())
        blur_before = blur_px
        blur_px, blur_xy = updated_blur(lines, blur_px, blur_xy, measured.ratio, solved.weight > 0.0)
        if step_px < CLOSE_PX and 0.8 < blur_px / blur_before < 1.25:
            break
    change = np.zeros(6)
    for k in range(n):
        change[free[k]] = total[k] - base[k]
    moved = total - base
    moved[n - 1] = 0.0
    moved_px = float(np.abs(times(a, moved)).max())
    return _Step(
        ok, solved, change, moved_px, measured.contrast, blur_px, blur_xy, precision, measured.expected
    )


def _result(
    view: View,
    centre: Array,
    kappa: float,
    tilt: Array,
    blur_px: float,
    growth_px: float,
    step: _Step,
    lines: Lines,
    edges: Edges,
    free: NDArray[np.int64],
) -> Solution:
    n = len(free)
    a = lines.row[:, DESIGN + free]
    solved = step.solved
    covariance, considered = np.zeros((5, 5)), np.zeros((5, 4))
    for k in range(4):
        _, pulled = normal_equations(a, solved.weight, lines.row[:, CONSIDERED + k])
        shift = times(solved.inverse, pulled)
        for i in range(n - 1):
            considered[free[i], k] = -shift[i]
    spread = scatter_covariance(a, solved, step.precision, step.expected)
    for i in range(n - 1):
        for j in range(n - 1):
            covariance[free[i], free[j]] = spread[i, j]
    inlier = solved.inlier
    laid, agreeing = counted(lines.edge, inlier, len(edges.radius_m))
    share, contradicted, slope = agreement(lines, edges, laid, inlier, step.contrast)
    return Solution(
        True,
        view.rotation,
        centre,
        kappa,
        tilt,
        covariance,
        considered,
        rms(solved.residual, solved.weight, inlier),
        share,
        agreeing > 0.4 * laid,
        blur_px,
        growth_px,
        np.sqrt(spread[n - 1, n - 1]),
        solved.chi2,
        int(np.count_nonzero(inlier)),
        int(np.count_nonzero(laid)),
        lines.row[:, U0 : V0 + 1].copy(),
        inlier,
        slope,
        contradicted,
    )


def counted(edge: NDArray[np.int64], inlier: NDArray[np.bool_], n_edges: int) -> tuple[Array, Array]:
    """Return how many lines lie on each edge and how many of them agree, both (k,)."""
    return (
        np.bincount(edge, minlength=n_edges).astype(np.float64),
        np.bincount(edge[inlier], minlength=n_edges).astype(np.float64),
    )


def rms(residual: Array, weight: Array, used: NDArray[np.bool_]) -> float:
    """Return the weighted root mean square of the residuals in use."""
    w, misses = weight[used], residual[used]
    total = w.sum()
    return float(np.sqrt((w * misses * misses).sum() / total)) if total > 0.0 else np.inf


def agreement(
    lines: Lines, edges: Edges, laid: Array, inlier: NDArray[np.bool_], contrast: float
) -> tuple[float, float, float]:
    """Return ``share``, ``contradicted`` and ``red_slope`` of ``Fit``."""
    value = lines.pixels[:, :, VALUE] - lines.row[:, LEVEL, None]
    red = lines.pixels[:, :, RED]
    inner = inlier & (lines.edge > 0)
    wv = (lines.pixels[:, :, WEIGHT] * value)[inner].ravel()
    slope = float(wv @ red[inner].ravel()) / max(float(wv @ value[inner].ravel()), 1e-9)
    if inlier.all() or not inlier.any():
        return 1.0, 0.0, slope
    # Where there is no edge at all: as much red as everywhere, or none.
    level = lines.row[:, LEVEL]
    white = median(level[inlier]) + 0.5 * contrast
    flat = ~inlier & (np.abs(value).max(axis=1) < 0.2 * contrast)
    contrary = flat & is_contrary(level, red.mean(axis=1), white, contrast)
    # Each line stands for a piece of its edge.
    length = edges.radius_m[lines.edge] / laid[lines.edge]
    return float(length @ inlier) / float(length.sum()), float(contrary.mean()), slope


def is_contrary(level: Any, red: Any, white: float, contrast: float) -> Any:
    """Return whether a place without an edge is white or red, rather than covered by something else."""
    plain = (np.abs(level - white) < 0.15 * contrast) & (level < 248.0)
    return plain | (red > 1.3 * level + 4.0)


def _no_solution() -> Solution:
    nothing, none = np.zeros((0, 0)), np.zeros(0)
    return Solution(
        False, nothing, none, 0.0, none, nothing, nothing, 0.0, 0.0, np.zeros(0, dtype=np.bool_),
        0.0, 0.0, 0.0, 0.0, 0, 0, nothing, np.zeros(0, dtype=np.bool_), 0.0, 0.0,
    )  # fmt: skip

"""What is accepted as the target, and what is not: limits on a fit's agreement, colours, size and
sharpness."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.refine import Fit

Image = NDArray[np.uint8]

MIN_RED_SLOPE = -0.35
"""Least change of R per change of (G + B) / 2 from red to white; on blue water it is about -1."""
FEW_PIXELS = 250
MIN_GAIN_OVER_DISC = 8.0
"""How many times worse a plain disc has to fit than the target."""
MIN_GAIN_OVER_SMALL_DISC = 2.5
"""The same where so few pixels show the target that its rings are hardly resolved."""


def beyond_doubt(fit: Fit) -> bool:
    """Return whether no other hypothesis need be tried."""
    return fit.share > 0.8 and len(fit.edges) >= 3 and (not fit.is_area or fit.chi2 > 25.0)


def rank(fit: Fit) -> tuple[float, float]:
    """Return the order of preference among accepted fits, best largest."""
    if fit.is_area:
        return 0.5, fit.chi2
    return float(round(5.0 * fit.share)), -fit.residual_px


def doubtful(fit: Fit | None) -> bool:
    """Return whether a level deck explains the image badly enough to try a tilted one."""
    return fit is None or fit.share < 0.8 or fit.residual_px > 0.1 or fit.chi2 > 3.0


def clearly_better(tilted: Fit, level: Fit) -> bool:
    """Return whether freeing the tilt explains the image much better (likelihood ratio over all lines)."""
    if tilted.share > level.share + 0.1:
        return True
    ratio = level.count * 2.0 * np.log(max(level.residual_px, 1e-6) / max(tilted.residual_px, 1e-6))
    return tilted.share > level.share - 0.02 and bool(ratio > 25.0)


def judge_profiles(fit: Fit | None, min_share: float) -> Fit | str:
    """Judge a fit of single edges: the fit, or why it is none."""
    if fit is None:
        return "rings of the target's ratios, but too few of their edges fit"
    if fit.share < min_share:
        return f"only {fit.share:.0%} of the visible edges fit the target"
    if len(fit.edges) < 2 or fit.count < 16:
        return f"only {len(fit.edges)} edge(s) of the target fit"
    if fit.red_slope < MIN_RED_SLOPE:
        return "red rings, but not on white"
    if fit.contradicted > 0.2:
        return f"where {fit.contradicted:.0%} of the edges should be is plain white or red"
    if fit.residual_px > _residual_limit(fit) or abs(fit.growth_px) > 0.6 * max(1.0, fit.blur_px):
        return f"edges are {max(fit.residual_px, abs(fit.growth_px)):.1f} px off the target's"
    if not fit.covariance[2, 2] < (0.05 * fit.kappa) ** 2:
        return "the scale is not observable"
    return fit


def _residual_limit(fit: Fit) -> float:
    """Return how far edges may lie off the target's, rms [px].

    Further where the image's own noise explains it (dusk), or where many rings agree nearly all round, so that light
    which clips or reflects may push edges a little (sun, wet paint) without a look-alike coming in.
    """
    blur = max(1.0, fit.blur_px)
    noise = fit.chi2 < 2.0 and len(fit.edges) >= 4
    many = fit.share > 0.9 and len(fit.edges) >= 5 and fit.count >= 40
    return (0.3 if noise or many else 0.12) * blur


def judge_area(fit: Fit | None, covered: bool, min_share: float, max_blur_px: float) -> Fit | str:
    """Judge a fit of all pixels; the limits lie between what targets and what look-alikes were seen to give.

    They are closer where part of the target may be ``covered``, because more can then be explained away.
    """
    if fit is None:
        return "a small red region that is no target"
    few = fit.count < FEW_PIXELS
    limit = (0.08 if few else 0.055) if covered else (0.085 if few else 0.07)
    if fit.share < (min_share if covered else 0.85) or fit.residual_px > limit:
        return f"a small red region that differs from the target by {fit.residual_px:.0%} of its contrast"
    if fit.red_slope < MIN_RED_SLOPE:
        return "a small red region, but not on white"
    if fit.contradicted > 0.0:
        return "a small red region whose rings have other radii"
    if not (0.38 if covered else 0.15) < fit.blur_px < min(1.8, max_blur_px) or abs(fit.growth_px) > 0.45:
        return "a small red region whose edges are not as sharp as the target's"
    if fit.chi2 < (MIN_GAIN_OVER_SMALL_DISC if few else MIN_GAIN_OVER_DISC):
        return "a small red disc without visible rings"
    if not fit.covariance[2, 2] < (0.1 * fit.kappa) ** 2:
        return "the scale is not observable"
    return fit


def inside_more(image: Image, fit: Fit, radius_m: float) -> bool:
    """Return whether there is a red ring around what was taken for the outermost edge."""
    angle = np.arange(32) * (np.pi / 16.0)
    radius = fit.kappa * radius_m * np.linspace(1.15, 2.8, 12)[:, None]
    u, v = fit.plane.to_pixels(fit.centre[0] + radius * np.cos(angle), fit.centre[1] + radius * np.sin(angle))
    seen = fit.plane.inside(u, v, 1.0)
    pixels = np.zeros((*u.shape, 3))
    pixels[seen] = image[np.rint(v[seen]).astype(np.intp), np.rint(u[seen]).astype(np.intp)]
    red = pixels[..., 2] > 1.3 * pixels[..., :2].max(axis=-1) + 4.0
    visible = seen.sum(axis=1)
    return bool(((red.sum(axis=1) > 0.4 * visible) & (visible >= 6)).any())

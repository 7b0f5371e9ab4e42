"""Which pixels show a small target."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from vision.area_light import CLIPPED_LEVEL, colours
from vision.area_model import Pixels, circle_bounds
from vision.view import View

Array = NDArray[np.float64]
Image = NDArray[np.uint8]

MAX_PIXELS = 2800
"""Up to so many pixels all are compared, and filtered with their neighbours."""


def take_pixels(
    image: Image, view: View, centre: Array, radius: float, border_px: float
) -> tuple[Pixels, bool]:
    """Return the pixels in the box around a circle, none where there are too few or too many, and whether those that
    have clipped were left out.
    """
    u_low, u_high, v_low, v_high = circle_bounds(view, centre, radius)
    nothing = np.zeros(0)
    none = Pixels(nothing, nothing, nothing, nothing, np.zeros(2), 0, 0, False)
    if not np.isfinite(u_low + u_high + v_low + v_high):
        return none, False
    u0, u1 = int(max(0.0, u_low - border_px)), int(min(view.width - 1.0, u_high + border_px + 1.0))
    v0, v1 = int(max(0.0, v_low - border_px)), int(min(view.height - 1.0, v_high + border_px + 1.0))
    if u1 - u0 < 4 or v1 - v0 < 4 or (u1 - u0) * (v1 - v0) > 20000:
        return none, False
    across = u1 - u0 + 1
    index = np.arange(across * (v1 - v0 + 1))
    columns, rows = u0 + index % across, v0 + index // across
    blue, green, red = colours(image, columns, rows)
    # What has clipped says only that it was brighter.
    open_ = np.maximum(blue, green) < CLIPPED_LEVEL
    share = np.count_nonzero(open_) / len(index)
    corner = np.array([float(u0), float(v0)])
    few = len(index) <= MAX_PIXELS
    pixels = Pixels(
        columns.astype(np.float64),
        rows.astype(np.float64),
        0.5 * (blue + green),
        red,
        corner,
        across,
        v1 - v0 + 1,
        few,
    )
    if 0.3 < share < 0.9:
        return chosen(pixels, open_), True
    return pixels, False


def chosen(pixels: Pixels, keep: NDArray[np.bool_]) -> Pixels:
    """Return some of the pixels."""
    return Pixels(
        pixels.u[keep],
        pixels.v[keep],
        pixels.value[keep],
        pixels.red[keep],
        pixels.corner,
        pixels.across,
        pixels.down,
        pixels.filtered,
    )


def thinned(pixels: Pixels, limit: int) -> Pixels:
    """Return about ``limit`` of the pixels, spread evenly and without stripes; their neighbours are gone."""
    # Multiples of the plastic number's powers fill the unit interval evenly over the plane.
    order = (0.7548776662466927 * pixels.u + 0.5698402909980532 * pixels.v) % 1.0
    some = chosen(pixels, order < limit / len(pixels.u))
    return Pixels(some.u, some.v, some.value, some.red, some.corner, some.across, some.down, False)

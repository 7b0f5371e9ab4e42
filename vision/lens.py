"""Lens distortion after OpenCV: from undistorted to distorted rays, and back."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def distort(x: Any, y: Any, lens: Array) -> tuple[Any, Any]:
    """Return where the lens puts rays (x, y), floats or arrays: OpenCV's radial, tangential and rational
    model.

    ``lens`` (8,) is k1, k2, p1, p2, k3, k4, k5, k6.
    """
    s = x * x + y * y
    radial = (1.0 + s * (lens[0] + s * (lens[1] + s * lens[4]))) / (
        1.0 + s * (lens[5] + s * (lens[6] + s * lens[7]))
    )
    return (
        x * radial + 2.0 * lens[2] * x * y + lens[3] * (s + 2.0 * x * x),
        y * radial + lens[2] * (s + 2.0 * y * y) + 2.0 * lens[3] * x * y,
    )


def undistort(xd: Array, yd: Array, lens: Array) -> tuple[Array, Array]:
    """Invert the lens model by Newton's method; NaN where it does not converge (no ray has that image)."""
    k1, k2, p1, p2, k3, k4, k5, k6 = lens
    x, y = xd.astype(np.float64), yd.astype(np.float64)
    with np.errstate(all="ignore"):
        for _ in range(25):
            s = x * x + y * y
            over, under = 1.0 + s * (k1 + s * (k2 + s * k3)), 1.0 + s * (k4 + s * (k5 + s * k6))
            radial = over / under
            slope = (
                k1 + s * (2.0 * k2 + s * 3.0 * k3) - radial * (k4 + s * (2.0 * k5 + s * 3.0 * k6))
            ) / under
            ex, ey = distort(x, y, lens)
            ex, ey = ex - xd, ey - yd
            a = radial + 2.0 * x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
            b = 2.0 * x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
            d = radial + 2.0 * y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
            det = a * d - b * b
            x, y = x - (d * ex - b * ey) / det, y - (a * ey - b * ex) / det
            if np.nanmax(np.abs(ex) + np.abs(ey), initial=0.0) < 1e-13:
                break
        ex, ey = distort(x, y, lens)
        bad = ~(np.abs(ex - xd) + np.abs(ey - yd) < 1e-9)
    return np.where(bad, np.nan, x), np.where(bad, np.nan, y)

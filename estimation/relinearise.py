"""A vision fix that moves the platform far is linearised again where it moves it to.

The first fix finds the platform metres from where it was thought to be, and so does one after a long loss. The
derivatives of a fix by attitude, mounting, range scale and age are proportional to where the target is. Taken at the
old place, they differ by metres from those of the next fix, and the filter would take that difference for a motion of
the target by metres, which tells range scale and tilt; nothing moved. One step of Gauss and Newton (the iterated
Kalman filter; Bell and Cathey, 1993) removes that. Plain functions of arrays that numba compiles as they stand.
"""

from __future__ import annotations

import math

from estimation.deck import vision
from estimation.frames import Array
from estimation.models import VISION, right_jacobian
from estimation.state import (
    ATTITUDE,
    BG0,
    PLATFORM_HEAVE,
    PLATFORM_LEVEL,
    PLATFORM_OFFSET,
    PLATFORM_SWAY,
    POSITION,
    Offsets,
    plus,
)

FAR_M = 0.1
"""A change of the relative place beyond this [m] is far: range scale and tilt, known to half a percent, then make half
a millimetre of it, which is as well as hundreds of fixes tell the place."""


def moved_far(kind: int, error: Array, offsets: Offsets) -> bool:
    """Tell whether an update by ``error`` (n,) is one of vision and moves platform and vehicle far to each other."""
    if kind != VISION or offsets[PLATFORM_OFFSET] < 0:
        return False
    down = error[offsets[POSITION] + 2] + error[offsets[PLATFORM_LEVEL]] + error[offsets[PLATFORM_HEAVE] + 5]
    square = down * down
    for axis in range(2):
        place = error[offsets[PLATFORM_OFFSET] + axis] + error[offsets[PLATFORM_SWAY] + 6 * axis + 5]
        square += (error[offsets[POSITION] + axis] - place) ** 2
    return bool(math.sqrt(square) > FAR_M)


def relinearise(
    value: Array, own: Array, x: Array, error: Array, gyro: Array, p: Array, offsets: Offsets, r: Array,
    H: Array, R: Array,
) -> None:  # fmt: skip
    """Write innovation r (3,), Jacobian H (3, n) and covariance R (3, 3) of a fix, linearised at ``x`` plus ``error``
    and stated about ``x``: r = z - h(x + e) + H e, H by an error at x.

    ``gyro`` is the raw angular velocity [rad/s]. An attitude error d at x is J_r(e) (d - e) at x + e.
    """
    there = plus(x, error, offsets)
    H[:, :] = 0.0
    vision(value, own, there, gyro - there[BG0 : BG0 + 3], p, offsets, r, H, R)
    att = offsets[ATTITUDE]
    G = right_jacobian(error[att : att + 3])
    for i in range(3):
        a, b, c = H[i, att], H[i, att + 1], H[i, att + 2]
        for j in range(3):
            H[i, att + j] = a * G[0, j] + b * G[1, j] + c * G[2, j]
        for k in range(H.shape[1]):
            r[i] += H[i, k] * error[k]

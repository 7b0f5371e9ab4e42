"""What fixes tell of the camera's age: how they change with it, and what of that is the gyro's noise.

A fix is compared with the state at its time, changed to first order by its age (``deck.vision``): by where the vehicle
was and by how it turned since, at the angular velocity of a sample. In a calm hover the sample's noise is no smaller
than the rotation, and while the platform's free motion takes up nearly all that a slow rotation shows, it takes up
nothing of white noise. The fixes do not follow the noise, but the attitude that they are compared with does, by what
it was integrated of it: an update takes that for an age, of three quarters of the samples' interval.
``noise_taken_out`` puts that right as long as it is the lesser part of what an update takes for told of the age (the
estimate keeps the scatter of what is taken out); ``weigh`` tells when it is not, and then the age is considered alone.
Plain functions of arrays that numba compiles as they stand.
"""

from __future__ import annotations

import numpy as np

from estimation import parameters as par
from estimation.algebra import inverse
from estimation.deck import body_to_camera, target_in_body
from estimation.frames import Array, compose, skew
from estimation.state import CAMERA_LATENCY, CAMERA_MOUNT, CL0, Offsets, plus
from estimation.update import LONG_STEP_S

INTERPOLATED = 2.0 / 3.0
"""Variance of white noise interpolated between two samples, over that of a sample, on average over the interval."""
INTEGRATED = 0.5
"""Covariance of that with the attitude's error, over a sample's variance and the interval, on average: of samples n0
and n1, at a share s between them, the attitude has integrated (1 + s (2 - s)) n0 / 2 + s^2 n1 / 2 intervals."""
MOST_NOISE = 0.25
"""Share of what is told of the age that may be the gyro's noise: with more of it the age is only considered."""
FIXES = 100
"""Fixes over which that is averaged."""
AGE_NOISE, AGE_TOLD, SCATTER_SIZE = 4, 5, 6
"""Places in the vibration measure of what the noise tells and of all that is told [1/s^2], and its size."""


def turned(x: Array, p: Array) -> Array:
    """Return R_cm [b]x (3, 3) [m]: less this times the angular velocity is a fix's change per second of its age by
    rotation, b being the target in the body.
    """
    return compose(body_to_camera(x, p), skew(target_in_body(x)))


def noise_told(x: Array, S: Array, R: Array, weight: float, variance: float, p: Array) -> float:
    """Return the information j [1/s^2] on the age that an update takes from the gyro's noise, on average.

    ``S`` and ``R`` (3, 3) are the fix's innovation covariance and noise, ``weight`` divides the noise, ``variance`` q
    [rad^2/s^2] is that of a gyro's sample, W is ``turned``: j = 2/3 q tr(W' M W). M^-1 is the variance of the fix about
    what all the others tell: R, and half of what is unknown before it, S - R, as fixes follow as well.
    """
    M = inverse(0.5 * (S - R) + R / weight, 3)
    W = turned(x, p)
    trace = 0.0
    for k in range(3):
        for i in range(3):
            for j in range(3):
                trace += W[i, k] * M[i, j] * W[j, k]
    return INTERPOLATED * variance * trace


def weigh(scatter: Array, shown: float, PHt: Array, inverted: Array, variance: float) -> None:
    """Take into ``scatter``, over the last hundred fixes, what an update takes for told of the age, and of that what is
    the gyro's noise.

    ``shown`` [1/s^2] is ``noise_told``, ``PHt`` (3,) the age's covariance with the innovation, ``inverted`` (3, 3) the
    inverse covariance of that, ``variance`` [s^2] the age's: what is told is 1 / (variance - PHt S^-1 PHt') less
    1 / variance.
    """
    less = 0.0
    for i in range(3):
        for j in range(3):
            less += PHt[i] * inverted[i, j] * PHt[j]
    told = 1.0 / max(variance - less, 1e-6 * variance) - 1.0 / variance
    scatter[AGE_NOISE] += (shown - scatter[AGE_NOISE]) / FIXES
    scatter[AGE_TOLD] += (told - scatter[AGE_TOLD]) / FIXES


def tells_age(scatter: Array, p: Array) -> bool:
    """Tell whether fixes show the age: the vehicle turns, by more than the gyro's noise, and that is not most of what
    they seem to tell.
    """
    turns = scatter[2] - 3.0 * scatter[1] >= p[par.LATENCY_RATE] ** 2
    return bool(turns and scatter[AGE_NOISE] < MOST_NOISE * scatter[AGE_TOLD])


def noise_taken_out(x: Array, P: Array, shown: float, interval_s: float, p: Array, offsets: Offsets) -> Array:
    """Return the state without what the gyro's noise seemed to tell of the age in an update; P (n, n) likewise, in
    place.

    ``shown`` j [1/s^2] is ``noise_told``, ``interval_s`` T lies between samples: that is of the value
    a = (1/2) / (2/3) T. Without it (the corrected score; Nakamura, 1990): P' = (P^-1 - j e e')^-1,
    x' = x + P' e j (e'x - a). No more is taken than was learned since the first fix. The camera's mounting, which the
    update only considered, has not moved then and does not now: a gain of zero there undoes one of zero.
    """
    age = offsets[CAMERA_LATENCY]
    column = P[:, age].copy()
    most = 1.0 / column[age] - 1.0 / p[par.LATENCY_SIGMA] ** 2
    taken = min(shown, max(0.0, most))
    share = taken / (1.0 - taken * column[age])
    mount = offsets[CAMERA_MOUNT]
    held = P[mount : mount + 3, mount : mount + 3].copy()
    P += np.outer(share * column, column)
    P[mount : mount + 3, mount : mount + 3] = held
    followed = INTEGRATED / INTERPOLATED * min(interval_s, LONG_STEP_S)
    error = share * (x[CL0] - followed) * column
    error[mount : mount + 3] = 0.0
    return plus(x, error, offsets)

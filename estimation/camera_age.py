"""What fixes tell of the camera's age: how they change with it, and what of that is the gyro's noise.

A fix is compared with the state at its time, changed to first order by its age (``deck.vision``): by where the vehicle
was and by how it turned since, at the angular velocity of a sample. In a calm hover the sample's noise is no smaller
than the rotation, and while the platform's free motion takes up nearly all that a slow rotation shows, it takes up
nothing of white noise. The fixes do not follow the noise, which an update takes for an age that is the nominal one.
``noise_taken_out`` puts that right. Plain functions of arrays that numba compiles as they stand.
"""

from __future__ import annotations

from estimation import parameters as par
from estimation.algebra import inverse
from estimation.deck import body_to_camera, target_in_body
from estimation.frames import Array, compose, skew
from estimation.state import CAMERA_LATENCY, CAMERA_MOUNT, CL0, Offsets, plus

INTERPOLATED = 2.0 / 3.0
"""Variance of white noise interpolated between two samples, over that of a sample, on average over the interval."""


def turned(x: Array, p: Array) -> Array:
    """Return R_cm [b]x (3, 3) [m]: less this times the angular velocity is a fix's change per second of its age by
    rotation, b being the target in the body.
    """
    return compose(body_to_camera(x, p), skew(target_in_body(x)))


def noise_taken_out(
    x: Array, P: Array, S: Array, R: Array, weight: float, variance: float, p: Array, offsets: Offsets
) -> Array:
    """Return the state without what the gyro's noise seemed to tell of the age in an update; P (n, n) likewise, in
    place.

    ``S`` and ``R`` (3, 3) are the fix's innovation covariance and noise, ``weight`` divides the noise, ``variance`` q
    [rad^2/s^2] is that of a gyro's sample; W is ``turned``. The noise has shown j = 2/3 q tr(W' M W) [1/s^2] of
    information on the age, of the value zero. M^-1 is the variance of the fix about what all the others tell: R, and
    half of what is unknown before it, S - R, as fixes follow as well. Without that information (the corrected score;
    Nakamura, 1990): P' = (P^-1 - j e e')^-1, x' = x + P' e j e'x. No more is taken than was learned since the first
    fix: vibration that is no white noise may scatter more than it shows. The camera's mounting, which the update only
    considered, has not moved then and does not now: a gain of zero there undoes one of zero.
    """
    M = inverse(0.5 * (S - R) + R / weight, 3)
    W = turned(x, p)
    trace = 0.0
    for k in range(3):
        for i in range(3):
            for j in range(3):
                trace += W[i, k] * M[i, j] * W[j, k]
    age = offsets[CAMERA_LATENCY]
    column = P[:, age].copy()
    most = 1.0 / column[age] - 1.0 / p[par.LATENCY_SIGMA] ** 2
    shown = min(INTERPOLATED * variance * trace, max(0.0, most))
    share = shown / (1.0 - shown * column[age])
    mount = offsets[CAMERA_MOUNT]
    held = P[mount : mount + 3, mount : mount + 3].copy()
    for a in range(P.shape[0]):
        for b in range(P.shape[0]):
            P[a, b] += share * column[a] * column[b]
    P[mount : mount + 3, mount : mount + 3] = held
    error = share * x[CL0] * column
    error[mount : mount + 3] = 0.0
    return plus(x, error, offsets)

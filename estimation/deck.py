"""Models of the platform: how it moves, how a camera sees it, and where it is relative to the vehicle.

Plain functions of arrays that numba compiles as they stand. The platform is an anchored place (random walk), sway
about it (a damped oscillator per axis), a level (random walk, positive up) and heave: white noise through three
sections s / (s^2 + 2 zeta w s + w^2), so that it has no gain at rest and leaves the level to its own state. ``heave``
are its seven parameters: gain, three w [rad/s], three zeta (``estimation.heave.bandpass``).
"""

from __future__ import annotations

import math

import numpy as np

from estimation import parameters as par
from estimation.frames import Array, compose, quat_exp, quat_to_matrix, rotate, skew
from estimation.state import (
    ATTITUDE,
    CAMERA_LATENCY,
    CAMERA_MOUNT,
    CL0,
    CM0,
    P0,
    PH0,
    PL0,
    PLATFORM_HEAVE,
    PLATFORM_LEVEL,
    PLATFORM_OFFSET,
    PLATFORM_SWAY,
    PO0,
    POSITION,
    PS0,
    Q0,
    RANGE_SCALE,
    RS0,
    V0,
    VELOCITY,
    Offsets,
)

HEAVE_SIZE = 6
OUTPUT_SIZE = 8
"""Relative position (3), relative velocity (3), height and its rate."""


def heave_matrix(heave: Array) -> Array:
    """Return f (6, 6) of x' = f x + l w: states of a section are its displacement and velocity."""
    f = np.zeros((HEAVE_SIZE, HEAVE_SIZE))
    for s in range(3):
        w, zeta = heave[1 + s], heave[4 + s]
        f[2 * s, 2 * s + 1] = 1.0
        f[2 * s + 1, 2 * s] = -w * w
        f[2 * s + 1, 2 * s + 1] = -2.0 * zeta * w
        if s > 0:
            f[2 * s + 1, 2 * s - 1] = 1.0
    return f


def heave_stationary(heave: Array) -> Array:
    """Return the covariance (6, 6) of the heave's states once it has run for long."""
    from scipy.linalg import solve_continuous_lyapunov

    drive = np.zeros((HEAVE_SIZE, HEAVE_SIZE))
    drive[1, 1] = heave[0] ** 2
    covariance = solve_continuous_lyapunov(heave_matrix(heave), -drive)
    return np.asarray(0.5 * (covariance + covariance.T))


def deck_transition(
    x: Array, y: Array, dt: float, p: Array, heave: Array, offsets: Offsets, F: Array, Q: Array
) -> None:
    """Propagate the platform's blocks from ``x`` into ``y`` over ``dt`` [s]; fill their places in F and Q.

    The oscillators' transition is a series to third order in dt, the noise Simpson's rule over the step: both good to
    1e-5 for steps up to 25 ms and periods above 0.8 s.
    """
    o = offsets[PLATFORM_OFFSET]
    for i in range(2):
        Q[o + i, o + i] = p[par.OFFSET_WALK] ** 2 * dt
    level = offsets[PLATFORM_LEVEL]
    Q[level, level] = p[par.LEVEL_WALK] ** 2 * dt
    w, zeta, sigma = p[par.SWAY_OMEGA], p[par.SWAY_ZETA], p[par.SWAY_SIGMA]
    f = np.zeros((2, 2))
    f[0, 1] = 1.0
    f[1, 0] = -w * w
    f[1, 1] = -2.0 * zeta * w
    # Stationary variance sigma^2 of a damped oscillator needs white noise of density 4 zeta w^3 sigma^2.
    drive = np.zeros(2)
    drive[1] = 2.0 * sigma * w * math.sqrt(zeta * w)
    for axis in range(2):
        _fill(x, y, PS0 + 2 * axis, f, drive, dt, F, Q, offsets[PLATFORM_SWAY] + 2 * axis)
    drive6 = np.zeros(HEAVE_SIZE)
    drive6[1] = heave[0]
    _fill(x, y, PH0, heave_matrix(heave), drive6, dt, F, Q, offsets[PLATFORM_HEAVE])
    latency = offsets[CAMERA_LATENCY]
    Q[latency, latency] = p[par.LATENCY_WALK] ** 2 * dt


def _fill(
    x: Array, y: Array, place: int, f: Array, drive: Array, dt: float, F: Array, Q: Array, start: int
) -> None:
    """Discretise one oscillator: transition into F, noise into Q, nominal state from x into y."""
    n = f.shape[0]
    for c in range(n):
        column = np.zeros(n)
        column[c] = 1.0
        total = _series(f, column, dt)
        for i in range(n):
            F[start + i, start + c] = total[i]
    middle, end = _series(f, drive, 0.5 * dt), _series(f, drive, dt)
    for i in range(n):
        value = 0.0
        for c in range(n):
            value += F[start + i, start + c] * x[place + c]
            Q[start + i, start + c] = (
                dt / 6.0 * (drive[i] * drive[c] + 4.0 * middle[i] * middle[c] + end[i] * end[c])
            )
        y[place + i] = value


def _series(f: Array, v: Array, t: float) -> Array:
    """Return exp(f t) v to third order in t."""
    n = len(v)
    total, term = v.copy(), v.copy()
    for order in range(1, 4):
        following = np.zeros(n)
        for i in range(n):
            for k in range(n):
                following[i] += f[i, k] * term[k]
            following[i] *= t / order
        term = following
        for i in range(n):
            total[i] += term[i]
    return total


def vision(
    value: Array, own: Array, x: Array, gyro: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array
) -> int:
    """The target in the camera: P^c = (1 + s) R_cb exp(m)' (R_nb' (P_platform - P) - l), mount error m, scale s.

    The age's Jacobian is its rotational part only, [b]x w with b the target in the body: its translational part
    cannot be told from the platform's own motion and drives the age away over a swaying raft.
    """
    if offsets[PLATFORM_OFFSET] < 0:
        return -9
    R_nb = quat_to_matrix(x[Q0 : Q0 + 4])
    R_bn = R_nb.T.copy()
    R_cb = p[par.VISION_MOUNT : par.VISION_MOUNT + 9].copy().reshape(3, 3)
    R_cm = compose(R_cb, quat_to_matrix(quat_exp(x[CM0 : CM0 + 3])).T.copy())
    d = np.empty(3)
    d[0] = x[PO0] + x[PS0] - x[P0]
    d[1] = x[PO0 + 1] + x[PS0 + 2] - x[P0 + 1]
    d[2] = -x[PL0] - x[PH0 + 5] - x[P0 + 2]
    b = rotate(R_bn, d)
    seen = b - p[par.VISION_LEVER : par.VISION_LEVER + 3]
    c = rotate(R_cm, seen)
    scale = 1.0 + x[RS0]
    D = compose(R_cm, R_bn)
    T = compose(R_cm, skew(b))
    M = compose(R_cb, skew(seen))
    turning = rotate(T, gyro)
    for i in range(3):
        r[i] = value[i] - scale * c[i] + turning[i] * x[CL0]
        for j in range(3):
            H[i, offsets[POSITION] + j] = -scale * D[i, j]
            H[i, offsets[ATTITUDE] + j] = scale * T[i, j]
            H[i, offsets[CAMERA_MOUNT] + j] = scale * M[i, j]
        for axis in range(2):
            H[i, offsets[PLATFORM_OFFSET] + axis] = scale * D[i, axis]
            H[i, offsets[PLATFORM_SWAY] + 2 * axis] = scale * D[i, axis]
        H[i, offsets[PLATFORM_LEVEL]] = -scale * D[i, 2]
        H[i, offsets[PLATFORM_HEAVE] + 5] = -scale * D[i, 2]
        H[i, offsets[RANGE_SCALE]] = c[i]
        H[i, offsets[CAMERA_LATENCY]] = -turning[i]
    distance2 = max(1e-4, value[0] ** 2 + value[1] ** 2 + value[2] ** 2)
    floor = p[par.VISION_FLOOR] ** 2
    if own[0] == own[0]:
        R[0, 0], R[0, 1], R[0, 2] = own[0] + floor, own[1], own[2]
        R[1, 0], R[1, 1], R[1, 2] = own[1], own[3] + floor, own[4]
        R[2, 0], R[2, 1], R[2, 2] = own[2], own[4], own[5] + floor
        return 3
    across = p[par.VISION_ANGLE] ** 2 * distance2
    along = p[par.VISION_RANGE] ** 2 * distance2
    for i in range(3):
        for j in range(3):
            R[i, j] = (along - across) * value[i] * value[j] / distance2
        R[i, i] += across + floor
    return 3


def seen_height(r: Array, R: Array, x: Array, p: Array) -> tuple[float, float]:
    """Return the deck's height [m] as a fix with innovation ``r`` and covariance ``R`` shows it, and its variance.

    The vehicle's own height is taken as it is: its error is slow and belongs to the level.
    """
    R_cb = p[par.VISION_MOUNT : par.VISION_MOUNT + 9].copy().reshape(3, 3)
    R_cm = compose(R_cb, quat_to_matrix(quat_exp(x[CM0 : CM0 + 3])).T.copy())
    down = compose(quat_to_matrix(x[Q0 : Q0 + 4]), R_cm.T.copy())[2]
    height = x[PL0] + x[PH0 + 5]
    variance = 0.0
    for i in range(3):
        height -= down[i] * r[i]
        for j in range(3):
            variance += down[i] * R[i, j] * down[j]
    return height, variance


def deck_output(x: Array, heave: Array, offsets: Offsets, n: int) -> tuple[Array, Array]:
    """Return what is reported of the platform, (8,), and its Jacobian by the error state, (8, n).

    Relative position P_uav - P_platform [m] and velocity [m/s] in NED, the deck's height [m] and its rate [m/s] up.
    """
    f = heave_matrix(heave)
    y = np.zeros(OUTPUT_SIZE)
    A = np.zeros((OUTPUT_SIZE, n))
    rate = 0.0
    for k in range(HEAVE_SIZE):
        rate += f[5, k] * x[PH0 + k]
        A[7, offsets[PLATFORM_HEAVE] + k] = f[5, k]
        A[5, offsets[PLATFORM_HEAVE] + k] = f[5, k]
    y[6] = x[PL0] + x[PH0 + 5]
    y[7] = rate
    A[6, offsets[PLATFORM_LEVEL]] = 1.0
    A[6, offsets[PLATFORM_HEAVE] + 5] = 1.0
    for axis in range(2):
        y[axis] = x[P0 + axis] - x[PO0 + axis] - x[PS0 + 2 * axis]
        y[3 + axis] = x[V0 + axis] - x[PS0 + 2 * axis + 1]
        A[axis, offsets[PLATFORM_OFFSET] + axis] = -1.0
        A[axis, offsets[PLATFORM_SWAY] + 2 * axis] = -1.0
        A[3 + axis, offsets[PLATFORM_SWAY] + 2 * axis + 1] = -1.0
    for axis in range(3):
        A[axis, offsets[POSITION] + axis] = 1.0
        A[3 + axis, offsets[VELOCITY] + axis] = 1.0
    y[2] = x[P0 + 2] + y[6]
    y[5] = x[V0 + 2] + rate
    A[2, offsets[PLATFORM_LEVEL]] = 1.0
    A[2, offsets[PLATFORM_HEAVE] + 5] = 1.0
    return y, A

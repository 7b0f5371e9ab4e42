"""Models of the platform: how it moves, how a camera sees it, and where it is relative to the vehicle.

Plain functions of arrays that numba compiles as they stand. The platform is an anchored place (random walk), sway
about it (a damped oscillator per axis), a level (random walk, positive up) and heave: white noise through three
sections s / (s^2 + 2 zeta w s + w^2), so that it has no gain at rest and leaves the level to its own state.

``heave`` are the eleven parameters of this motion, which are learned in flight: of heave the gain, three w [rad/s],
three zeta (``estimation.heave.bandpass``); of sway the 1-sigma [m] north and east and w; of the place its random walk
[m/rts].
"""

from __future__ import annotations

import math

import numpy as np

from estimation import parameters as par
from estimation.config import PlatformConfig
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
HEAVE_PARAMETERS = 7
SWAY_NORTH, SWAY_EAST, SWAY_OMEGA, OFFSET_WALK = 7, 8, 9, 10
MOTION_SIZE = 11
ANY_SEA = np.array([1.0 / 1.6, 1.0, 1.6])
"""Frequencies of the sections of a heave without a form of its own, over their middle: with a damping of 0.5, short
wind sea and swell both lie within what it expects."""
DRIFT_TIME_S = 3.0
"""After so long a random walk of the place is as far as the steady velocity that it stands for takes it [s]."""
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


def prior_motion(platform: PlatformConfig) -> Array:
    """Return the parameters of the motion (11,) before it is learned: a heave of any sea, spread about a period."""
    omega = 2.0 * math.pi / platform.heave_period_s
    heave = np.array([1.0, *(omega * ANY_SEA), *[platform.heave_damping] * 3])
    heave[0] = platform.heave_sigma_m / math.sqrt(heave_stationary(heave)[5, 5])
    sway = platform.sway_sigma_m
    return np.array([*heave, sway, sway, 2.0 * math.pi / platform.sway_period_s, platform.offset_walk])


def heave_derivatives(x: Array, heave: Array) -> Array:
    """Return (6,) the heave's third, second and first integral, itself, its first and second derivative.

    With z = w / ((s^2 + a s + b) ...), the white noise through the denominators alone, the heave is z's third
    derivative: z and its five derivatives are the chain's states (6,) in coordinates that mean the same for any
    parameters.
    """
    z = np.empty(HEAVE_SIZE)
    a2, b2 = 2.0 * heave[5] * heave[2], heave[2] ** 2
    a3, b3 = 2.0 * heave[6] * heave[3], heave[3] ** 2
    z[2], z[3] = x[4], x[5]
    z[4] = x[3] - a3 * z[3] - b3 * z[2]
    z[1] = (x[2] - z[3] - a3 * z[2]) / b3
    z[0] = ((x[0] - x[3] - a2 * x[2]) / b2 - z[2] - a3 * z[1]) / b3
    z[5] = x[1] - a2 * x[3] - b2 * x[2] - a3 * z[4] - b3 * z[3]
    return z


def heave_states(z: Array, heave: Array) -> Array:
    """Return the chain's states (6,); the inverse of ``heave_derivatives``."""
    x = np.empty(HEAVE_SIZE)
    a2, b2 = 2.0 * heave[5] * heave[2], heave[2] ** 2
    a3, b3 = 2.0 * heave[6] * heave[3], heave[3] ** 2
    x[4], x[5] = z[2], z[3]
    x[2] = z[3] + a3 * z[2] + b3 * z[1]
    x[3] = z[4] + a3 * z[3] + b3 * z[2]
    x[0] = x[3] + a2 * x[2] + b2 * (z[2] + a3 * z[1] + b3 * z[0])
    x[1] = z[5] + a3 * z[4] + b3 * z[3] + a2 * x[3] + b2 * x[2]
    return x


def heave_moments(heave: Array) -> Array:
    """Return (6,) the variances of z and its five derivatives (``heave_derivatives``) in a sea without end.

    E[z_i z_j] is (-1)^((i - j) / 2) m_((i + j) / 2) for even i + j, else 0; the z_k are uncorrelated with the noise
    that drives z_6, but for k = 5: six linear equations for the six moments m. Time is in units of the sections'.
    """
    scale = (heave[1] * heave[2] * heave[3]) ** (1.0 / 3.0)
    polynomial = np.zeros(HEAVE_SIZE + 1)
    polynomial[0] = 1.0
    for s in range(3):
        w = heave[1 + s] / scale
        a = 2.0 * heave[4 + s] * w
        for k in range(2 * s + 2, -1, -1):
            value = w * w * polynomial[k]
            if k >= 1:
                value += a * polynomial[k - 1]
            if k >= 2:
                value += polynomial[k - 2]
            polynomial[k] = value
    M = np.zeros((HEAVE_SIZE, HEAVE_SIZE + 1))
    for k in range(HEAVE_SIZE):
        for j in range(k % 2, HEAVE_SIZE + 1, 2):
            sign = 1.0 if (j - k) % 4 == 0 else -1.0
            M[k, (k + j) // 2] += sign * polynomial[j]
    M[HEAVE_SIZE - 1, HEAVE_SIZE] = 0.5 * heave[0] ** 2
    m = _solved(M)
    for k in range(HEAVE_SIZE):
        m[k] *= scale ** (2 * k - 11)
    return m


def _solved(M: Array) -> Array:
    """Return the solution (n,) of the equations (n, n + 1) with their right sides last, by elimination."""
    n = M.shape[0]
    for c in range(n):
        best = c
        for i in range(c + 1, n):
            if abs(M[i, c]) > abs(M[best, c]):
                best = i
        for k in range(c, n + 1):
            M[c, k], M[best, k] = M[best, k], M[c, k]
        for i in range(n):
            if i != c:
                factor = M[i, c] / M[c, c]
                for k in range(c, n + 1):
                    M[i, k] -= factor * M[c, k]
    solution = np.empty(n)
    for i in range(n):
        solution[i] = M[i, n] / M[i, i]
    return solution


def _integrals(heave: Array) -> Array:
    """Return what a sea without end says of the heave's integrals (z, z', z'') from itself, its rate and acceleration:
    (8,) z on the rate, z' on heave and acceleration, z'' on the rate; then of what remains 1-sigma of z', of z'', z on
    z'' and 1-sigma of z.
    """
    m = heave_moments(heave)
    tiny = 1e-12
    out = np.empty(8)
    det = m[3] * m[5] - m[4] ** 2
    out[0] = m[2] / m[4]
    out[1] = (m[3] * m[4] - m[2] * m[5]) / det
    out[2] = (m[3] ** 2 - m[2] * m[4]) / det
    out[3] = -m[3] / m[4]
    out[4] = math.sqrt(max(m[1] + out[1] * m[2] - out[2] * m[3], tiny * m[1]))
    second = max(m[2] - m[3] ** 2 / m[4], tiny * m[2])
    both = -m[1] + m[2] * m[3] / m[4]
    out[5] = math.sqrt(second)
    out[6] = both / second
    out[7] = math.sqrt(max(m[0] - m[2] ** 2 / m[4] - both**2 / second, tiny * m[0]))
    return out


def change_motion(x: Array, P: Array, heave: Array, new: Array, offsets: Offsets, chain: Array) -> None:
    """Go over to new parameters of the motion, in place; ``chain`` (n, n), where it is not empty, is the transition
    since the last node of a trail.

    The chain's states mean something else under other parameters. Heave, its rate and its acceleration stay what they
    are, with their covariance. Its integrals, which have no meaning beyond the chain's and whose size is the model's,
    stay where they were within what the sea says of them: what of them the heave does not tell keeps its value in
    units of its own 1-sigma. So nothing changes with equal parameters, and P stays positive.
    """
    start = offsets[PLATFORM_HEAVE]
    old_sea, new_sea = _integrals(heave), _integrals(new)
    T = np.empty((HEAVE_SIZE, HEAVE_SIZE))
    for c in range(HEAVE_SIZE):
        unit = np.zeros(HEAVE_SIZE)
        unit[c] = 1.0
        z = heave_derivatives(unit, heave)
        rest1 = (z[1] - old_sea[1] * z[3] - old_sea[2] * z[5]) / old_sea[4]
        rest2 = (z[2] - old_sea[3] * z[4]) / old_sea[5]
        rest0 = (z[0] - old_sea[0] * z[4] - old_sea[6] * old_sea[5] * rest2) / old_sea[7]
        z[1] = new_sea[1] * z[3] + new_sea[2] * z[5] + new_sea[4] * rest1
        z[2] = new_sea[3] * z[4] + new_sea[5] * rest2
        z[0] = new_sea[0] * z[4] + new_sea[6] * new_sea[5] * rest2 + new_sea[7] * rest0
        T[:, c] = heave_states(z, new)
    x[PH0 : PH0 + HEAVE_SIZE] = _turned(T, x[PH0 : PH0 + HEAVE_SIZE].copy())
    for c in range(P.shape[0]):
        P[start : start + HEAVE_SIZE, c] = _turned(T, P[start : start + HEAVE_SIZE, c].copy())
    for c in range(P.shape[0]):
        P[c, start : start + HEAVE_SIZE] = _turned(T, P[c, start : start + HEAVE_SIZE].copy())
    for c in range(chain.shape[0]):
        chain[start : start + HEAVE_SIZE, c] = _turned(T, chain[start : start + HEAVE_SIZE, c].copy())
    for i in range(P.shape[0]):
        for c in range(i):
            mean = 0.5 * (P[i, c] + P[c, i])
            P[i, c] = mean
            P[c, i] = mean
    heave[:] = new


def _turned(T: Array, v: Array) -> Array:
    """Return T v (6,), in one order of summation for both engines."""
    out = np.zeros(HEAVE_SIZE)
    for i in range(HEAVE_SIZE):
        for k in range(HEAVE_SIZE):
            out[i] += T[i, k] * v[k]
    return out


def deck_transition(
    x: Array, y: Array, dt: float, p: Array, heave: Array, offsets: Offsets, F: Array, Q: Array
) -> None:
    """Propagate the platform's blocks from ``x`` into ``y`` over ``dt`` [s]; fill their places in F and Q.

    The oscillators' transition is a series to third order in dt, the noise Simpson's rule over the step: both good to
    1e-5 for steps up to 25 ms and periods above 0.8 s.
    """
    o = offsets[PLATFORM_OFFSET]
    for i in range(2):
        Q[o + i, o + i] = heave[OFFSET_WALK] ** 2 * dt
    level = offsets[PLATFORM_LEVEL]
    Q[level, level] = p[par.LEVEL_WALK] ** 2 * dt
    w, zeta = heave[SWAY_OMEGA], p[par.SWAY_ZETA]
    f = np.zeros((2, 2))
    f[0, 1] = 1.0
    f[1, 0] = -w * w
    f[1, 1] = -2.0 * zeta * w
    # Stationary variance sigma^2 of a damped oscillator needs white noise of density 4 zeta w^3 sigma^2.
    drive = np.zeros(2)
    for axis in range(2):
        drive[1] = 2.0 * heave[SWAY_NORTH + axis] * w * math.sqrt(zeta * w)
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


def camera_to_ned(x: Array, p: Array) -> Array:
    """Return the rotation (3, 3) of the camera, with its mounting as estimated, to NED."""
    R_cb = p[par.VISION_MOUNT : par.VISION_MOUNT + 9].copy().reshape(3, 3)
    R_cm = compose(R_cb, quat_to_matrix(quat_exp(x[CM0 : CM0 + 3])).T.copy())
    return compose(quat_to_matrix(x[Q0 : Q0 + 4]), R_cm.T.copy())


def seen_place(r: Array, R: Array, x: Array, p: Array, seen: Array) -> None:
    """Write into ``seen`` (6,) where a fix with innovation ``r`` and covariance ``R`` shows the deck: its height,
    north and east [m], each followed by its variance.

    The vehicle's own position is taken as it is: its error is slow and belongs to level and place.
    """
    R_nc = camera_to_ned(x, p)
    for axis in range(3):
        row = (axis + 2) % 3
        shift = 0.0
        variance = 0.0
        for i in range(3):
            shift += R_nc[row, i] * r[i]
            for j in range(3):
                variance += R_nc[row, i] * R[i, j] * R_nc[row, j]
        if axis == 0:
            seen[0] = x[PL0] + x[PH0 + 5] - shift
        else:
            seen[2 * axis] = x[PO0 + row] + x[PS0 + 2 * row] + shift
        seen[2 * axis + 1] = variance


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


def add_drift(heave: Array, covariance: Array) -> None:
    """Add to the covariance of what is reported, (8, 8), the velocity of the place's drift, which is no state."""
    variance = heave[OFFSET_WALK] ** 2 / DRIFT_TIME_S
    covariance[3, 3] += variance
    covariance[4, 4] += variance

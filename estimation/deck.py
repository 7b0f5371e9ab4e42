"""Models of the platform: how it moves, how a camera sees it, and where it is relative to the vehicle.

Plain functions of arrays that numba compiles as they stand. The platform is an anchored place that drifts with a
velocity of its own, sway about it to north and east, a level (random walk, positive up) and heave about it. Sway and
heave are chains (``estimation.band``), which have no gain at rest and leave place and level to their own states.

``motion`` are the parameters of this motion (22,), which are learned in flight: seven each of heave, sway north and
sway east, in this order, and the 1-sigma of the drift's velocity [m/s].
"""

from __future__ import annotations

import math

import numpy as np

from estimation import parameters as par
from estimation.band import (
    BAND_PARAMETERS,
    BAND_SIZE,
    band_matrix,
    band_stationary,
    change_of_band,
    discrete_band,
    product,
)
from estimation.config import PlatformConfig
from estimation.frames import Array, compose, quat_exp, quat_to_matrix, rotate, skew
from estimation.state import (
    ATTITUDE,
    CAMERA_LATENCY,
    CAMERA_MOUNT,
    CL0,
    CM0,
    P0,
    PD0,
    PH0,
    PL0,
    PLATFORM_DRIFT,
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

HEAVE, SWAY_NORTH, SWAY_EAST, DRIFT_SPEED, MOTION_SIZE = 0, 7, 14, 21, 22
"""First places in ``motion`` of the parameters of each chain, then of the speed of the drift, and their number."""
CHAINS = (HEAVE, SWAY_NORTH, SWAY_EAST)
ANY_SEA = np.array([1.0 / 1.6, 1.0, 1.6])
"""Frequencies of the sections of a motion without a form of its own, over their middle: with a damping of 0.5, short
wind sea and swell both lie within what it expects."""
DRIFT_TIME_S = 10.0
"""Correlation time of the velocity with which the place drifts: a sixth of the minute that a mooring swings in [s]."""
STEPS_KEPT = 61
"""Steps of different length whose transitions are remembered: more than lie in a window of late events; a prime, so
that whole milliseconds do not share a place."""
OUTPUT_SIZE = 8
"""Relative position (3), relative velocity (3), height and its rate."""


def prior_motion(platform: PlatformConfig) -> Array:
    """Return the parameters of the motion (22,) before it is learned: those that are known from before, or chains of
    any sea, spread about their periods.
    """
    if platform.motion is not None:
        return np.array(platform.motion)
    heave = any_sea(platform.heave_sigma_m, 2.0 * math.pi / platform.heave_period_s, platform.heave_damping)
    sway = any_sea(platform.sway_sigma_m, 2.0 * math.pi / platform.sway_period_s, platform.sway_damping)
    return np.array([*heave, *sway, *sway, platform.drift_sigma_mps])


def any_sea(sigma_m: float, omega_radps: float, damping: float) -> Array:
    """Return the parameters of a chain (7,) without a form of its own: its size, middle frequency and dampings."""
    band = np.array([1.0, *(omega_radps * ANY_SEA), damping, damping, damping])
    band[0] = sigma_m / math.sqrt(band_stationary(band)[5, 5])
    return band


def has_form(band: Array) -> bool:
    """Tell whether a chain's parameters (7,) have a form of their own, and are not those of ``any_sea``."""
    omega = band[1:4] / ANY_SEA
    return not (np.allclose(omega, omega[0], rtol=1e-9, atol=0.0) and np.all(band[4:] == band[4]))


def places(chain: int, offsets: Offsets) -> tuple[int, int]:
    """Return where the states of the chain whose parameters begin at ``chain`` begin: nominal state, error state."""
    if chain == HEAVE:
        return PH0, offsets[PLATFORM_HEAVE]
    east = BAND_SIZE if chain == SWAY_EAST else 0
    return PS0 + east, offsets[PLATFORM_SWAY] + east


def change_motion(
    x: Array, P: Array, motion: Array, chain: int, new: Array, offsets: Offsets, trail: Array
) -> None:
    """Go over to new parameters (7,) of one chain, in place (``change_of_band``: P stays positive).

    ``trail`` (n, n), where it is not empty, is the transition since the last node of a trail.
    """
    at, start = places(chain, offsets)
    T = change_of_band(motion[chain : chain + BAND_PARAMETERS], new)
    end = start + BAND_SIZE
    x[at : at + BAND_SIZE] = product(T, x[at : at + BAND_SIZE].copy())
    P[start:end, :] = product(T, P[start:end, :].copy())
    P[:, start:end] = product(T, P[:, start:end].T.copy()).T
    if trail.shape[0] > 0:
        trail[start:end, :] = product(T, trail[start:end, :].copy())
    for i in range(P.shape[0]):
        for c in range(i):
            mean = 0.5 * (P[i, c] + P[c, i])
            P[i, c] = mean
            P[c, i] = mean
    motion[chain : chain + BAND_PARAMETERS] = new


def take_up(
    value: Array, own: Array, x: Array, P: Array, motion: Array, offsets: Offsets, trail: Array
) -> None:
    """Take up what was learned of a chain, from a row: ``own`` (6,) its gain, its first place in ``motion`` and the
    speed of the drift, ``value`` (6,) its other parameters.
    """
    new = np.empty(BAND_PARAMETERS)
    new[0] = own[0]
    new[1:] = value
    change_motion(x, P, motion, int(own[1]), new, offsets, trail)
    motion[DRIFT_SPEED] = own[2]


def no_steps() -> tuple[Array, Array]:
    """Return room for what chains do over a step, with nothing in it: keys (61, 22), values (61, 2, 3, 6, 6).

    Steps come again, since the inertial sample's period hardly varies and late events are propagated to anew; a key is
    dt and the motion's parameters, a value the transitions and the noises of the three chains.
    """
    chains = len(CHAINS)
    keys = np.zeros((STEPS_KEPT, 1 + DRIFT_SPEED))
    return keys, np.zeros((STEPS_KEPT, 2, chains, BAND_SIZE, BAND_SIZE))


def kept_step(dt: float, motion: Array, keys: Array, kept: Array) -> int:
    """Return the place in ``kept`` of the chains' transitions and noises over ``dt`` [s], put there if they are not."""
    k = int(dt * 1e9 + 0.5) % STEPS_KEPT
    if keys[k, 0] != dt or np.any(keys[k, 1:] != motion[:DRIFT_SPEED]):
        keys[k, 0] = dt
        keys[k, 1:] = motion[:DRIFT_SPEED]
        for c in range(len(CHAINS)):
            transition, noise = discrete_band(motion[CHAINS[c] : CHAINS[c] + BAND_PARAMETERS], dt)
            kept[k, 0, c] = transition
            kept[k, 1, c] = noise
    return k


def deck_transition(
    x: Array, y: Array, dt: float, p: Array, motion: Array, keys: Array, kept: Array, offsets: Offsets, F: Array,
    Q: Array,
) -> None:  # fmt: skip
    """Propagate the platform's blocks from ``x`` into ``y`` over ``dt`` [s]; fill their places in F and Q.

    ``keys`` and ``kept`` are those of ``no_steps``, and change.
    """
    # The drift's velocity is a first-order Gauss-Markov process; how far its noise takes the place is a series in dt.
    time = DRIFT_TIME_S
    remains = math.exp(-dt / time)
    carries = time * (1.0 - remains)
    variance = motion[DRIFT_SPEED] ** 2
    for i in range(2):
        o, d = offsets[PLATFORM_OFFSET] + i, offsets[PLATFORM_DRIFT] + i
        F[o, d] = carries
        F[d, d] = remains
        Q[o, o] = p[par.OFFSET_WALK] ** 2 * dt + variance * dt**3 / time * (2.0 / 3.0 - 0.5 * dt / time)
        Q[o, d] = variance * carries**2 / time
        Q[d, o] = Q[o, d]
        Q[d, d] = variance * (1.0 - remains**2)
        y[PO0 + i] = x[PO0 + i] + carries * x[PD0 + i]
        y[PD0 + i] = remains * x[PD0 + i]
    level = offsets[PLATFORM_LEVEL]
    Q[level, level] = p[par.LEVEL_WALK] ** 2 * dt
    k = kept_step(dt, motion, keys, kept)
    for c in range(len(CHAINS)):
        at, start = places(CHAINS[c], offsets)
        end, place_end = start + BAND_SIZE, at + BAND_SIZE
        F[start:end, start:end] = kept[k, 0, c]
        Q[start:end, start:end] = kept[k, 1, c]
        y[at:place_end] = product(kept[k, 0, c], x[at:place_end])
    latency = offsets[CAMERA_LATENCY]
    Q[latency, latency] = p[par.LATENCY_WALK] ** 2 * dt


def vision(
    value: Array, own: Array, x: Array, gyro: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array
) -> int:
    """The target in the camera: P^c = (1 + s) R_cb exp(m)' (R_nb' (P_platform - P) - l), mount error m, scale s.

    By age it changes as R_cm (R_nb' v - [b]x w), b being the target in the body: the vehicle was elsewhere and turned
    otherwise. The platform's own part cannot be told from its motion, whose phase is free, and would drive the age
    away over a swaying raft.
    """
    if offsets[PLATFORM_OFFSET] < 0:
        return -9
    R_cb = p[par.VISION_MOUNT : par.VISION_MOUNT + 9].copy().reshape(3, 3)
    R_cm = body_to_camera(x, p)
    b = target_in_body(x)
    seen = b - p[par.VISION_LEVER : par.VISION_LEVER + 3]
    c = rotate(R_cm, seen)
    scale = 1.0 + x[RS0]
    D = compose(R_cm, quat_to_matrix(x[Q0 : Q0 + 4]).T.copy())
    T = compose(R_cm, skew(b))
    M = compose(R_cb, skew(seen))
    aging = rotate(D, x[V0 : V0 + 3]) - rotate(T, gyro)
    for i in range(3):
        r[i] = value[i] - scale * c[i] - aging[i] * x[CL0]
        for j in range(3):
            H[i, offsets[POSITION] + j] = -scale * D[i, j]
            H[i, offsets[ATTITUDE] + j] = scale * T[i, j]
            H[i, offsets[CAMERA_MOUNT] + j] = scale * M[i, j]
        for axis in range(2):
            H[i, offsets[PLATFORM_OFFSET] + axis] = scale * D[i, axis]
            H[i, offsets[PLATFORM_SWAY] + 6 * axis + 5] = scale * D[i, axis]
        H[i, offsets[PLATFORM_LEVEL]] = -scale * D[i, 2]
        H[i, offsets[PLATFORM_HEAVE] + 5] = -scale * D[i, 2]
        H[i, offsets[RANGE_SCALE]] = c[i]
        H[i, offsets[CAMERA_LATENCY]] = aging[i]
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


def body_to_camera(x: Array, p: Array) -> Array:
    """Return the rotation R_cm (3, 3) of the body to the camera with its mounting as estimated."""
    R_cb = p[par.VISION_MOUNT : par.VISION_MOUNT + 9].copy().reshape(3, 3)
    return compose(R_cb, quat_to_matrix(quat_exp(x[CM0 : CM0 + 3])).T.copy())


def target_in_body(x: Array) -> Array:
    """Return the platform's place relative to the IMU (3,) [m], in the body."""
    d = np.empty(3)
    d[0] = x[PO0] + x[PS0 + 5] - x[P0]
    d[1] = x[PO0 + 1] + x[PS0 + 11] - x[P0 + 1]
    d[2] = -x[PL0] - x[PH0 + 5] - x[P0 + 2]
    return rotate(quat_to_matrix(x[Q0 : Q0 + 4]).T.copy(), d)


def camera_to_ned(x: Array, p: Array) -> Array:
    """Return the rotation (3, 3) of the camera, with its mounting as estimated, to NED."""
    return compose(quat_to_matrix(x[Q0 : Q0 + 4]), body_to_camera(x, p).T.copy())


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
            seen[2 * axis] = x[PO0 + row] + x[PS0 + 6 * row + 5] + shift
        seen[2 * axis + 1] = variance


def deck_output(x: Array, motion: Array, offsets: Offsets, n: int) -> tuple[Array, Array]:
    """Return what is reported of the platform, (8,), and its Jacobian by the error state, (8, n).

    Relative position P_uav - P_platform [m] and velocity [m/s] in NED, the deck's height [m] and its rate [m/s] up.
    """
    y = np.zeros(OUTPUT_SIZE)
    A = np.zeros((OUTPUT_SIZE, n))
    for axis in range(3):
        # A platform that goes up comes nearer: P is positive down, heave positive up.
        y[axis], y[3 + axis] = x[P0 + axis], x[V0 + axis]
        A[axis, offsets[POSITION] + axis] = 1.0
        A[3 + axis, offsets[VELOCITY] + axis] = 1.0
        chain = (SWAY_NORTH, SWAY_EAST, HEAVE)[axis]
        sign = 1.0 if chain == HEAVE else -1.0
        at, start = places(chain, offsets)
        rate = band_matrix(motion[chain : chain + BAND_PARAMETERS])[5]
        y[axis] += sign * x[at + 5]
        A[axis, start + 5] = sign
        for k in range(BAND_SIZE):
            y[3 + axis] += sign * rate[k] * x[at + k]
            A[3 + axis, start + k] = sign * rate[k]
            if chain == HEAVE:
                y[7] += rate[k] * x[at + k]
                A[7, start + k] = rate[k]
    for axis in range(2):
        y[axis] -= x[PO0 + axis]
        y[3 + axis] -= x[PD0 + axis]
        A[axis, offsets[PLATFORM_OFFSET] + axis] = -1.0
        A[3 + axis, offsets[PLATFORM_DRIFT] + axis] = -1.0
    y[2] += x[PL0]
    y[6] = x[PL0] + x[PH0 + 5]
    for row in (2, 6):
        A[row, offsets[PLATFORM_LEVEL]] = 1.0
    A[6, offsets[PLATFORM_HEAVE] + 5] = 1.0
    return y, A

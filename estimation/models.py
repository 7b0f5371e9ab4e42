"""Process and measurement models, as plain functions of arrays that numba compiles as they stand.

Strapdown mechanisation with a local (body-frame) attitude error; every Jacobian is the derivative of the discrete
map that is really applied (docs/concepts.md, "Strapdown"), so that finite differences confirm it.
"""

from __future__ import annotations

import math

import numpy as np

from estimation import parameters as par
from estimation.deck import deck_transition, vision
from estimation.frames import (
    Array,
    compose,
    geodetic_to_ned,
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalise,
    quat_to_matrix,
    rotate,
    skew,
)
from estimation.state import (
    ACCEL_BIAS,
    ATTITUDE,
    BA0,
    BARO_BIAS,
    BB0,
    BG0,
    BP0,
    GPS_BIAS,
    GYRO_BIAS,
    P0,
    PLATFORM_OFFSET,
    POSITION,
    Q0,
    V0,
    VELOCITY,
    Offsets,
)

GPS_POSITION, GPS_VELOCITY, BAROMETER, MAGNETOMETER, ATTITUDE_FIX, RANGE, VISION = 2, 3, 4, 5, 6, 7, 8
"""Kinds of measurement, equal to ``estimation.events.Kind``."""

UNUSABLE_COVARIANCE = -5
UNUSABLE_NOW = -9
"""Returned instead of a dimension: minus the ``Outcome`` of a measurement that cannot be used."""


def right_jacobian(v: Array) -> Array:
    """Return J_r(v) with ``exp(v + d) = exp(v) exp(J_r(v) d)`` to first order; shape (3, 3) (Sola, 2017, eq. 183)."""
    x, y, z = v[0], v[1], v[2]
    angle2 = x * x + y * y + z * z
    if angle2 < 1e-6:
        a = 0.5 - angle2 / 24.0
        b = 1.0 / 6.0 - angle2 / 120.0
    else:
        angle = math.sqrt(angle2)
        a = (1.0 - math.cos(angle)) / angle2
        b = (angle - math.sin(angle)) / (angle2 * angle)
    # I - a [v]x + b [v]x^2, and [v]x squared is v v' - |v|^2 I.
    rest = 1.0 - b * angle2
    J = np.empty((3, 3))
    J[0, 0], J[0, 1], J[0, 2] = b * x * x + rest, b * x * y + a * z, b * x * z - a * y
    J[1, 0], J[1, 1], J[1, 2] = b * y * x - a * z, b * y * y + rest, b * y * z + a * x
    J[2, 0], J[2, 1], J[2, 2] = b * z * x + a * y, b * z * y - a * x, b * z * z + rest
    return J


def inverse_right_jacobian(v: Array) -> Array:
    """Return the inverse of J_r(v), for |v| < pi; shape (3, 3) (Sola, 2017, eq. 184)."""
    angle2 = v[0] * v[0] + v[1] * v[1] + v[2] * v[2]
    if angle2 < 1e-6:
        b = 1.0 / 12.0 + angle2 / 720.0
    else:
        angle = math.sqrt(angle2)
        b = 1.0 / angle2 - (1.0 + math.cos(angle)) / (2.0 * angle * math.sin(angle))
    J: Array = skew(v) * 0.5
    for i in range(3):
        for j in range(3):
            J[i, j] += b * v[i] * v[j]
        J[i, i] += 1.0 - b * angle2
    return J


def put(target: Array, row: int, column: int, scale: float, block: Array) -> None:
    """Write ``scale * block``, block (3, 3), into ``target`` at a row and column."""
    target[row : row + 3, column : column + 3] = scale * block


def transition(
    x: Array,
    gyro: Array,
    accel: Array,
    dt: float,
    scatter: Array,
    p: Array,
    offsets: Offsets,
    F: Array,
    Q: Array,
    motion: Array,
    keys: Array,
    kept: Array,
) -> Array:
    """Propagate the nominal state over ``dt`` [s]; write the error state's transition into F and noise into Q.

    ``gyro`` [rad/s] and ``accel`` [m/s^2] are the raw mean over the interval; ``scatter`` holds the additional white
    noise densities squared of accelerometer [(m/s^2)^2/Hz] and gyro [(rad/s)^2/Hz]; ``motion`` are the deck's
    parameters (22,) (``estimation.deck``), read where its blocks are on; ``keys`` and ``kept`` remember what they do
    over a step (``estimation.deck.no_steps``). F and Q, (n, n), are written whole. Returns
    the new nominal state. Strapdown in the local tangent plane; the Earth's rate is left to the gyro bias
    (docs/limits.md).
    """
    pos, vel, att = offsets[POSITION], offsets[VELOCITY], offsets[ATTITUDE]
    bg, ba = offsets[GYRO_BIAS], offsets[ACCEL_BIAS]
    w = gyro - x[BG0 : BG0 + 3]
    f = accel - x[BA0 : BA0 + 3]
    q = x[Q0 : Q0 + 4]
    half = quat_exp(0.5 * dt * w)
    q_mid = quat_multiply(q, half)
    R_mid = quat_to_matrix(q_mid)
    R_half = quat_to_matrix(half)
    a = rotate(R_mid, f)
    a[2] += p[par.GRAVITY]
    y = x.copy()
    for i in range(3):
        y[P0 + i] += x[V0 + i] * dt + 0.5 * a[i] * dt * dt
        y[V0 + i] += a[i] * dt
    y[Q0 : Q0 + 4] = quat_normalise(quat_multiply(q_mid, half))

    F[:, :] = 0.0
    Q[:, :] = 0.0
    np.fill_diagonal(F, 1.0)
    A = compose(R_mid, skew(f))
    tilted = compose(A, R_half.T.copy())
    turned = compose(A, right_jacobian(0.5 * dt * w))
    put(F, vel, att, -dt, tilted)
    put(F, vel, bg, 0.5 * dt * dt, turned)
    put(F, vel, ba, -dt, R_mid)
    put(F, pos, att, -0.5 * dt * dt, tilted)
    put(F, pos, bg, 0.25 * dt * dt * dt, turned)
    put(F, pos, ba, -0.5 * dt * dt, R_mid)
    put(F, att, att, 1.0, compose(R_half, R_half).T.copy())
    put(F, att, bg, -dt, right_jacobian(dt * w))
    qa = p[par.ACCEL_NOISE] ** 2 + scatter[0]
    qg = p[par.GYRO_NOISE] ** 2 + scatter[1]
    place, both, speed, turn = qa * dt**3 / 3.0, qa * dt**2 / 2.0, qa * dt, qg * dt
    walk_g, walk_a = p[par.GYRO_BIAS_WALK] ** 2 * dt, p[par.ACCEL_BIAS_WALK] ** 2 * dt
    for i in range(3):
        F[pos + i, vel + i] = dt
        Q[pos + i, pos + i] = place
        Q[pos + i, vel + i] = both
        Q[vel + i, pos + i] = both
        Q[vel + i, vel + i] = speed
        Q[att + i, att + i] = turn
        Q[bg + i, bg + i] = walk_g
        Q[ba + i, ba + i] = walk_a
    if offsets[GPS_BIAS] >= 0:
        # First-order Gauss-Markov, exact for any dt; that of the height has no mean to come back to: how it wanders
        # says nothing of how far it is off.
        b = offsets[GPS_BIAS]
        decay = math.exp(-dt / p[par.GPS_BIAS_TIME])
        for i in range(2):
            y[BP0 + i] *= decay
            F[b + i, b + i] = decay
            Q[b + i, b + i] = p[par.GPS_BIAS_H] ** 2 * (1.0 - decay * decay)
        Q[b + 2, b + 2] = p[par.GPS_BIAS_WALK_V] ** 2 * dt
    if offsets[BARO_BIAS] >= 0:
        b = offsets[BARO_BIAS]
        Q[b, b] = p[par.BARO_BIAS_WALK] ** 2 * dt
    if offsets[PLATFORM_OFFSET] >= 0:
        deck_transition(x, y, dt, p, motion, keys, kept, offsets, F, Q)
    return y


def pressure_altitude(pressure_pa: float) -> float:
    """Return the altitude [m] of a pressure [Pa] in the International Standard Atmosphere (troposphere)."""
    return 44330.769 * (1.0 - math.pow(pressure_pa / 101325.0, 0.190263))


def measure(
    kind: int,
    value: Array,
    own: Array,
    x: Array,
    gyro: Array,
    p: Array,
    offsets: Offsets,
    r: Array,
    H: Array,
    R: Array,
) -> int:
    """Write a measurement's innovation r (3,), Jacobian H (3, n) and covariance R (3, 3); return its dimension.

    ``value`` and ``own`` are an event's ``value`` and ``covariance`` (``estimation.events.EVENT_DTYPE``), ``gyro``
    the raw angular velocity [rad/s] at that time. Only the first ``dimension`` rows are meaningful. A negative
    result is minus the ``Outcome`` of a measurement that cannot be used. ``r`` is measured minus predicted and
    H the derivative of the prediction by the error state.
    """
    H[:, :] = 0.0
    R[:, :] = 0.0
    if kind == GPS_POSITION:
        return gps_position(value, own, x, p, offsets, r, H, R)
    if kind == GPS_VELOCITY:
        return gps_velocity(value, own, x, gyro, p, offsets, r, H, R)
    if kind == BAROMETER:
        return barometer(value, x, p, offsets, r, H, R)
    if kind == MAGNETOMETER:
        return magnetometer(value, x, p, offsets, r, H, R)
    if kind == ATTITUDE_FIX:
        return attitude(value, x, p, offsets, r, H, R)
    if kind == RANGE:
        return rangefinder(value, x, p, offsets, r, H, R)
    if kind == VISION:
        return vision(value, own, x, gyro - x[BG0 : BG0 + 3], p, offsets, r, H, R)
    return UNUSABLE_NOW


def gps_variance(own: float, floor: float, white_fraction: float) -> float:
    """Return the white variance of a receiver's statement: its white share, but not below the floor squared."""
    stated = own * white_fraction * white_fraction
    return stated if stated > floor * floor else floor * floor  # NaN compares false: the floor


def gps_position(
    value: Array, own: Array, x: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array
) -> int:
    """Antenna position in NED: P + R_nb l + GPS bias; an RTK fix that says it is exact has no bias."""
    if not value[3] >= 1.0:
        return UNUSABLE_NOW
    limit = p[par.GPS_MAX_ACCURACY] ** 2
    if own[0] > limit or own[3] > limit:
        return UNUSABLE_COVARIANCE
    lever = p[par.GPS_LEVER : par.GPS_LEVER + 3]
    R_nb = quat_to_matrix(x[Q0 : Q0 + 4])
    z = geodetic_to_ned(value[0], value[1], value[2], p[par.ORIGIN : par.ORIGIN + 3])
    arm = rotate(R_nb, lever)
    exact = p[par.GPS_RTK_ACCURACY]
    precise = value[3] >= 2.0 and own[0] <= exact * exact and own[3] <= exact * exact
    biased = offsets[GPS_BIAS] >= 0 and not precise
    fraction = p[par.GPS_WHITE_FRACTION] if biased else 1.0
    for i in range(3):
        r[i] = z[i] - x[P0 + i] - arm[i]
        H[i, offsets[POSITION] + i] = 1.0
        if biased:
            r[i] -= x[BP0 + i]
            H[i, offsets[GPS_BIAS] + i] = 1.0
    put(H, 0, offsets[ATTITUDE], -1.0, compose(R_nb, skew(lever)))
    across = 0.3 * exact if precise else p[par.GPS_SIGMA_H]
    up = 0.5 * exact if precise else p[par.GPS_SIGMA_V]
    R[0, 0] = gps_variance(own[0], across, fraction)
    R[1, 1] = gps_variance(own[3], across, fraction)
    R[2, 2] = gps_variance(own[5], up, fraction)
    return 3


def gps_velocity(
    value: Array, own: Array, x: Array, gyro: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array
) -> int:
    """Antenna velocity in NED: V + R_nb (w x l). Without a vertical velocity (NaN) the two others are used."""
    if not value[3] >= 1.0:
        return UNUSABLE_NOW
    lever = p[par.GPS_LEVER : par.GPS_LEVER + 3]
    R_nb = quat_to_matrix(x[Q0 : Q0 + 4])
    swing = rotate(skew(gyro - x[BG0 : BG0 + 3]), lever)
    arm = rotate(R_nb, swing)
    dimension = 3 if value[2] == value[2] else 2
    for i in range(dimension):
        r[i] = value[i] - x[V0 + i] - arm[i]
        H[i, offsets[VELOCITY] + i] = 1.0
    att, bg = offsets[ATTITUDE], offsets[GYRO_BIAS]
    put(H, 0, att, -1.0, compose(R_nb, skew(swing)))
    put(H, 0, bg, 1.0, compose(R_nb, skew(lever)))
    R[0, 0] = gps_variance(own[0], p[par.GPS_SIGMA_VH], 1.0)
    R[1, 1] = gps_variance(own[3], p[par.GPS_SIGMA_VH], 1.0)
    R[2, 2] = gps_variance(own[5], p[par.GPS_SIGMA_VV], 1.0)
    return dimension


def barometer(value: Array, x: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array) -> int:
    """Pressure altitude above the origin's altitude: -P_down + offset."""
    if p[par.BARO_USE] == 0.0 or not value[0] > 0.0:
        return UNUSABLE_NOW
    r[0] = pressure_altitude(value[0]) - p[par.ORIGIN + 2] + x[P0 + 2] - x[BB0]
    H[0, offsets[POSITION] + 2] = -1.0
    H[0, offsets[BARO_BIAS]] = 1.0
    R[0, 0] = p[par.BARO_SIGMA] ** 2
    return 1


def magnetometer(value: Array, x: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array) -> int:
    """Direction of the horizontal field, which is the declination: atan2(east, north) of R_nb m."""
    if p[par.MAG_USE] == 0.0:
        return UNUSABLE_NOW
    R_nb = quat_to_matrix(x[Q0 : Q0 + 4])
    m = rotate(R_nb, value[0:3])
    horizontal = m[0] * m[0] + m[1] * m[1]
    if not horizontal > 0.01 * (horizontal + m[2] * m[2]):
        return UNUSABLE_NOW  # within 6 deg of the magnetic pole's vertical: no heading in it
    angle = p[par.DECLINATION] - math.atan2(m[1], m[0])
    r[0] = (angle + math.pi) % (2.0 * math.pi) - math.pi
    # At the predicted field, whose horizontal part lies along the declination, and not at the measured one: there the
    # heading's noise would reach the tilt through the field's dip, always to the same side.
    dip = m[2] / math.sqrt(horizontal)
    north, east = -dip * math.cos(p[par.DECLINATION]), -dip * math.sin(p[par.DECLINATION])
    att = offsets[ATTITUDE]
    for j in range(3):
        H[0, att + j] = north * R_nb[0, j] + east * R_nb[1, j] + R_nb[2, j]
    R[0, 0] = p[par.MAG_SIGMA] ** 2
    return 1


def attitude(value: Array, x: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array) -> int:
    """Another estimator's attitude, as the rotation vector from ours to it in the body frame."""
    if p[par.ATTITUDE_USE] == 0.0:
        return UNUSABLE_NOW
    norm = math.sqrt(value[0] ** 2 + value[1] ** 2 + value[2] ** 2 + value[3] ** 2)
    if not abs(norm - 1.0) < 0.1:
        return UNUSABLE_NOW
    # d log(exp(-d) exp(r)) / d d = -J_l^-1(r), and J_l(r) = J_r(-r).
    r[:] = quat_log(quat_multiply(quat_conjugate(x[Q0 : Q0 + 4]), value[0:4] / norm))
    put(H, 0, offsets[ATTITUDE], 1.0, inverse_right_jacobian(-r))
    R_nb = quat_to_matrix(x[Q0 : Q0 + 4])
    S = np.zeros((3, 3))
    S[0, 0] = p[par.ATTITUDE_TILT] ** 2
    S[1, 1] = S[0, 0]
    S[2, 2] = p[par.ATTITUDE_YAW] ** 2
    put(R, 0, 0, 1.0, compose(R_nb.T.copy(), compose(S, R_nb)))
    return 3


def rangefinder(value: Array, x: Array, p: Array, offsets: Offsets, r: Array, H: Array, R: Array) -> int:
    """Range along the body's down axis to a level surface: height over it divided by the cosine of the tilt."""
    if p[par.RANGE_USE] == 0.0 or not value[0] > 0.0 or value[0] < value[1] or value[0] > value[2]:
        return UNUSABLE_NOW
    R_nb = quat_to_matrix(x[Q0 : Q0 + 4])
    cosine = R_nb[2, 2]
    if cosine < 0.5:
        return UNUSABLE_NOW
    lever = p[par.RANGE_LEVER : par.RANGE_LEVER + 3]
    height = -x[P0 + 2] - p[par.SURFACE_HEIGHT] - rotate(R_nb, lever)[2]
    predicted = height / cosine
    r[0] = value[0] - predicted
    H[0, offsets[POSITION] + 2] = -1.0 / cosine
    tilt = compose(R_nb, skew(np.array([0.0, 0.0, 1.0])))[2]
    arm = compose(R_nb, skew(lever))[2]
    for j in range(3):
        H[0, offsets[ATTITUDE] + j] = arm[j] / cosine + predicted / cosine * tilt[j]
    R[0, 0] = p[par.RANGE_SIGMA] ** 2 + (p[par.RANGE_SIGMA_PER_M] * value[0]) ** 2
    return 1

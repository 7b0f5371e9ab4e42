"""What both engines do around the filter's algebra: interpolating the IMU, gating, lock-out and its recovery.

Plain functions of arrays that numba compiles as they stand.
"""

from __future__ import annotations

import math

import numpy as np

from estimation import parameters as par
from estimation.frames import Array
from estimation.models import BAROMETER, GPS_POSITION, GPS_VELOCITY, VISION
from estimation.state import (
    BARO_BIAS,
    BB0,
    CAMERA_LATENCY,
    CAMERA_MOUNT,
    CL0,
    GPS_BIAS,
    P0,
    PLATFORM_LEVEL,
    PLATFORM_OFFSET,
    POSITION,
    V0,
    VELOCITY,
    Offsets,
)

MAX_STEP_S = 0.025
"""Longest step of the strapdown integration [s]; longer intervals are cut."""
LONG_STEP_S = 0.05
"""An interval between inertial samples beyond this [s] is a gap: its unknown motion is added as noise."""
GAP_ACCEL = 1.5
"""Unknown specific force in a gap, taken as constant over it [m/s^2], 1-sigma."""
GAP_ATTITUDE = 0.15
"""Unknown rotation in a gap [rad/rts], 1-sigma: a hovering multirotor stays near level and holds its heading."""
SCATTER_TIME_S = 1.0
"""Averaging time of the vibration measure [s]."""
ROTATION_TIME_S = 5.0
"""Averaging time of the rotation that decides whether a camera's age can be learned [s]."""
MIN_LATENCY_S, MAX_LATENCY_S = -0.03, 0.15
"""A camera's age stays between these [s]. No content is newer than its stamp, but the age takes up what the map of the
clocks errs by, too: up to half the round trip of its exchanges, where one way takes longer than the other."""
RESET_COUNT = 5
"""Rejected measurements that must agree before a reset."""

RELOCATION_M = 30.0
"""How far a platform may have moved when vision contradicts the filter, but not itself, for long [m]."""
MEMORY_SIZE = 9
"""Entries per sensor of what is remembered of it: rejected in a row, first and last time of these [s], last rejected
innovation (3); time [s] and innovation of the last reading, variance of its white noise (``reading_noise``)."""
NOISE_TIME_S = 5.0
"""Averaging time of a sensor's own white noise."""


def interpolate(imu0: Array, t0: int, imu1: Array, t1: int, t: float) -> Array:
    """Return the inertial sample (6,) at ``t`` [ns] on the line from (t0, imu0) to (t1, imu1)."""
    if t1 <= t0:
        return imu1.copy()
    return imu0 + (imu1 - imu0) * ((t - t0) / (t1 - t0))


def scatter_update(scatter: Array, imu0: Array, imu1: Array, dt: float) -> None:
    """Update in place the vibration measure: mean variance of white noise that explains the sample differences.

    ``scatter`` is (accelerometer, gyro) [(m/s^2)^2, (rad/s)^2] per axis; half the mean squared difference of
    neighbouring samples, averaged over ``SCATTER_TIME_S``; and the mean squared rotation over ``ROTATION_TIME_S``.
    """
    alpha = 1.0 - math.exp(-dt / SCATTER_TIME_S)
    gyro = 0.0
    accel = 0.0
    for i in range(3):
        gyro += (imu1[i] - imu0[i]) ** 2
        accel += (imu1[3 + i] - imu0[3 + i]) ** 2
    scatter[0] += alpha * (accel / 6.0 - scatter[0])
    scatter[1] += alpha * (gyro / 6.0 - scatter[1])
    rate = imu1[0] ** 2 + imu1[1] ** 2 + imu1[2] ** 2
    scatter[2] += (1.0 - math.exp(-dt / ROTATION_TIME_S)) * (rate - scatter[2])


def extra_noise(scatter: Array, dt_imu: float, p: Array) -> Array:
    """Return the noise densities squared (accelerometer, gyro) to add for vibration and for gaps.

    A scatter of variance s^2 in samples dt apart, taken as white, has the density s^2 dt.
    """
    extra = np.empty(2)
    extra[0] = p[par.VIBRATION_GAIN] * scatter[0] * dt_imu
    extra[1] = p[par.VIBRATION_GAIN] * scatter[1] * dt_imu
    if dt_imu > LONG_STEP_S:
        extra[0] += GAP_ACCEL**2 * dt_imu
        extra[1] += GAP_ATTITUDE**2
    return extra


def reading_noise(memory: Array, t_s: float, innovation: float, variance: float) -> float:
    """Return the white variance of a scalar sensor: the configured one, or what its readings show where that is more.

    Half the mean squared difference of neighbouring innovations, each held to three sigma so that a jump does not
    count as noise; remembered in the sensor's own ``memory``. A barometer in propeller wash is several times noisier
    than on the bench.
    """
    shown = max(memory[8], variance)
    dt = t_s - memory[6]
    if memory[8] > 0.0 and 0.0 < dt < 1.0:
        difference = 0.5 * (innovation - memory[7]) ** 2
        memory[8] += (1.0 - math.exp(-dt / NOISE_TIME_S)) * (min(difference, 9.0 * shown) - memory[8])
    elif memory[8] == 0.0:
        memory[8] = variance
    memory[6] = t_s
    memory[7] = innovation
    return float(max(memory[8], variance))


def weight(nis: float, dimension: int, p: Array) -> float:
    """Return 1 for a likely innovation, less (Huber) for an unlikely one, 0 outside the gate.

    The covariance is divided by the weight.
    """
    if not nis <= p[par.GATE_1 + dimension - 1]:
        return 0.0
    bound = p[par.HUBER_1 + dimension - 1]
    return 1.0 if nis <= bound else math.sqrt(bound / nis)


def considered(learn: bool, offsets: Offsets) -> tuple[int, int]:
    """Return the first and last-but-one place of the states that a measurement may not move (Schmidt's filter).

    The camera's mounting always, and its age but for fixes that tell it (``learn``). They lie side by side.
    """
    if offsets[CAMERA_MOUNT] < 0:
        return 0, 0
    start = offsets[CAMERA_MOUNT] if learn else offsets[CAMERA_LATENCY]
    return start, offsets[CAMERA_MOUNT] + 3


def hold_latency(x: Array, p: Array) -> None:
    """Keep the camera's age, calibrated plus learned, within its box; in place."""
    x[CL0] = min(max(x[CL0], MIN_LATENCY_S - p[par.LATENCY]), MAX_LATENCY_S - p[par.LATENCY])


def locked_out(memory: Array, kind: int, t_s: float, r: Array, R: Array, dimension: int, p: Array) -> bool:
    """Note a rejection; return True when the sensor has contradicted the filter, but not itself, for too long.

    ``memory`` is the sensor's own. Only sensors that carry a datum (GPS, barometer, vision) can ever be right against
    the filter; no number of rejections lets any other sensor in. Readings agree when they differ, beyond their own
    noise ``R`` (4 sigma), by no more than the sensor's tolerance.
    """
    if kind == GPS_POSITION:
        tolerance = 5.0
    elif kind in (GPS_VELOCITY, BAROMETER, VISION):
        tolerance = 2.0
    else:
        return False
    change = 0.0
    noise = 0.0
    for i in range(dimension):
        change += (r[i] - memory[3 + i]) ** 2
        noise += 2.0 * R[i, i]
    if memory[0] == 0.0 or math.sqrt(change) > tolerance + 4.0 * math.sqrt(noise) + 2.0 * (t_s - memory[2]):
        memory[0] = 0.0
        memory[1] = t_s
    memory[0] += 1.0
    memory[2] = t_s
    for i in range(dimension):
        memory[3 + i] = r[i]
    return bool(memory[0] >= RESET_COUNT and t_s - memory[1] >= p[par.GPS_RESET_AFTER])


def reset_datum(kind: int, x: Array, P: Array, r: Array, R: Array, dimension: int, offsets: Offsets) -> None:
    """Move the state's datum onto a sensor that was locked out, in place, and forget what hung on the old one.

    Position (velocity, barometer offset) takes the innovation; its correlations with all else are cut, so that
    attitude and biases keep what they know.
    """
    if kind == VISION:
        # The platform is not where it was thought to be: its place is open again, the vehicle's is not touched.
        for i in range(2):
            P[offsets[PLATFORM_OFFSET] + i, offsets[PLATFORM_OFFSET] + i] += RELOCATION_M**2
        P[offsets[PLATFORM_LEVEL], offsets[PLATFORM_LEVEL]] += RELOCATION_M**2
        return
    if kind == GPS_POSITION:
        block, place = offsets[POSITION], P0
    elif kind == GPS_VELOCITY:
        block, place = offsets[VELOCITY], V0
    else:
        block, place = offsets[BARO_BIAS], BB0
    for i in range(dimension):
        x[place + i] += r[i]
        P[block + i, :] = 0.0
        P[:, block + i] = 0.0
    # The state is now what the sensor says less what else is in its reading: position = fix - GPS bias, offset of
    # the barometer = reading + position down. It hangs together with that as the reading does, and on its noise.
    other, sign = -1, 0.0
    if kind == GPS_POSITION:
        other, sign = offsets[GPS_BIAS], -1.0
    elif kind == BAROMETER:
        other, sign = offsets[POSITION] + 2, 1.0
    if other >= 0:
        for i in range(dimension):
            for c in range(P.shape[0]):
                P[block + i, c] = sign * P[other + i, c]
        for i in range(dimension):
            for c in range(P.shape[0]):
                P[c, block + i] = P[block + i, c]
        for i in range(dimension):
            for j in range(dimension):
                P[block + i, block + j] = P[other + i, other + j]
    for i in range(dimension):
        P[block + i, block + i] += R[i, i]


def reset_transition(kind: int, dimension: int, offsets: Offsets, n: int) -> Array:
    """Return T (n, n) of ``reset_datum`` seen as a transition of the error state: it leaves T P T' and new noise.

    What it cuts has no column in T: nothing that is learned after the reset tells of it before.
    """
    T = np.eye(n)
    if kind == VISION:
        return T
    if kind == GPS_POSITION:
        block, other, sign = offsets[POSITION], offsets[GPS_BIAS], -1.0
    elif kind == GPS_VELOCITY:
        block, other, sign = offsets[VELOCITY], -1, 0.0
    else:
        block, other, sign = offsets[BARO_BIAS], offsets[POSITION] + 2, 1.0
    for i in range(dimension):
        T[block + i, block + i] = 0.0
        if other >= 0:
            T[block + i, other + i] = sign
    return T

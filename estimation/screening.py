"""Screening: which measurements are malformed in themselves, before anything is compared with them."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from estimation.events import Kind
from estimation.outcome import Outcome
from estimation.rows import PENDING, Int, Rows

MAX_RATE_RADPS = 100.0
MAX_FORCE_MPS2 = 1000.0
"""No inertial sensor of a multirotor reads beyond these: such a sample is rejected as outside the gate."""

NEEDED = (6, 0, 3, 2, 1, 3, 4, 1, 3, 1)
"""How many of its values a measurement of each kind must have."""

MEASURED_3D = (Kind.GPS_POSITION, Kind.GPS_VELOCITY, Kind.VISION)


def malformed(rows: Rows) -> Int:
    """Return for each row the outcome of a measurement that is malformed in itself, or ``PENDING``."""
    outcome = np.full(len(rows), PENDING, dtype=np.int64)
    needed = np.array(NEEDED)[rows.kind]
    used = np.arange(6) < needed[:, None]
    imu = rows.kind == Kind.IMU
    with np.errstate(invalid="ignore"):
        beyond = (np.abs(rows.value[:, :3]) > MAX_RATE_RADPS) | (np.abs(rows.value[:, 3:]) > MAX_FORCE_MPS2)
    outcome[imu & beyond.any(axis=1)] = Outcome.REJECTED_GATE
    outcome[(used & ~np.isfinite(rows.value)).any(axis=1)] = Outcome.REJECTED_NOT_FINITE
    c = rows.own
    stated = ~np.isnan(c).all(axis=1) & np.isin(rows.kind, MEASURED_3D)
    if stated.any():
        a, b, d, e, f, g = c.T
        with np.errstate(all="ignore"):
            minor = a * e - b * b
            det = a * (e * g - f * f) - b * (b * g - f * d) + d * (b * f - e * d)
            positive = (a > 0) & (minor > 0) & (det > 0)
        # A receiver without a vertical velocity states no variance for it.
        planar = (rows.kind == Kind.GPS_VELOCITY) & np.isnan(g) & (a > 0) & (e > 0)
        outcome[stated & ~positive & ~planar & (outcome == PENDING)] = Outcome.REJECTED_COVARIANCE
    return outcome


def malformed_one(kind: int, value: Sequence[float], own: Sequence[float]) -> int:
    """Return what ``malformed`` does for one measurement, its value and covariance given as six numbers each."""
    if not all(map(math.isfinite, value[: NEEDED[kind]])):
        return int(Outcome.REJECTED_NOT_FINITE)
    if kind == Kind.IMU:
        beyond = max(map(abs, value[:3])) > MAX_RATE_RADPS or max(map(abs, value[3:])) > MAX_FORCE_MPS2
        return int(Outcome.REJECTED_GATE) if beyond else PENDING
    if kind not in MEASURED_3D or all(map(math.isnan, own)):
        return PENDING
    a, b, d, e, f, g = own
    det = a * (e * g - f * f) - b * (b * g - f * d) + d * (b * f - e * d)
    if a > 0 and a * e - b * b > 0 and det > 0:
        return PENDING
    planar = kind == Kind.GPS_VELOCITY and math.isnan(g) and a > 0 and e > 0
    return PENDING if planar else int(Outcome.REJECTED_COVARIANCE)

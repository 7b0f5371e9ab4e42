"""First state: what an alignment has found, written as the filter's state and covariance.

Position is the GPS fix carried to the start, and wrong by what the fix was wrong; the barometer's offset is known as
well as the height it was found from. These errors are one and the same, and the covariance says so: a start that left
the correlations out would let the first fixes correct what they share.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimation.band import BAND_PARAMETERS, band_stationary
from estimation.camera_age import SCATTER_SIZE
from estimation.config import Config
from estimation.deck import CHAINS, MOTION_SIZE, places, prior_motion
from estimation.frames import Array, geodetic_to_ned, quat_to_matrix
from estimation.models import pressure_altitude
from estimation.parameters import Site
from estimation.rows import FilterState
from estimation.state import (
    ACCEL_BIAS,
    ATTITUDE,
    BARO_BIAS,
    BB0,
    BG0,
    CAMERA_LATENCY,
    CAMERA_MOUNT,
    GPS_BIAS,
    GYRO_BIAS,
    P0,
    PLATFORM_DRIFT,
    PLATFORM_LEVEL,
    PLATFORM_OFFSET,
    POSITION,
    Q0,
    RANGE_SCALE,
    V0,
    VELOCITY,
    Layout,
    nominal_zero,
)
from estimation.update import MEMORY_SIZE

DERIVED_SIGMA_MPS = 1.0
"""1-sigma of a velocity from the difference of two fixes: half an interval old, under unknown acceleration."""
UNKNOWN_PLACE_M = 1000.0
"""1-sigma of the platform's place before it is seen, where no anchor is configured [m]."""
UNKNOWN_LEVEL_M = 100.0
"""1-sigma of the platform's height before it is seen [m]."""
UNKNOWN_PRESSURE_M = 100.0
"""1-sigma of the barometer's offset where it has not read yet [m]."""


@dataclass(frozen=True, slots=True)
class FirstAttitude:
    """Body-to-NED quaternion, 1-sigma of its yaw [rad], whether that came from the magnetometer, and in words."""

    q: Array
    yaw_sigma: float
    magnetic: bool
    note: str


@dataclass(frozen=True, slots=True)
class Start:
    """What an alignment knows at the moment ``t_ns`` of the start."""

    t_ns: int
    attitude: FirstAttitude
    rest: bool
    velocity: Array
    """NED velocity now [m/s]; zero at rest."""
    velocity_derived: bool
    """Whether it is a difference of fixes."""
    fix: Array
    """Last GPS fix: latitude, longitude [rad], height [m]."""
    fix_covariance: Array
    """Its own NED covariance, upper triangle by rows (6,) [m^2]; NaN where the receiver gives none."""
    fix_age_s: float
    gyro_bias: Array | None
    """Gyro bias [rad/s] from a rest, now or earlier; None without one."""
    averaged_s: float
    """Length of the window of inertial samples [s]."""
    imu: Array
    """Last inertial sample: angular velocity [rad/s], specific force [m/s^2] (6,)."""
    magnetic_field: Array | None
    """Field in body axes, any unit, where the heading came from it."""
    pressure_pa: float | None
    """Last pressure [Pa]; None before a barometer has read."""


def first_state(start: Start, site: Site, config: Config, layout: Layout, sensors: int) -> FilterState:
    """Return the state to run from.

    The fix is ``fix_age_s`` old: the position is the fix carried on with the velocity, its covariance that of the fix,
    of the velocity over that age, and of the walk of the receiver's height. ``sensors`` is the number of sensors whose
    memory the state keeps.
    """
    c, g, o = config, config.gps, layout.offsets
    age = start.fix_age_s
    R = quat_to_matrix(start.attitude.q)
    x = nominal_zero()
    fixed = geodetic_to_ned(start.fix[0], start.fix[1], start.fix[2], np.array(site.origin))
    x[P0 : P0 + 3] = fixed + start.velocity * age - R @ np.array(g.lever_arm_m)
    x[V0 : V0 + 3] = start.velocity
    x[Q0 : Q0 + 4] = start.attitude.q
    if start.gyro_bias is not None:
        x[BG0 : BG0 + 3] = start.gyro_bias
    P = np.zeros((layout.size, layout.size))
    p, v, a = int(o[POSITION]), int(o[VELOCITY]), int(o[ATTITUDE])

    own = start.fix_covariance[[0, 3, 5]]
    stated = np.where(np.isfinite(own), own, 0.0)
    floor = np.array([g.position_sigma_m, g.position_sigma_m, g.height_sigma_m]) ** 2
    _put(P, p, np.diag(np.maximum(floor, stated * (g.white_fraction**2 if g.bias else 1.0))))
    speed = 4.0 * np.array([g.velocity_sigma_mps, g.velocity_sigma_mps, g.climb_sigma_mps]) ** 2
    if start.velocity_derived:
        speed += DERIVED_SIGMA_MPS**2
    _put(P, v, np.diag(speed))
    if not start.rest:
        for i in range(3):
            P[p + i, p + i] += age**2 * speed[i]
            P[p + i, v + i] = P[v + i, p + i] = age * speed[i]
    _put(P, a, _attitude_covariance(start, R, site, c))
    known = max((0.1 * c.imu.gyro_bias_sigma) ** 2, c.imu.gyro_noise**2 / start.averaged_s)
    _put(
        P, int(o[GYRO_BIAS]), np.eye(3) * (known if start.gyro_bias is not None else c.imu.gyro_bias_sigma**2)
    )
    _put(P, int(o[ACCEL_BIAS]), np.eye(3) * c.imu.accel_bias_sigma**2)
    if o[GPS_BIAS] >= 0:
        # position = fix - bias; the height's bias has walked on since the fix.
        b = int(o[GPS_BIAS])
        bias = np.array([g.bias_sigma_m, g.bias_sigma_m, g.height_bias_sigma_m]) ** 2
        _put(P, b, np.diag(bias))
        for i in range(3):
            P[p + i, p + i] += bias[i]
            P[p + i, b + i] = P[b + i, p + i] = -bias[i]
        P[b + 2, b + 2] += g.height_bias_walk**2 * age
    if o[BARO_BIAS] >= 0:
        k, d = int(o[BARO_BIAS]), p + 2
        if start.pressure_pa is not None:
            # offset = pressure altitude - height: known as well as the height is.
            x[BB0] = pressure_altitude(start.pressure_pa) - site.origin[2] + x[P0 + 2]
            P[k, :] = P[d, :]
            P[:, k] = P[:, d]
            P[k, k] = P[d, d] + c.barometer.sigma_m**2
        else:
            P[k, k] = UNKNOWN_PRESSURE_M**2
    motion = _put_platform(P, c, layout) if o[PLATFORM_OFFSET] >= 0 else np.zeros(MOTION_SIZE)
    memory = np.zeros((sensors, MEMORY_SIZE))
    clock = np.array([start.t_ns] * 3, dtype=np.int64)
    return FilterState(clock, x, P, start.imu, np.zeros(SCATTER_SIZE), memory, motion, np.zeros(6))


def _put(P: Array, start: int, covariance: Array) -> None:
    stop = start + len(covariance)
    P[start:stop, start:stop] = covariance


def _attitude_covariance(start: Start, R: Array, site: Site, config: Config) -> Array:
    """Return the attitude error's covariance (3, 3), body axes [rad^2]."""
    i = config.initialisation
    tilt = i.tilt_sigma_rad if start.rest else i.flight_tilt_sigma_rad
    errors = np.eye(3)
    if start.magnetic_field is not None:
        # A tilt error turns the field's steep part into a heading error: that of the yaw hangs on the tilt's.
        field_n = R @ start.magnetic_field
        dip = field_n[2] / max(math.hypot(field_n[0], field_n[1]), 1e-12)
        errors[2, :2] = dip * np.array([math.cos(site.declination_rad), math.sin(site.declination_rad)])
    half = R.T @ errors @ np.diag([tilt, tilt, start.attitude.yaw_sigma])
    return np.asarray(half @ half.T)


def _put_platform(P: Array, config: Config, layout: Layout) -> Array:
    """Write what is known of the platform before it is seen into P; return the parameters of its motion."""
    d, v, o = config.platform, config.vision, layout.offsets
    radius = UNKNOWN_PLACE_M if d.anchor_radius_m is None else d.anchor_radius_m
    _put(P, int(o[PLATFORM_OFFSET]), np.eye(2) * radius**2)
    _put(P, int(o[PLATFORM_DRIFT]), np.eye(2) * d.drift_sigma_mps**2)
    _put(P, int(o[PLATFORM_LEVEL]), np.eye(1) * UNKNOWN_LEVEL_M**2)
    motion = prior_motion(d)
    for chain in CHAINS:
        _, begin = places(chain, o)
        _put(P, begin, band_stationary(motion[chain : chain + BAND_PARAMETERS]))
    _put(P, int(o[RANGE_SCALE]), np.eye(1) * v.scale_sigma**2)
    _put(P, int(o[CAMERA_LATENCY]), np.eye(1) * v.latency_sigma_s**2)
    _put(P, int(o[CAMERA_MOUNT]), np.eye(3) * v.mount_sigma_rad**2)
    return motion

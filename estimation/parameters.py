"""The numbers that the models read, packed from a configuration into one float64 vector.

One vector of numbers, not an object, so that the same model functions serve plain Python and compiled code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from estimation.config import Config
from estimation.frames import R_CB_NOMINAL, Array, euler_to_quat, normal_gravity, quat_to_matrix

(
    GRAVITY,
    ORIGIN,
    _,
    _,
    ACCEL_NOISE,
    GYRO_NOISE,
    ACCEL_BIAS_WALK,
    GYRO_BIAS_WALK,
    VIBRATION_GAIN,
    GPS_LEVER,
    _,
    _,
    GPS_SIGMA_H,
    GPS_SIGMA_V,
    GPS_SIGMA_VH,
    GPS_SIGMA_VV,
    GPS_WHITE_FRACTION,
    GPS_BIAS_H,
    GPS_BIAS_V,
    GPS_BIAS_TIME,
    GPS_BIAS_WALK_V,
    GPS_MAX_ACCURACY,
    GPS_RTK_ACCURACY,
    GPS_RESET_AFTER,
    BARO_USE,
    BARO_SIGMA,
    BARO_BIAS_WALK,
    MAG_USE,
    MAG_SIGMA,
    DECLINATION,
    ATTITUDE_USE,
    ATTITUDE_TILT,
    ATTITUDE_YAW,
    RANGE_USE,
    RANGE_SIGMA,
    RANGE_SIGMA_PER_M,
    RANGE_LEVER,
    _,
    _,
    SURFACE_HEIGHT,
    HUBER_1,
    HUBER_2,
    HUBER_3,
    GATE_1,
    GATE_2,
    GATE_3,
    VISION_ANGLE,
    VISION_RANGE,
    VISION_FLOOR,
    VISION_LEVER,
    _,
    _,
    VISION_MOUNT,
    _,
    _,
    _,
    _,
    _,
    _,
    _,
    _,
    LATENCY_WALK,
    LATENCY_RATE,
    LATENCY,
    LATENCY_SIGMA,
    OFFSET_WALK,
    LEVEL_WALK,
    PRIOR_HEAVE,
    _,
    _,
    _,
    _,
    _,
    _,
    SIZE,
) = range(75)


@dataclass(frozen=True, slots=True)
class Site:
    """What is known of the place once the filter starts.

    ``origin`` is latitude [rad], longitude [rad], altitude [m]; ``declination_rad`` is east positive.
    """

    origin: tuple[float, float, float]
    declination_rad: float


def pack_parameters(config: Config, site: Site) -> Array:
    """Return the parameter vector of a configuration at a site."""
    c = config
    p = np.zeros(SIZE)
    gravity = c.filter.gravity_mps2
    p[GRAVITY] = normal_gravity(site.origin[0], site.origin[2]) if gravity is None else gravity
    p[ORIGIN : ORIGIN + 3] = site.origin
    p[ACCEL_NOISE], p[GYRO_NOISE] = c.imu.accel_noise, c.imu.gyro_noise
    p[ACCEL_BIAS_WALK], p[GYRO_BIAS_WALK] = c.imu.accel_bias_walk, c.imu.gyro_bias_walk
    p[VIBRATION_GAIN] = c.imu.vibration_gain
    p[GPS_LEVER : GPS_LEVER + 3] = c.gps.lever_arm_m
    p[GPS_SIGMA_H], p[GPS_SIGMA_V] = c.gps.position_sigma_m, c.gps.height_sigma_m
    p[GPS_SIGMA_VH], p[GPS_SIGMA_VV] = c.gps.velocity_sigma_mps, c.gps.climb_sigma_mps
    p[GPS_WHITE_FRACTION] = c.gps.white_fraction
    p[GPS_BIAS_H], p[GPS_BIAS_V] = c.gps.bias_sigma_m, c.gps.height_bias_sigma_m
    p[GPS_BIAS_TIME], p[GPS_MAX_ACCURACY] = c.gps.bias_time_s, c.gps.max_accuracy_m
    p[GPS_RTK_ACCURACY] = c.gps.rtk_accuracy_m
    p[GPS_BIAS_WALK_V] = c.gps.height_bias_walk
    p[GPS_RESET_AFTER] = c.gps.reset_after_s
    p[BARO_USE], p[BARO_SIGMA], p[BARO_BIAS_WALK] = (
        c.barometer.use,
        c.barometer.sigma_m,
        c.barometer.bias_walk,
    )
    p[MAG_USE], p[MAG_SIGMA] = c.magnetometer.use, c.magnetometer.heading_sigma_rad
    p[DECLINATION] = site.declination_rad
    p[ATTITUDE_USE] = c.attitude.use == "fuse"
    p[ATTITUDE_TILT], p[ATTITUDE_YAW] = c.attitude.tilt_sigma_rad, c.attitude.yaw_sigma_rad
    p[RANGE_USE], p[RANGE_SIGMA] = c.rangefinder.use, c.rangefinder.sigma_m
    p[RANGE_SIGMA_PER_M] = c.rangefinder.sigma_per_m
    p[RANGE_LEVER : RANGE_LEVER + 3] = c.rangefinder.lever_arm_m
    p[SURFACE_HEIGHT] = c.rangefinder.surface_height_m
    v, d = c.vision, c.platform
    p[VISION_ANGLE], p[VISION_RANGE], p[VISION_FLOOR] = v.angle_sigma_rad, v.range_sigma, v.floor_m
    p[VISION_LEVER : VISION_LEVER + 3] = v.lever_arm_m
    mount = quat_to_matrix(euler_to_quat(*v.mount_rpy_rad))
    p[VISION_MOUNT : VISION_MOUNT + 9] = (R_CB_NOMINAL @ mount.T).ravel()
    p[LATENCY_WALK], p[LATENCY_RATE] = v.latency_walk, v.latency_rate_radps
    p[LATENCY], p[LATENCY_SIGMA] = v.latency_s, v.latency_sigma_s
    p[OFFSET_WALK] = d.offset_walk
    p[LEVEL_WALK] = d.level_walk
    if d.use is True:
        from estimation.deck import prior_motion

        p[PRIOR_HEAVE:SIZE] = prior_motion(d)[: SIZE - PRIOR_HEAVE]
    for dof in (1, 2, 3):
        p[HUBER_1 + dof - 1] = chi_square_bound(c.filter.huber_sigma, dof)
        p[GATE_1 + dof - 1] = chi_square_bound(c.filter.gate_sigma, dof)
    return p


def chi_square_bound(sigma: float, dof: int) -> float:
    """Return the chi-square value that is exceeded as rarely, with ``dof`` degrees of freedom, as ``sigma``
    standard deviations (two-sided) are in one dimension."""
    from scipy.special import chdtri

    return float(chdtri(dof, math.erfc(sigma / math.sqrt(2.0))))

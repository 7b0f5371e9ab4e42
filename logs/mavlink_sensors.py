"""What MAVLink's sensor messages mean, as series: the one way from messages to /imu, /gps/fix and the others.

Rows have the layouts of ``logs.tlog.dialect``; a telemetry log gives a whole flight of them at once, a live link one
at a time (``logs.mavlink_live``).
"""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from logs.recording import Series
from logs.sensors import (
    FIX,
    NO_FIX,
    NOT_MEASURED,
    RTK_FIXED,
    RTK_FLOAT,
    Floats,
    Times,
    attitude_series,
    barometer_series,
    columns,
    fix_series,
    imu_series,
    magnetometer_series,
    quaternions_from_euler,
    range_series,
    velocity_series,
)

Rows = NDArray[np.void]
Mask = NDArray[np.bool_]

HOLD_NS = 200_000_000
"""A slow sensor's value that is sent again and again counts as a new one after so long."""
_STANDARD_GRAVITY = 9.80665
_DOWNWARD = 25
_UNKNOWN_COURSE = 65535
_SPEED_SIGMA_MPS = 0.5
_STATUS = np.array([NO_FIX, NO_FIX, NO_FIX, FIX, FIX, RTK_FLOAT, RTK_FIXED, FIX, FIX], dtype=np.int8)


def first_imu(name: str, data: Rows) -> Mask:
    """Return which rows are of the first inertial sensor: HIGHRES_IMU numbers them, the others are one each."""
    return data["id"] == 0 if name == "HIGHRES_IMU" else np.ones(len(data), dtype=np.bool_)


def inertial(name: str, data: Rows) -> tuple[Floats, Floats]:
    """Return angular velocity [rad/s] and specific force [m/s^2] (n, 3) of an IMU message, FRD."""
    force = columns(data["xacc"], data["yacc"], data["zacc"])
    rate = columns(data["xgyro"], data["ygyro"], data["zgyro"])
    if name == "HIGHRES_IMU":
        return rate, force
    return rate * 1e-3, force * 1e-3 * _STANDARD_GRAVITY


def magnetic(name: str, data: Rows, gauss: float) -> Floats:
    """Return the field (n, 3) [T] of an IMU message; ``gauss`` is that of HIGHRES_IMU (see ``gauss_factor``)."""
    field = columns(data["xmag"], data["ymag"], data["zmag"])
    return field * gauss if name == "HIGHRES_IMU" else field * 1e-7


def gauss_factor(data: Rows) -> float:
    """Return what takes HIGHRES_IMU's field to tesla: gauss by the standard, but ArduPilot sends a power of 1000."""
    strength = float(np.median(np.linalg.norm(columns(data["xmag"], data["ymag"], data["zmag"]), axis=1)))
    if not math.isfinite(strength) or strength < 10.0:
        return 1e-4
    return 1e-4 * 10.0 ** (-3 * round(math.log10(strength / 0.5) / 3))


def imu(name: str, data: Rows, times: Times, delay: Mapping[str, str]) -> Series:
    """Return /imu of an IMU message."""
    return imu_series(times, *inertial(name, data), 0, {"message": name, **delay})


def compass(name: str, field: Floats, times: Times) -> Series:
    """Return /magnetic_field of fields (n, 3) [T]."""
    return magnetometer_series(times, field, 0, {"message": name})


def pressure(name: str, data: Rows) -> tuple[Floats, Floats]:
    """Return static pressure [Pa] and temperature [deg C] (n,) of SCALED_PRESSURE or HIGHRES_IMU."""
    if name == "HIGHRES_IMU":
        return 100.0 * data["abs_pressure"].astype(np.float64), data["temperature"].astype(np.float64)
    return 100.0 * data["press_abs"].astype(np.float64), 1e-2 * data["temperature"].astype(np.float64)


def air(name: str, data: Rows, times: Times) -> list[Series]:
    """Return /baro and /baro/temperature."""
    return barometer_series(times, *pressure(name, data), 0, {"message": name})


def undulation_of(data: Rows) -> float | None:
    """Return the geoid's height above the ellipsoid [m] that GPS_RAW_INT gives, or None."""
    data = data[(data["fix_type"] >= 3) & (data["alt_ellipsoid"] != 0)]
    if not len(data):
        return None
    return 1e-3 * float(np.median(data["alt_ellipsoid"] - data["alt"].astype(np.int64)))


def satellite(data: Rows, times: Times, undulation: float | None) -> list[Series]:
    """Return /gps/fix and, where it moves, /gps/velocity, whose vertical part GPS_RAW_INT lacks (a huge variance)."""
    status = _STATUS[np.minimum(data["fix_type"], len(_STATUS) - 1)]
    altitude = 1e-3 * data["alt"] + (undulation or 0.0)
    datum = "mean sea level" if undulation is None else "ellipsoid"
    metadata = {"message": "GPS_RAW_INT", "altitude_datum": datum}
    position = fix_series(
        times,
        1e-7 * data["lat"],
        1e-7 * data["lon"],
        altitude,
        status,
        1e-3 * data["h_acc"],
        1e-3 * data["v_acc"],
        0,
        metadata,
    )
    course = np.radians(1e-2 * data["cog"])
    speed = 1e-2 * data["vel"]
    moving = (data["vel"] != _UNKNOWN_COURSE) & (data["cog"] != _UNKNOWN_COURSE) & (status != NO_FIX)
    if not moving.any():
        return [position]
    sigma = 1e-3 * data["vel_acc"]
    sigma = np.where(sigma > 0.0, sigma, _SPEED_SIGMA_MPS)[moving]
    horizontal = columns(speed * np.cos(course), speed * np.sin(course), np.zeros(len(speed)))[moving]
    metadata |= {
        "vertical": "not measured: its variance is 1e6",
        "sigma": f"vel_acc, {_SPEED_SIGMA_MPS} m/s where it is 0",
    }
    velocity = velocity_series(times[moving], horizontal, sigma, 0, metadata)
    velocity.data["twist_covariance"][:, 14] = NOT_MEASURED
    return [position, velocity]


def downward(data: Rows) -> Mask:
    """Return which rows of DISTANCE_SENSOR look down."""
    down: Mask = data["orientation"] == _DOWNWARD
    return down


def ranges(data: Rows, times: Times) -> Series:
    """Return /range of DISTANCE_SENSOR."""
    metres = [1e-2 * data[f"{n}_distance"] for n in ("current", "min", "max")]
    kind = int(data["type"][0] == 0)
    return range_series(times, metres[0], metres[1], metres[2], kind, 0, {"message": "DISTANCE_SENSOR"})


def attitude(name: str, data: Rows, times: Times) -> Series:
    """Return /attitude of ATTITUDE_QUATERNION or ATTITUDE."""
    if name == "ATTITUDE":
        q = quaternions_from_euler(data["roll"], data["pitch"], data["yaw"])
    else:
        q = columns(*(data[f"q{k}"] for k in (1, 2, 3, 4)))
    return attitude_series(times, q, {"message": name})

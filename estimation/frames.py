"""Frames, rotations and geodesy: the conventions of the whole project, written once.

Frames (seed 2.1): *n* is NED, *b* is the body (FRD: forward, right, down), *c* is the camera (X right,
Y backwards, Z down). ``R_nb`` takes body components to NED: ``v_n = R_nb @ v_b``. Quaternions are Hamilton, scalar
first (w, x, y, z), body to NED. Euler angles are roll, pitch, yaw in rad, ``R_nb = R_z(yaw) R_y(pitch) R_x(roll)``
(seed 2.6). The filter's NED origin is a fixed WGS-84 point; the platform moves in it, and what is reported is
``P_rel = P_uav - P_platform``, whose third component is negative above the deck. Heave is positive up.

Everything here is a plain function of arrays that numba can compile as it stands.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

WGS84_A_M = 6378137.0
"""Semi-major axis of the WGS-84 ellipsoid [m]."""
WGS84_F = 1.0 / 298.257223563
"""Flattening of the WGS-84 ellipsoid."""
WGS84_E2 = WGS84_F * (2.0 - WGS84_F)

R_CB_NOMINAL: Array = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
"""Body to camera for a camera that looks straight down with its image top forward (seed 2.8)."""


def skew(v: Array) -> Array:
    """Return the matrix [v]x with ``[v]x @ u = v x u``; ``v`` of shape (3,)."""
    m = np.zeros((3, 3))
    m[0, 1] = -v[2]
    m[0, 2] = v[1]
    m[1, 0] = v[2]
    m[1, 2] = -v[0]
    m[2, 0] = -v[1]
    m[2, 1] = v[0]
    return m


def compose(a: Array, b: Array) -> Array:
    """Return the product of two (3, 3) matrices; its own function so that compiled code can do without a library
    call for so small a product."""
    return a @ b


def rotate(m: Array, v: Array) -> Array:
    """Return the product of a (3, 3) matrix and a vector (3,); see ``compose``."""
    return m @ v


def quat_multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton product a * b of two quaternions (w, x, y, z)."""
    aw, ax, ay, az = a[0], a[1], a[2], a[3]
    bw, bx, by, bz = b[0], b[1], b[2], b[3]
    q = np.empty(4)
    q[0] = aw * bw - ax * bx - ay * by - az * bz
    q[1] = aw * bx + ax * bw + ay * bz - az * by
    q[2] = aw * by - ax * bz + ay * bw + az * bx
    q[3] = aw * bz + ax * by - ay * bx + az * bw
    return q


def quat_conjugate(q: Array) -> Array:
    """Return the conjugate, which for a unit quaternion is the inverse rotation."""
    c = -q
    c[0] = q[0]
    return c


def quat_normalise(q: Array) -> Array:
    """Return q with unit length and a non-negative scalar part (q and -q are the same rotation)."""
    n = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[0] < 0.0:
        n = -n
    return q / n


def quat_exp(rotation_vector: Array) -> Array:
    """Return the unit quaternion of a rotation vector [rad]; law: ``quat_log(quat_exp(v)) == v`` for |v| < pi."""
    angle2 = rotation_vector[0] ** 2 + rotation_vector[1] ** 2 + rotation_vector[2] ** 2
    q = np.empty(4)
    if angle2 < 1e-8:
        q[0] = 1.0 - angle2 / 8.0
        s = 0.5 - angle2 / 48.0
    else:
        angle = math.sqrt(angle2)
        q[0] = math.cos(0.5 * angle)
        s = math.sin(0.5 * angle) / angle
    q[1] = s * rotation_vector[0]
    q[2] = s * rotation_vector[1]
    q[3] = s * rotation_vector[2]
    return q


def quat_log(q: Array) -> Array:
    """Return the rotation vector [rad], of length at most pi, of a unit quaternion."""
    w = q[0]
    sign = 1.0
    if w < 0.0:
        w = -w
        sign = -1.0
    n = math.sqrt(q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    scale = sign * (2.0 / w * (1.0 - n * n / (3.0 * w * w)) if n < 1e-6 else 2.0 * math.atan2(n, w) / n)
    v = np.empty(3)
    v[0] = scale * q[1]
    v[1] = scale * q[2]
    v[2] = scale * q[3]
    return v


def quat_to_matrix(q: Array) -> Array:
    """Return the rotation matrix of a unit quaternion; for a body-to-NED quaternion this is ``R_nb``."""
    w, x, y, z = q[0], q[1], q[2], q[3]
    m = np.empty((3, 3))
    m[0, 0] = 1.0 - 2.0 * (y * y + z * z)
    m[0, 1] = 2.0 * (x * y - w * z)
    m[0, 2] = 2.0 * (x * z + w * y)
    m[1, 0] = 2.0 * (x * y + w * z)
    m[1, 1] = 1.0 - 2.0 * (x * x + z * z)
    m[1, 2] = 2.0 * (y * z - w * x)
    m[2, 0] = 2.0 * (x * z - w * y)
    m[2, 1] = 2.0 * (y * z + w * x)
    m[2, 2] = 1.0 - 2.0 * (x * x + y * y)
    return m


def matrix_to_quat(m: Array) -> Array:
    """Return the unit quaternion of a rotation matrix (largest-component method), scalar part >= 0."""
    t = np.empty(4)
    t[0] = m[0, 0] + m[1, 1] + m[2, 2]
    t[1] = m[0, 0] - m[1, 1] - m[2, 2]
    t[2] = m[1, 1] - m[0, 0] - m[2, 2]
    t[3] = m[2, 2] - m[0, 0] - m[1, 1]
    k = int(np.argmax(t))
    r = math.sqrt(1.0 + t[k])
    s = 0.5 / r
    q = np.empty(4)
    if k == 0:
        q[0] = 0.5 * r
        q[1] = (m[2, 1] - m[1, 2]) * s
        q[2] = (m[0, 2] - m[2, 0]) * s
        q[3] = (m[1, 0] - m[0, 1]) * s
    elif k == 1:
        q[0] = (m[2, 1] - m[1, 2]) * s
        q[1] = 0.5 * r
        q[2] = (m[0, 1] + m[1, 0]) * s
        q[3] = (m[0, 2] + m[2, 0]) * s
    elif k == 2:
        q[0] = (m[0, 2] - m[2, 0]) * s
        q[1] = (m[0, 1] + m[1, 0]) * s
        q[2] = 0.5 * r
        q[3] = (m[1, 2] + m[2, 1]) * s
    else:
        q[0] = (m[1, 0] - m[0, 1]) * s
        q[1] = (m[0, 2] + m[2, 0]) * s
        q[2] = (m[1, 2] + m[2, 1]) * s
        q[3] = 0.5 * r
    return quat_normalise(q)


def euler_to_quat(roll: float, pitch: float, yaw: float) -> Array:
    """Return the body-to-NED quaternion of roll, pitch, yaw [rad]."""
    cr, sr = math.cos(0.5 * roll), math.sin(0.5 * roll)
    cp, sp = math.cos(0.5 * pitch), math.sin(0.5 * pitch)
    cy, sy = math.cos(0.5 * yaw), math.sin(0.5 * yaw)
    q = np.empty(4)
    q[0] = cr * cp * cy + sr * sp * sy
    q[1] = sr * cp * cy - cr * sp * sy
    q[2] = cr * sp * cy + sr * cp * sy
    q[3] = cr * cp * sy - sr * sp * cy
    return quat_normalise(q)


def quat_to_euler(q: Array) -> Array:
    """Return roll, pitch, yaw [rad] of a body-to-NED quaternion; at pitch = +-90 deg roll is set to zero."""
    m = quat_to_matrix(q)
    e = np.empty(3)
    sin_pitch = min(1.0, max(-1.0, -m[2, 0]))
    e[1] = math.asin(sin_pitch)
    if abs(sin_pitch) < 1.0 - 1e-12:
        e[0] = math.atan2(m[2, 1], m[2, 2])
        e[2] = math.atan2(m[1, 0], m[0, 0])
    else:
        e[0] = 0.0
        e[2] = math.atan2(-m[0, 1], m[1, 1])
    return e


def quat_to_euler_columns(q: Array) -> Array:
    """Return roll, pitch, yaw [rad], shape (n, 3), of body-to-NED quaternions of shape (n, 4)."""
    w, x, y, z = q[:, 0], q[:, 1], q[:, 2], q[:, 3]
    e = np.empty((len(q), 3))
    e[:, 0] = np.arctan2(2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y))
    e[:, 1] = np.arcsin(np.clip(2.0 * (w * y - x * z), -1.0, 1.0))
    e[:, 2] = np.arctan2(2.0 * (x * y + w * z), 1.0 - 2.0 * (y * y + z * z))
    return e


def wrap_pi(angle: float) -> float:
    """Return the angle [rad] in [-pi, pi)."""
    return float((angle + math.pi) % (2.0 * math.pi) - math.pi)


def geodetic_to_ecef(latitude_rad: float, longitude_rad: float, altitude_m: float) -> Array:
    """Return WGS-84 Earth-centred coordinates [m] of a geodetic position (altitude above the ellipsoid)."""
    s, c = math.sin(latitude_rad), math.cos(latitude_rad)
    n = WGS84_A_M / math.sqrt(1.0 - WGS84_E2 * s * s)
    e = np.empty(3)
    e[0] = (n + altitude_m) * c * math.cos(longitude_rad)
    e[1] = (n + altitude_m) * c * math.sin(longitude_rad)
    e[2] = (n * (1.0 - WGS84_E2) + altitude_m) * s
    return e


def ecef_to_ned_matrix(latitude_rad: float, longitude_rad: float) -> Array:
    """Return the rotation from Earth-centred axes to NED axes at a geodetic position."""
    sp, cp = math.sin(latitude_rad), math.cos(latitude_rad)
    sl, cl = math.sin(longitude_rad), math.cos(longitude_rad)
    m = np.empty((3, 3))
    m[0, 0] = -sp * cl
    m[0, 1] = -sp * sl
    m[0, 2] = cp
    m[1, 0] = -sl
    m[1, 1] = cl
    m[1, 2] = 0.0
    m[2, 0] = -cp * cl
    m[2, 1] = -cp * sl
    m[2, 2] = -sp
    return m


def geodetic_to_ned(latitude_rad: float, longitude_rad: float, altitude_m: float, origin: Array) -> Array:
    """Return the NED position [m], shape (3,), of a geodetic position in the tangent plane at ``origin``.

    ``origin`` is latitude [rad], longitude [rad], altitude [m]. Exact (through ECEF), not a flat-Earth formula.
    """
    d = geodetic_to_ecef(latitude_rad, longitude_rad, altitude_m) - geodetic_to_ecef(
        origin[0], origin[1], origin[2]
    )
    m = ecef_to_ned_matrix(origin[0], origin[1])
    p = np.empty(3)
    for i in range(3):
        p[i] = m[i, 0] * d[0] + m[i, 1] * d[1] + m[i, 2] * d[2]
    return p


def ned_to_geodetic(ned_m: Array, origin: Array) -> Array:
    """Return latitude [rad], longitude [rad], altitude [m] of a NED position in the tangent plane at ``origin``.

    Law: inverse of ``geodetic_to_ned`` to a micrometre within 100 km (Bowring's start, then fixed-point steps).
    """
    m = ecef_to_ned_matrix(origin[0], origin[1])
    e = geodetic_to_ecef(origin[0], origin[1], origin[2]) + m.T @ ned_m
    p = math.hypot(e[0], e[1])
    longitude = math.atan2(e[1], e[0])
    latitude = math.atan2(e[2], p * (1.0 - WGS84_E2))
    altitude = 0.0
    for _ in range(8):
        s = math.sin(latitude)
        n = WGS84_A_M / math.sqrt(1.0 - WGS84_E2 * s * s)
        altitude = p * math.cos(latitude) + e[2] * s - WGS84_A_M * math.sqrt(1.0 - WGS84_E2 * s * s)
        latitude = math.atan2(e[2], p * (1.0 - WGS84_E2 * n / (n + altitude)))
    return np.array([latitude, longitude, altitude])


def normal_gravity(latitude_rad: float, altitude_m: float) -> float:
    """Return WGS-84 normal gravity [m/s^2] (Somigliana's formula with the second-order free-air term)."""
    s2 = math.sin(latitude_rad) ** 2
    g0 = 9.7803253359 * (1.0 + 0.00193185265241 * s2) / math.sqrt(1.0 - WGS84_E2 * s2)
    m = 0.00344978650684
    h = altitude_m / WGS84_A_M
    return g0 * (1.0 - 2.0 * (1.0 + WGS84_F + m - 2.0 * WGS84_F * s2) * h + 3.0 * h * h)

"""Alignment: from raw sensors to the first state, at rest or in flight.

Events come in the order of their content and are never looked at twice. The horizon is found from the specific
force (at rest) or from the specific force and the change of the GPS velocity (in flight: f = dv/dt - g), heading from
the magnetometer, from the autopilot's attitude where that is allowed, or else from the horizontal acceleration that
GPS and accelerometers both see. Nothing is given out before all of it is known.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from estimation.config import Config
from estimation.events import Kind
from estimation.first_state import FirstAttitude, Start, first_state
from estimation.frames import (
    Array,
    euler_to_quat,
    geodetic_to_ned,
    matrix_to_quat,
    normal_gravity,
    quat_exp,
    quat_multiply,
    quat_normalise,
    quat_to_euler,
    quat_to_matrix,
    wrap_pi,
)
from estimation.parameters import Site
from estimation.rows import FilterState, Rows
from estimation.state import Layout

REST_GYRO_RADPS = 0.05
"""Largest standard deviation of the angular velocity at rest [rad/s]."""
REST_ACCEL_MPS2 = 0.5
"""Largest standard deviation of the specific force at rest [m/s^2]."""
REST_SPEED_MPS = 0.5
"""Largest GPS speed at rest [m/s]."""
LEVEL_TIME_S = 10.0
"""Time constant with which the running horizon follows the specific force."""
HEADING_MEMORY_S = 60.0
"""Memory of the heading from accelerations."""
DIFFERENCE_NS = 1_000_000_000
"""Spacing of the fixes whose difference stands for a velocity that the receiver does not give."""
PATIENCE_NS = 3_000_000_000
"""How long a start waits for a barometer after the first fix."""
TRY_NS = 100_000_000
"""Spacing of the attempts to start."""
FRESH_NS = 1_200_000_000
"""Oldest GPS, magnetometer or attitude that a start may use."""


@dataclass(slots=True)
class Aligned:
    """A first state: ready to run, with a sentence on how it was found."""

    site: Site
    state: FilterState
    note: str


@dataclass(slots=True)
class Aligner:
    """Collects what a start needs. ``site`` is kept from an earlier start of the same flight, if there was one."""

    config: Config
    layout: Layout
    sensors: int
    declination_rad: float | None = None
    """Declination where it is known beforehand; None: from the World Magnetic Model."""
    utc_s: float = 0.0
    """Date for the World Magnetic Model, seconds since 1970."""
    site: Site | None = None
    gyro_bias: Array | None = None
    _imu: list[tuple[int, Array]] = field(default_factory=list)
    _velocities: list[tuple[int, Array, Array]] = field(default_factory=list)
    _fix: tuple[int, Array, Array] | None = None
    _earlier_fix: tuple[int, Array, Array] | None = None
    _first_fix_ns: int = 0
    _velocity_derived: bool = False
    _mag: tuple[int, Array] | None = None
    _attitude: tuple[int, Array] | None = None
    _pressure: tuple[int, float] | None = None
    _level: Array | None = None
    _impulse: Array = field(default_factory=lambda: np.zeros(3))
    _previous_velocity: tuple[int, Array] | None = None
    _heading_sums: Array = field(default_factory=lambda: np.zeros(5))
    _tried_ns: int | None = None

    def consume(self, rows: Rows, start: int, stop: int) -> tuple[int, Aligned] | None:
        """Take rows in order; return the index after the inertial sample at which the filter can start, and the state.

        None while something is missing (``missing`` says what).
        """
        for i in range(start, stop):
            t, kind, value = int(rows.t_ns[i]), int(rows.kind[i]), rows.value[i].copy()
            if kind == Kind.IMU:
                self._take_imu(t, value)
                due = self._tried_ns is None or t - self._tried_ns >= TRY_NS
                aligned = self._try(t) if due else None
                if due:
                    self._tried_ns = t
                if aligned is not None:
                    return i + 1, aligned
            elif kind == Kind.GPS_POSITION and self._good(value, rows.own[i]):
                self._take_fix(t, value[:3], rows.own[i].copy())
            elif kind == Kind.GPS_VELOCITY and value[3] >= 1.0:
                self._take_velocity(t, value[:3], rows.own[i].copy())
                self._velocity_derived = False
            elif kind == Kind.MAGNETOMETER and self.config.magnetometer.use:
                self._mag = (t, value[:3])
            elif kind == Kind.ATTITUDE and self.config.attitude.use != "off":
                self._attitude = (t, quat_normalise(value[:4]))
            elif kind == Kind.BAROMETER and value[0] > 0.0:
                self._pressure = (t, float(value[0]))
        return None

    def _take_fix(self, t: int, fix: Array, own: Array) -> None:
        """Keep a fix; where the receiver gives no velocity for a while, fixes make one."""
        if self._earlier_fix is None:
            self._earlier_fix = (t, fix, own)
            self._first_fix_ns = t
        t0, earlier, _ = self._earlier_fix
        if t - t0 >= DIFFERENCE_NS:
            if not self._velocities or t - self._velocities[-1][0] >= DIFFERENCE_NS:
                moved = geodetic_to_ned(fix[0], fix[1], fix[2], earlier)
                self._take_velocity(t, moved / ((t - t0) * 1e-9), np.full(6, np.nan))
                self._velocity_derived = True
            self._earlier_fix = (t, fix, own)
        self._fix = (t, fix, own)

    @property
    def missing(self) -> str:
        """What the start still waits for, in words."""
        if len(self._imu) < 2:
            return "inertial samples"
        if self._fix is None or not self._velocities:
            return "good GPS positions"
        if self._mag is None and self._attitude is None:
            return "a heading (magnetometer, autopilot attitude, or horizontal acceleration seen by GPS)"
        return "recent readings of all sensors"

    def _good(self, value: Array, own: Array) -> bool:
        limit = self.config.gps.max_accuracy_m**2
        return bool(value[3] >= 1.0 and not own[0] > limit and not own[3] > limit)

    def _take_imu(self, t: int, value: Array) -> None:
        if self._imu and t - self._imu[-1][0] > int(self.config.imu.gap_s * 1e9):
            self._imu.clear()
            self._level = None
            self._heading_sums[:] = 0.0
            self._previous_velocity = None
        span = int(self.config.initialisation.rest_s * 1e9)
        if self._imu:
            self._run_level(t, value)
        self._imu.append((t, value))
        while self._imu[-1][0] - self._imu[1 if len(self._imu) > 1 else 0][0] >= span:
            self._imu.pop(0)

    def _window(self) -> Array:
        return np.array([v for _, v in self._imu])

    def _run_level(self, t: int, value: Array) -> None:
        """Carry a horizon with unknown heading along, for the heading from accelerations."""
        t0, previous = self._imu[-1]
        dt = (t - t0) * 1e-9
        if self._level is None:
            if self._imu[-1][0] - self._imu[0][0] < int(0.9e9 * self.config.initialisation.rest_s):
                return
            window = self._window()
            force = window[:, 3:].mean(axis=0)
            self._level = _attitude_from(force, np.array([0.0, 0.0, -1.0]), 0.0)
            if self.gyro_bias is None and self._still(window):
                self.gyro_bias = window[:, :3].mean(axis=0)
        w = 0.5 * (previous[:3] + value[:3]) - (self.gyro_bias if self.gyro_bias is not None else 0.0)
        f = 0.5 * (previous[3:] + value[3:])
        force_n = quat_to_matrix(self._level) @ f
        # A slow pull of the horizon towards the mean specific force.
        pull = (
            np.cross(force_n, [0.0, 0.0, -1.0])
            / max(1.0, float(np.linalg.norm(force_n)))
            * (dt / LEVEL_TIME_S)
        )
        self._level = quat_normalise(
            quat_multiply(quat_exp(pull), quat_multiply(self._level, quat_exp(w * dt)))
        )
        self._impulse = self._impulse + (force_n + np.array([0.0, 0.0, 9.81])) * dt

    def _take_velocity(self, t: int, velocity: Array, own: Array) -> None:
        self._velocities.append((t, velocity, own))
        if len(self._velocities) > 20:
            self._velocities.pop(0)
        if self._level is not None:
            if self._previous_velocity is not None:
                t0, v0 = self._previous_velocity
                d, u = velocity[:2] - v0[:2], self._impulse[:2]
                forget = math.exp(-(t - t0) * 1e-9 / HEADING_MEMORY_S)
                self._heading_sums *= forget
                self._heading_sums += [
                    u[0] * d[0] + u[1] * d[1], u[0] * d[1] - u[1] * d[0], float(u @ u), float(d @ d), 2.0,
                ]  # fmt: skip
            self._previous_velocity = (t, velocity)
            self._impulse = np.zeros(3)

    def _heading_from_motion(self) -> tuple[float, float] | None:
        """Return the angle from the running horizon's heading to true north and its 1-sigma [rad]."""
        cosine, sine, uu, dd, count = self._heading_sums
        if uu < 0.5:
            return None
        angle = math.atan2(sine, cosine)
        residual = max(0.0, dd - math.hypot(sine, cosine) ** 2 / uu)
        # Neighbouring changes of velocity share a fix and a tilt error: count a fourth of them.
        variance = max(0.01, 4.0 * residual / count)
        return angle, math.sqrt(variance / uu)

    def _still(self, window: Array) -> bool:
        quiet = bool(
            np.all(window[:, :3].std(axis=0) < REST_GYRO_RADPS)
            and np.all(window[:, 3:].std(axis=0) < REST_ACCEL_MPS2)
            and np.linalg.norm(window[:, :3].mean(axis=0)) < 0.1
            and abs(np.linalg.norm(window[:, 3:].mean(axis=0)) - 9.8) < 0.5
        )
        slow = not self._velocities or float(np.linalg.norm(self._velocities[-1][1][:2])) < REST_SPEED_MPS
        return quiet and slow

    def _try(self, t: int) -> Aligned | None:
        c = self.config
        if self._imu[-1][0] - self._imu[0][0] < int(0.9e9 * c.initialisation.rest_s):
            return None
        if self._fix is None or not self._velocities:
            return None
        if t - self._fix[0] > FRESH_NS or t - self._velocities[-1][0] > FRESH_NS:
            return None
        if c.barometer.use and self._pressure is None and t - self._first_fix_ns < PATIENCE_NS:
            return None
        window = self._window()
        rest = self._still(window)
        site = self.site or self._site()
        attitude = self._first_attitude(t, window, rest, site)
        if attitude is None:
            return None
        return Aligned(site, self._start(t, attitude, rest, site), attitude.note)

    def _site(self) -> Site:
        assert self._fix is not None
        o = self.config.origin
        latitude, longitude, altitude = (float(v) for v in self._fix[1])
        if o.latitude_deg is not None and o.longitude_deg is not None and o.altitude_m is not None:
            latitude, longitude, altitude = (
                math.radians(o.latitude_deg),
                math.radians(o.longitude_deg),
                o.altitude_m,
            )
        declination = self.declination_rad
        if declination is None:
            declination = world_magnetic_declination(latitude, longitude, altitude, self.utc_s)
        return Site((latitude, longitude, altitude), declination)

    def _first_attitude(self, t: int, window: Array, rest: bool, site: Site) -> FirstAttitude | None:
        c = self.config
        sigma = c.initialisation.yaw_sigma_rad
        attitude = self._attitude_now(t)
        if not rest and attitude is not None:
            return FirstAttitude(attitude, sigma, False, "in flight, from the autopilot's attitude")
        gravity = np.array([0.0, 0.0, normal_gravity(site.origin[0], site.origin[2])])
        force, up = window[:, 3:].mean(axis=0), -gravity
        if not rest:
            force, acceleration = self._force_and_acceleration()
            up = acceleration - gravity
        where = "at rest" if rest else "in flight"
        if self._mag is not None:
            turned = self._turned_since(self._mag[0])
            if t - self._mag[0] > FRESH_NS or turned is None:
                return None
            q = _attitude_from_field(force, up, turned.T @ self._mag[1], site.declination_rad)
            if q is None:
                return None
            return FirstAttitude(q, sigma, True, f"{where}, heading from the magnetometer")
        if attitude is not None:
            yaw = float(quat_to_euler(attitude)[2])
            q = _attitude_from(force, up, yaw)
            return FirstAttitude(q, sigma, False, f"{where}, heading from the autopilot's attitude")
        found = self._heading_from_motion()
        if found is None or found[1] > c.initialisation.motion_yaw_sigma_rad or self._level is None:
            return None
        turn = euler_to_quat(0.0, 0.0, found[0])
        q = quat_normalise(quat_multiply(turn, self._level))
        sigma = max(sigma, 1.5 * found[1])
        return FirstAttitude(q, sigma, False, "in flight, heading from horizontal acceleration")

    def _attitude_now(self, t: int) -> Array | None:
        """Return the autopilot's last attitude, turned on to now with the gyro; None without a recent one."""
        if self._attitude is None or t - self._attitude[0] > FRESH_NS:
            return None
        turned = self._turned_since(self._attitude[0])
        return None if turned is None else matrix_to_quat(quat_to_matrix(self._attitude[1]) @ turned)

    def _turned_since(self, since_ns: int) -> Array | None:
        """Return the rotation that takes body axes of now to those of then; None before the window's start."""
        if since_ns < self._imu[0][0]:
            return None
        turned = np.eye(3)
        for step, _, t0, dt in self._steps():
            if t0 < since_ns - 0.5e9 * dt:
                break
            turned = step @ turned
        return turned

    def _steps(self) -> Iterator[tuple[Array, Array, int, float]]:
        """Yield the window's steps, newest first: rotation over it (axes at its end to those at its begin), mean
        specific force at its middle in axes at its end, its begin [ns] and length [s]."""
        bias = self.gyro_bias if self.gyro_bias is not None else np.zeros(3)
        for (t0, a), (t1, b) in zip(reversed(self._imu[:-1]), reversed(self._imu[1:]), strict=True):
            dt = (t1 - t0) * 1e-9
            rate = 0.5 * (a[:3] + b[:3]) - bias
            half = quat_to_matrix(quat_exp(0.5 * dt * rate))
            yield half @ half, half.T @ (0.5 * (a[3:] + b[3:])), t0, dt

    def _impulse_between(self, t0: int, t1: int) -> Array:
        """Return the specific force integrated from t0 to t1 [m/s] in the body's axes of now."""
        total, back = np.zeros(3), np.eye(3)
        for step, force, begin, dt in self._steps():
            end = begin + dt * 1e9
            share = max(0.0, min(end, t1) - max(begin, t0)) / max(1.0, end - begin)
            total += share * dt * (back.T @ force)
            back = step @ back
        return total

    def _force_and_acceleration(self) -> tuple[Array, Array]:
        """Return the mean specific force, in the body's axes of now, and the mean NED acceleration of one interval.

        The interval is that between two GPS velocities in the window; where there is none, the force's mean over the
        window and no acceleration.
        """
        t1, v1, _ = self._velocities[-1]
        t0, v0, _ = next(v for v in self._velocities if v[0] >= self._imu[0][0] or v[0] == t1)
        if t1 - t0 < 0.3e9:
            begin, end = self._imu[0][0], self._imu[-1][0]
            return self._impulse_between(begin, end) / ((end - begin) * 1e-9), np.zeros(3)
        span = (t1 - t0) * 1e-9
        a = (v1 - v0) / span
        return self._impulse_between(t0, t1) / span, np.where(np.isfinite(a), a, 0.0)

    def _start(self, t: int, attitude: FirstAttitude, rest: bool, site: Site) -> FilterState:
        assert self._fix is not None
        window = self._window()
        velocity_t, velocity, _ = self._velocities[-1]
        velocity = np.where(np.isfinite(velocity), velocity, 0.0)
        if rest:
            velocity = np.zeros(3)
        elif not self._velocity_derived:
            # Carry the velocity on from its fix, where the window reaches back to it.
            since = max(velocity_t, self._imu[0][0])
            gravity = np.array([0.0, 0.0, normal_gravity(site.origin[0], site.origin[2])])
            impulse = self._impulse_between(since, t)
            velocity = velocity + quat_to_matrix(attitude.q) @ impulse + gravity * ((t - since) * 1e-9)
        fix_t, fix, own = self._fix
        return first_state(
            Start(
                t_ns=t,
                attitude=attitude,
                rest=rest,
                velocity=velocity,
                velocity_derived=self._velocity_derived and not rest,
                fix=fix,
                fix_covariance=own,
                fix_age_s=(t - fix_t) * 1e-9,
                gyro_bias=window[:, :3].mean(axis=0) if rest else self.gyro_bias,
                averaged_s=(self._imu[-1][0] - self._imu[0][0]) * 1e-9,
                imu=self._imu[-1][1].copy(),
                magnetic_field=self._mag[1] if attitude.magnetic and self._mag is not None else None,
                pressure_pa=None if self._pressure is None else self._pressure[1],
            ),
            site,
            self.config,
            self.layout,
            self.sensors,
        )


def _attitude_from(force: Array, up: Array, yaw: float) -> Array:
    """Return the body-to-NED quaternion with that yaw [rad] that takes the specific force to the direction ``up``.

    ``force`` is in body axes, ``up`` in NED (both point up at rest).
    """
    c, s = math.cos(yaw), math.sin(yaw)
    f = force / np.linalg.norm(force)
    u = np.array([c * up[0] + s * up[1], -s * up[0] + c * up[1], up[2]]) / np.linalg.norm(up)
    r = math.hypot(f[1], f[2])
    alpha = math.atan2(f[2], f[1])
    angle = math.acos(min(1.0, max(-1.0, u[1] / max(r, 1e-9))))
    candidates = [wrap_pi(angle - alpha), wrap_pi(-angle - alpha)]
    roll = min(candidates, key=abs)
    z = f[1] * math.sin(roll) + f[2] * math.cos(roll)
    pitch = wrap_pi(math.atan2(u[0], u[2]) - math.atan2(f[0], z))
    return euler_to_quat(roll, pitch, yaw)


def _attitude_from_field(force: Array, up: Array, magnetic: Array, declination_rad: float) -> Array | None:
    """Return the body-to-NED quaternion that takes ``force`` to the direction ``up`` and points the horizontal part of
    the field ``magnetic`` (body axes) along the declination; None where no turn about ``up`` does.

    Of two such turns, the one that leaves more of the field horizontal.
    """
    u = up / np.linalg.norm(up)
    level = quat_to_matrix(_attitude_from(force, up, 0.0))
    m = level @ magnetic
    along = (u @ m) * u
    across, turned = m - along, np.cross(u, m)
    aside = np.array([-math.sin(declination_rad), math.cos(declination_rad), 0.0])
    ahead = np.array([math.cos(declination_rad), math.sin(declination_rad), 0.0])
    # (along + across cos + turned sin) . aside = 0
    a, b, c = float(across @ aside), float(turned @ aside), float(along @ aside)
    size = math.hypot(a, b)
    if size <= abs(c):
        return None
    middle, half = math.atan2(b, a), math.acos(-c / size)
    best = max(
        (middle + half, middle - half),
        key=lambda x: float((across * math.cos(x) + turned * math.sin(x)) @ ahead),
    )
    if (along + across * math.cos(best) + turned * math.sin(best)) @ ahead <= 0.0:
        return None
    return quat_normalise(quat_multiply(quat_exp(best * u), matrix_to_quat(level)))


def world_magnetic_declination(
    latitude_rad: float, longitude_rad: float, altitude_m: float, utc_s: float
) -> float:
    """Return the declination [rad, east positive] of the World Magnetic Model at a place and date.

    Dates outside the model's five years are taken at its nearer end.
    """
    from pygeomag import GeoMag

    year = min(2029.99, max(2025.0, 1970.0 + utc_s / 31_556_952.0))
    model = GeoMag(coefficients_file="wmm/WMM_2025.COF")
    height_km = min(100.0, max(-1.0, altitude_m / 1000.0))
    result = model.calculate(math.degrees(latitude_rad), math.degrees(longitude_rad), height_km, year)
    return math.radians(float(result.d))

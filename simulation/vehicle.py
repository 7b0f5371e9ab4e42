"""A multirotor with its inner control loops: rigid body, rotor lag, drag, ground effect and legs on a moving deck.

The controller is the usual cascade: velocity (PI) to thrust direction, attitude (P) to angular rate, rate (P) to
torques. It flies on estimates that are given to it; between two of them it carries them on with its own inertial
sensor, as an autopilot does.

Plain functions of float64 arrays; numba compiles them where it is installed, and they run as they stand where not.
Body axes FRD, world NED; SI units.
"""

from __future__ import annotations

import importlib.util
import math
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import msgspec
import numpy as np

from simulation.jets import Array

_Positive = Annotated[float, msgspec.Meta(gt=0.0)]
_NotNegative = Annotated[float, msgspec.Meta(ge=0.0)]

STEP_HZ = 400
"""Rate of integration and of the inner loops."""
LEGS_SHARE = 0.05
"""Legs are loaded when they carry more than this share of the weight."""


class Airframe(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A multirotor of some 2 kg. ``inertia_kgm2`` about roll, pitch, yaw; ``thrust_ratio`` largest thrust over weight.

    ``rotor_lag_s`` of thrust and torque; ``drag_per_s`` linear drag of the rotors over mass, across and along the rotor
    axis; ``rotor_radius_m`` for the ground effect; ``gear_m`` the inertial sensor above the feet, which are ``feet_m``
    from the axis; velocity gains [1/s, 1/s^2] across and along the vertical, attitude and rate gains [1/s];
    ``climb_mps2`` the acceleration that a vertical velocity set-point is led up to with (ArduPilot's WPNAV_ACCEL_Z).
    """

    mass_kg: _Positive = 2.0
    inertia_kgm2: tuple[float, float, float] = (0.02, 0.02, 0.035)
    thrust_ratio: _Positive = 2.2
    rotor_lag_s: _Positive = 0.05
    drag_per_s: tuple[float, float] = (0.25, 0.1)
    rotor_radius_m: _Positive = 0.12
    gear_m: _NotNegative = 0.1
    feet_m: _Positive = 0.2
    leg_stiffness_npm: _Positive = 1500.0
    leg_damping_nspm: _Positive = 40.0
    friction: _NotNegative = 0.7
    velocity_gain: tuple[float, float] = (3.0, 5.0)
    velocity_integral: tuple[float, float] = (1.0, 1.5)
    attitude_gain: tuple[float, float] = (8.0, 2.5)
    rate_gain: tuple[float, float] = (22.0, 6.0)
    climb_mps2: _Positive = 100.0


(
    MASS, _JX, _JY, _JZ, RATIO, LAG, DRAG, DRAG_Z, ROTOR, GEAR, FEET, STIFF, DAMP, FRICTION, KV, KVZ, KI, KIZ, KA, KAZ,
    KR, KRZ, GRAVITY, DECK_HALF, CLIMB,
) = range(25)  # fmt: skip
"""Places of the parameters in ``pack``."""


def pack(a: Airframe, gravity_mps2: float, deck_m: float) -> Array:
    """Return an airframe's numbers with gravity and the deck's side [m] as one vector."""
    pairs = (a.velocity_gain, a.velocity_integral, a.attitude_gain, a.rate_gain)
    return np.array(
        [
            a.mass_kg, *a.inertia_kgm2, a.thrust_ratio, a.rotor_lag_s, *a.drag_per_s, a.rotor_radius_m, a.gear_m,
            a.feet_m, a.leg_stiffness_npm, a.leg_damping_nspm, a.friction, *(g for pair in pairs for g in pair),
            gravity_mps2, 0.5 * deck_m, a.climb_mps2,
        ]
    )  # fmt: skip


# Places in the vehicle's state (17,): position, velocity, attitude (w x y z, body to NED), angular velocity (body),
# thrust over mass and angular accelerations that the rotors give now.
POS, VEL, QUAT, RATE, DRIVE, STATE_SIZE = 0, 3, 6, 10, 13, 17
# What the autopilot holds (12,): velocity, attitude, velocity integral, time with weight on the legs while a descent is
# wanted [s], the vertical velocity that it is led to.
EST_VEL, EST_QUAT, INTEGRAL, LOADED, LED, OWN_SIZE = 0, 3, 7, 10, 11, 12
# A set-point (6,): velocity NED, yaw, largest tilt, motors on (1) or off (0).
SET_VEL, SET_YAW, SET_TILT, SET_MOTORS, SET_SIZE = 0, 3, 4, 5, 6
# One row of the truth: position, velocity, attitude, angular velocity, specific force.
TRUTH_SIZE = 16
# One row of the deck: centre, velocity, unit normal (down) and its derivative.
DECK_SIZE = 12


def _rotation(q: Array) -> Array:
    w, x, y, z = q[0], q[1], q[2], q[3]
    R = np.empty((3, 3))
    R[0, 0], R[0, 1], R[0, 2] = 1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)
    R[1, 0], R[1, 1], R[1, 2] = 2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)
    R[2, 0], R[2, 1], R[2, 2] = 2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)
    return R


def _turned(q: Array, rate: Array, dt: float) -> Array:
    """Return an attitude after a turn at a constant rate (body)."""
    angle = math.sqrt(rate[0] * rate[0] + rate[1] * rate[1] + rate[2] * rate[2]) * dt
    half = 0.5 * dt if angle < 1e-9 else math.sin(0.5 * angle) / angle * dt
    a, b, c, d = math.cos(0.5 * angle), half * rate[0], half * rate[1], half * rate[2]
    r = np.empty(4)
    r[0] = q[0] * a - q[1] * b - q[2] * c - q[3] * d
    r[1] = q[0] * b + q[1] * a + q[2] * d - q[3] * c
    r[2] = q[0] * c - q[1] * d + q[2] * a + q[3] * b
    r[3] = q[0] * d + q[1] * c - q[2] * b + q[3] * a
    return r / math.sqrt(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] + r[3] * r[3])


def _along(R: Array, i: int, v: Array) -> float:
    """Return a vector's component along a body axis, entry i of R' v."""
    return float(R[0, i] * v[0] + R[1, i] * v[1] + R[2, i] * v[2])


def _control(own: Array, setpoint: Array, gyro: Array, dt: float, p: Array, drive: Array) -> None:
    """Write into ``drive`` (4,) the thrust over mass and the angular accelerations that the controller asks for."""
    if setpoint[SET_MOTORS] < 0.5:
        drive[:] = 0.0
        own[INTEGRAL : INTEGRAL + 3] = 0.0
        return
    a = np.empty(3)
    own[LED] += min(p[CLIMB] * dt, max(-p[CLIMB] * dt, setpoint[SET_VEL + 2] - own[LED]))
    for i in range(3):
        k, ki = (p[KVZ], p[KIZ]) if i == 2 else (p[KV], p[KI])
        error = (own[LED] if i == 2 else setpoint[SET_VEL + i]) - own[EST_VEL + i]
        own[INTEGRAL + i] = min(4.0, max(-4.0, own[INTEGRAL + i] + ki * error * dt))
        a[i] = k * error + own[INTEGRAL + i]
    # Up is bounded by the thrust there is, down by what keeps the rotors turning.
    a[2] = min(0.7 * p[GRAVITY], max(-0.6 * (p[RATIO] - 1.0) * p[GRAVITY], a[2]))
    lift = p[GRAVITY] - a[2]
    limit = lift * math.tan(setpoint[SET_TILT])
    level = math.sqrt(a[0] * a[0] + a[1] * a[1])
    if level > limit:
        for i in range(2):
            # The integral does not wind up beyond what the bound lets through.
            own[INTEGRAL + i] -= p[KI] * (setpoint[SET_VEL + i] - own[EST_VEL + i]) * dt
            a[i] *= limit / level
    R = _rotation(own[EST_QUAT : EST_QUAT + 4])
    up = math.sqrt(a[0] * a[0] + a[1] * a[1] + lift * lift)
    # Wanted body axes: b3 along -thrust, b1 towards the yaw.
    b3 = np.array([-a[0] / up, -a[1] / up, lift / up])
    c, s = math.cos(setpoint[SET_YAW]), math.sin(setpoint[SET_YAW])
    b2 = np.array([-b3[2] * s, b3[2] * c, b3[0] * s - b3[1] * c])
    b2 /= math.sqrt(b2[0] * b2[0] + b2[1] * b2[1] + b2[2] * b2[2])
    b1 = np.array(
        [b2[1] * b3[2] - b2[2] * b3[1], b2[2] * b3[0] - b2[0] * b3[2], b2[0] * b3[1] - b2[1] * b3[0]]
    )
    # The turn from R to W = [b1 b2 b3]: half the vee of R' W - W' R.
    e = np.zeros(3)
    for i in range(3):
        e[0] += 0.5 * (R[i, 2] * b2[i] - R[i, 1] * b3[i])
        e[1] += 0.5 * (R[i, 0] * b3[i] - R[i, 2] * b1[i])
        e[2] += 0.5 * (R[i, 1] * b1[i] - R[i, 0] * b2[i])
    drive[0] = 0.0
    for i in range(3):
        ka, kr = (p[KAZ], p[KRZ]) if i == 2 else (p[KA], p[KR])
        drive[1 + i] = kr * (ka * e[i] - gyro[i])
        drive[0] -= R[i, 2] * (a[i] if i < 2 else -lift)
    drive[0] = min(p[RATIO] * p[GRAVITY], max(0.1 * p[GRAVITY], drive[0]))


def _legs(x: Array, R: Array, deck: Array, p: Array, force: Array, torque: Array) -> tuple[float, float]:
    """Add the legs' force (NED) and torque (body); return the load on them [N] and the speed into the deck [m/s].

    The speed is that of the foot that touches first, along the deck's normal, and NaN where none touches.
    """
    load, speed = 0.0, math.nan
    n, dn = deck[6:9], deck[9:12]
    turn = np.array([n[1] * dn[2] - n[2] * dn[1], n[2] * dn[0] - n[0] * dn[2], n[0] * dn[1] - n[1] * dn[0]])
    for k in range(4):
        arm = np.array([p[FEET] if k < 2 else -p[FEET], p[FEET] if k % 2 == 0 else -p[FEET], p[GEAR]])
        w = x[RATE : RATE + 3]
        spin = np.array(
            [w[1] * arm[2] - w[2] * arm[1], w[2] * arm[0] - w[0] * arm[2], w[0] * arm[1] - w[1] * arm[0]]
        )
        r, v = np.empty(3), np.empty(3)
        for i in range(3):
            r[i] = x[POS + i] + R[i, 0] * arm[0] + R[i, 1] * arm[1] + R[i, 2] * arm[2] - deck[i]
            v[i] = x[VEL + i] + R[i, 0] * spin[0] + R[i, 1] * spin[1] + R[i, 2] * spin[2] - deck[3 + i]
        deep = r[0] * n[0] + r[1] * n[1] + r[2] * n[2]
        if deep <= 0.0 or abs(r[0]) > p[DECK_HALF] or abs(r[1]) > p[DECK_HALF] or deep > 0.5:
            continue
        v[0] -= turn[1] * r[2] - turn[2] * r[1]
        v[1] -= turn[2] * r[0] - turn[0] * r[2]
        v[2] -= turn[0] * r[1] - turn[1] * r[0]
        into = v[0] * n[0] + v[1] * n[1] + v[2] * n[2]
        if not speed >= into:
            speed = into
        press = max(0.0, p[STIFF] * deep + p[DAMP] * into)
        load += press
        slide = v - into * n
        rub = math.sqrt(slide[0] * slide[0] + slide[1] * slide[1] + slide[2] * slide[2])
        grip = min(p[FRICTION] * press / rub if rub > 1e-9 else 0.0, 2.0 * p[DAMP])
        f = np.empty(3)
        for i in range(3):
            f[i] = -press * n[i] - grip * slide[i]
            force[i] += f[i]
        b = np.empty(3)
        for i in range(3):
            b[i] = R[0, i] * f[0] + R[1, i] * f[1] + R[2, i] * f[2]
        torque[0] += arm[1] * b[2] - arm[2] * b[1]
        torque[1] += arm[2] * b[0] - arm[0] * b[2]
        torque[2] += arm[0] * b[1] - arm[1] * b[0]
    return load, speed


def advance(
    x: Array, own: Array, setpoint: Array, wind: Array, deck: Array, held: bool, p: Array, truth: Array,
    trail: Array, contact: Array,
) -> None:  # fmt: skip
    """Integrate over as many steps as ``truth`` (n, 16) has rows, writing the state at the begin of each, and what the
    autopilot takes velocity and attitude to be into ``trail`` (n, 7).

    ``deck`` (n, 12) are the deck's rows at these times, ``wind`` (3,) blows all the while; ``held`` keeps the vehicle
    where it is (it stands on firm ground). At the first touch of the deck ``contact`` (4,) gets the step's number, the
    speed into the deck, and the place relative to its centre, north and east; its first entry is below 0 before.
    """
    dt = 1.0 / STEP_HZ
    wanted = np.zeros(4)
    for k in range(truth.shape[0]):
        R = _rotation(x[QUAT : QUAT + 4])
        force, torque = np.zeros(3), np.zeros(3)
        air = np.empty(3)
        for i in range(3):
            air[i] = _along(R, i, x[VEL : VEL + 3] - wind)
        loaded = 0.0
        if not held:
            loaded, speed = _legs(x, R, deck[k], p, force, torque)
            if contact[0] < 0.0 and not math.isnan(speed):
                contact[0], contact[1] = k, speed
                contact[2], contact[3] = x[POS] - deck[k, 0], x[POS + 1] - deck[k, 1]
        # Specific force in the body: thrust (with ground effect), drag and legs.
        height = max(-(x[POS + 2] - deck[k, 2]), p[ROTOR])
        over = abs(x[POS] - deck[k, 0]) < p[DECK_HALF] and abs(x[POS + 1] - deck[k, 1]) < p[DECK_HALF]
        near = p[ROTOR] / (4.0 * height)
        cushion = 1.0 / (1.0 - near * near) if over else 1.0
        f = np.empty(3)
        for i in range(3):
            drag = p[DRAG_Z] if i == 2 else p[DRAG]
            f[i] = -drag * air[i] + _along(R, i, force) / p[MASS]
        f[2] -= x[DRIVE] * cushion
        if held:
            for i in range(3):
                f[i] = -p[GRAVITY] * R[2, i]
        truth[k, :13] = x[:13]
        truth[k, 13:16] = f
        trail[k] = own[:7]
        # The autopilot's own: carry velocity and attitude on, control.
        E = _rotation(own[EST_QUAT : EST_QUAT + 4])
        for i in range(3):
            own[EST_VEL + i] += (E[i, 0] * f[0] + E[i, 1] * f[1] + E[i, 2] * f[2]) * dt
        own[EST_VEL + 2] += p[GRAVITY] * dt
        own[EST_QUAT : EST_QUAT + 4] = _turned(own[EST_QUAT : EST_QUAT + 4], x[RATE : RATE + 3], dt)
        stands = loaded > LEGS_SHARE * p[MASS] * p[GRAVITY] and setpoint[SET_VEL + 2] > 0.0
        own[LOADED] = own[LOADED] + dt if stands else 0.0
        _control(own, setpoint, x[RATE : RATE + 3], dt, p, wanted)
        for i in range(4):
            x[DRIVE + i] += (wanted[i] - x[DRIVE + i]) * (1.0 - math.exp(-dt / p[LAG]))
        if held:
            x[VEL : VEL + 3] = 0.0
            x[RATE : RATE + 3] = 0.0
            continue
        w = x[RATE : RATE + 3].copy()
        J = p[1:4]
        swirl = np.array(
            [(J[1] - J[2]) * w[1] * w[2], (J[2] - J[0]) * w[2] * w[0], (J[0] - J[1]) * w[0] * w[1]]
        )
        for i in range(3):
            x[RATE + i] += (x[DRIVE + 1 + i] + (torque[i] + swirl[i]) / J[i]) * dt
            gravity = p[GRAVITY] if i == 2 else 0.0
            x[VEL + i] += (R[i, 0] * f[0] + R[i, 1] * f[1] + R[i, 2] * f[2] + gravity) * dt
        for i in range(3):
            x[POS + i] += x[VEL + i] * dt
        x[QUAT : QUAT + 4] = _turned(x[QUAT : QUAT + 4], x[RATE : RATE + 3], dt)


def compiled() -> Callable[..., None]:
    """Return ``advance``, compiled where numba is installed."""
    if importlib.util.find_spec("numba") is None:
        return advance
    import numba
    from numba.extending import register_jitable

    from estimation.codecache import cache_of

    for helper in (_rotation, _turned, _along, _control, _legs):
        register_jitable(helper)
    settings: Any = numba.config
    before, folder = settings.CACHE_DIR, cache_of([Path(__file__)])
    try:
        if folder is not None:
            settings.CACHE_DIR = str(folder)
        made: Callable[..., None] = numba.njit(cache=folder is not None, error_model="numpy")(advance)
        return made
    finally:
        settings.CACHE_DIR = before

"""The simulated vehicle as an autopilot shows itself on MAVLink: modes, sensors, set-points; no socket and no clock.

It flies on an estimate of its own (the truth with the errors that an autopilot's EKF has), not on the companion's, so
that whoever guides it over the link is in the same place as beside a real one:

- after standing still it takes off by itself and changes to GUIDED, in which it flies the velocities that it is sent
  and hovers when none came for half a second;
- in LAND it goes down at 0.5 m/s through its own height, sideways towards the last LANDING_TARGET, and not down while
  that is more than 2.5 m away; on the deck it stops its motors;
- it streams a message only once it was asked for (SET_MESSAGE_INTERVAL), and answers TIMESYNC and parameters.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from estimation.estimator import EngineName
from estimation.events import (
    AUTOPILOT,
    Barometer,
    Event,
    GpsPosition,
    GpsVelocity,
    Imu,
    Magnetometer,
    TimeSync,
)
from estimation.frames import Array, quat_exp, quat_multiply, quat_to_matrix
from estimation.modes import Decision, Progress, Situation
from simulation import vehicle as body
from simulation.instruments import Instant
from simulation.mission import Mission
from simulation.world import LEGS_LOADED_S, SETPOINT_TIMEOUT_S, TICK_S, World

STABILIZE, GUIDED, LAND = 0, 4, 9
HEARTBEAT_S = 1.0
ASK_TIME_S = 10.0
TAKE_OFF_MPS = 1.5
LAND_RATE_MPS = 0.5
FAR_M = 2.5
TARGET_LOST_S = 2.0
_GAIN = 0.8
_FASTEST_MPS = 1.0
_IDS = {
    105: "HIGHRES_IMU",
    30: "ATTITUDE",
    24: "GPS_RAW_INT",
    29: "SCALED_PRESSURE",
    245: "EXTENDED_SYS_STATE",
}
_ON_GROUND, _IN_AIR, _TAKING_OFF = 1, 2, 3
_OWN_ERRORS = ((0.05, 20.0), (2.5e-3, 20.0), (2.5e-3, 20.0), (0.02, 60.0))
"""1-sigma and correlation time of the autopilot's own velocity [m/s, per axis], roll, pitch and yaw [rad, s]."""
_PARAMETERS = {
    "PLND_ENABLED": 1.0,
    "PLND_TYPE": 1.0,
    "PLND_LAG": 0.02,
    "INS_GYRO_FILTER": 0.0,
    "INS_ACCEL_FILTER": 0.0,
}


def _no_guidance(progress: Progress, seen: Situation, c: Any) -> tuple[Progress, Decision]:
    raise AssertionError("the vehicle is guided over its link")


@dataclass(slots=True)
class Lens:
    """The camera of a vehicle whose images are looked at elsewhere: hands on the moment of each picture."""

    take: Callable[[Instant], None]

    def __call__(self, now: Instant) -> bool:
        """Hand on the moment of a picture, which is no message of the vehicle's own."""
        self.take(now)
        return False


@dataclass(slots=True)
class Autopilot(World):
    """The vehicle of a mission and its MAVLink face.

    ``outbox`` collects the messages of a tick; ``receive`` takes one of the companion's. ``mode`` is ArduCopter's.
    """

    mode: int = STABILIZE
    armed: bool = True
    outbox: list[Any] = field(default_factory=list)
    messages: Any = None
    asked: bool = False
    targets: int = 0
    set_points: int = 0
    _every_s: dict[str, float] = field(default_factory=dict)
    _due_s: dict[str, float] = field(default_factory=dict)
    _field_t: Array = field(default_factory=lambda: np.zeros(3))
    _fix: GpsPosition | None = None
    _commanded: tuple[float, Array, float] | None = None
    _target: tuple[float, Array] | None = None
    _errors: Array = field(default_factory=lambda: np.zeros(6))
    _error_rng: np.random.Generator = field(default_factory=lambda: np.random.default_rng(0))

    @classmethod
    def of(cls, mission: Mission, seed: int, lens: Lens, engine: EngineName) -> Autopilot:
        """Return the vehicle of a mission; ``lens`` is told the moment of each picture."""
        from pymavlink.dialects.v20 import ardupilotmega

        made = cls(mission, seed, engine, _no_guidance, lens)
        made.messages = ardupilotmega
        made._error_rng = np.random.default_rng([seed, 77])
        return made

    @property
    def landed_state(self) -> int:
        """EXTENDED_SYS_STATE's: on the ground with weight on the legs, taking off, or in the air."""
        if self.t_s < self.mission.rest_s or self._own[body.LOADED] > LEGS_LOADED_S:
            return _ON_GROUND
        return _TAKING_OFF if self.t_s < self._air_s else _IN_AIR

    @property
    def _air_s(self) -> float:
        return self.mission.rest_s + self.mission.take_off_s

    def clock_ns(self, t_s: float) -> int:
        """Return what the autopilot's clock shows at a true time."""
        return int(self.instruments.stamp_ns(AUTOPILOT, np.array([t_s]))[0])

    def still(self) -> Instant:
        """Return the moment before the flight: the vehicle where it stands."""
        q = self._x[body.QUAT : body.QUAT + 4].copy()
        place, speed = self._x[:3].copy(), np.zeros(3)
        deck = self._deck[0]
        return Instant(0.0, place, speed, q, quat_to_matrix(q), speed, speed, deck[:3], deck[6:9])

    # -- the flight ------------------------------------------------------------------------------------------------

    def _take_in(self) -> None:
        for event in self.instruments.until(self.t_s):
            self._send_sensor(event)
        self._say_more()
        self._know()

    def _know(self) -> None:
        """Set the autopilot's own velocity and attitude to the truth with its slow errors."""
        for k in range(6):
            sigma, time = _OWN_ERRORS[0] if k < 3 else _OWN_ERRORS[k - 2]
            keep = math.exp(-TICK_S / time)
            push = sigma * math.sqrt(1.0 - keep * keep) * self._error_rng.standard_normal()
            self._errors[k] = keep * self._errors[k] + push
        self._own[:3] = self._x[body.VEL : body.VEL + 3] + self._errors[:3]
        q = self._x[body.QUAT : body.QUAT + 4]
        self._own[3:7] = quat_multiply(q / np.linalg.norm(q), quat_exp(self._errors[3:]))

    def _decide(self) -> None:
        if self.t_s < self.mission.rest_s:
            return
        if self.t_s < self._air_s:
            self._set[:3] = 0.0, 0.0, -TAKE_OFF_MPS
            return
        if self.mode == STABILIZE:
            self.mode = GUIDED
        loaded = self._own[body.LOADED] > LEGS_LOADED_S
        if self.mode == LAND and loaded:
            self.armed = False
        self._set[body.SET_MOTORS] = float(self.armed)
        if self.mode == LAND:
            self._set[:3] = self._landing_velocity()
            return
        velocity = np.zeros(3)
        if self._commanded is not None and self.t_s - self._commanded[0] <= SETPOINT_TIMEOUT_S:
            velocity = self._commanded[1]
            self._set[body.SET_YAW] = self._commanded[2]
        self._set[:3] = velocity

    def _landing_velocity(self) -> Array:
        velocity = np.array([0.0, 0.0, LAND_RATE_MPS])
        if self._target is None or self.t_s - self._target[0] > TARGET_LOST_S:
            return velocity
        offset = (quat_to_matrix(self._own[3:7]) @ self._target[1])[:2]
        away = float(np.hypot(offset[0], offset[1]))
        velocity[:2] = _GAIN * offset * min(1.0, _FASTEST_MPS / max(_GAIN * away, 1e-9))
        if away > FAR_M:
            velocity[2] = 0.0
        return velocity

    def _judge(self) -> None:
        if self._x[2] > 0.5 and self._contact is None:
            self.end = "in the water"
        elif not self.armed:
            self._ended_s = self.t_s if self._ended_s is None else self._ended_s
            if self.t_s - self._ended_s >= 2.0:
                self.end = "landed" if self._contact is not None else "disarmed in the air"
        elif self.t_s >= self.mission.longest_s - TICK_S:
            self.end = "time is up"

    # -- what it says ----------------------------------------------------------------------------------------------

    def _streams(self, name: str, at_s: float) -> bool:
        """Tell whether a message of a kind goes out at a time: it was asked for, and its turn has come."""
        every = self._every_s.get(name)
        if every is None:
            return False
        due = self._due_s.get(name, 0.0)
        if at_s < due - 1e-3:
            return False
        self._due_s[name] = max(due + every, at_s - every)
        return True

    def _send_sensor(self, event: Event) -> None:
        if isinstance(event, TimeSync):
            return  # the companion asks by itself
        m, at_s, us = self.messages, 1e-9 * event.stamp_ns, event.stamp_ns // 1000
        match event:
            case Magnetometer():
                self._field_t = np.array(event.field_t)
            case Imu() if self._streams("HIGHRES_IMU", at_s):
                f, w, b = event.specific_force_mps2, event.angular_velocity_radps, 1e4 * self._field_t
                self.outbox.append(
                    m.MAVLink_highres_imu_message(us, *f, *w, *b.tolist(), 0.0, 0.0, 0.0, 20.0, 0x1FF)
                )
            case Barometer() if self._streams("SCALED_PRESSURE", at_s):
                self.outbox.append(
                    m.MAVLink_scaled_pressure_message(us // 1000, 0.01 * event.pressure_pa, 0.0, 1500)
                )
            case GpsPosition():
                self._fix = event
            case GpsVelocity() if self._fix is not None and self._streams("GPS_RAW_INT", at_s):
                self.outbox.append(self._satellite(self._fix, event, us))

    def _satellite(self, fix: GpsPosition, speed: GpsVelocity, us: int) -> Any:
        place = [fix.latitude_rad, fix.longitude_rad, fix.altitude_m]
        c = self.mission.drawn.gps
        north, east = speed.velocity_ned_mps[:2]
        course = math.degrees(math.atan2(east, north)) % 360.0
        height = round(1e3 * place[2])
        accuracy = [round(1e3 * math.hypot(a, b)) for a, b in (
            (c.position_sigma_m, c.bias_sigma_m if c.bias else 0.0),
            (c.height_sigma_m, c.height_bias_sigma_m if c.bias else 0.0),
        )]  # fmt: skip
        return self.messages.MAVLink_gps_raw_int_message(
            us, 3, round(1e7 * math.degrees(place[0])), round(1e7 * math.degrees(place[1])), height, 80, 80,
            round(1e2 * math.hypot(north, east)), round(1e2 * course) % 36000, 12, height, *accuracy,
            round(1e3 * c.velocity_sigma_mps), 0, 0,
        )  # fmt: skip

    def _say_more(self) -> None:
        """Send what no instrument draws: the autopilot's own attitude and its state."""
        m = self.messages
        ms = self.clock_ns(self.t_s) // 1_000_000
        if self._streams("ATTITUDE", self.t_s):
            R = quat_to_matrix(self._own[3:7])
            roll, pitch = math.atan2(R[2, 1], R[2, 2]), -math.asin(max(-1.0, min(1.0, R[2, 0])))
            rate = self._x[body.RATE : body.RATE + 3]
            self.outbox.append(
                m.MAVLink_attitude_message(ms, roll, pitch, math.atan2(R[1, 0], R[0, 0]), *rate.tolist())
            )
        if self._streams("EXTENDED_SYS_STATE", self.t_s):
            self.outbox.append(m.MAVLink_extended_sys_state_message(0, self.landed_state))

    def heartbeat(self) -> Any:
        """Return the heartbeat of now."""
        mode = 1 | (128 if self.armed else 0)
        return self.messages.MAVLink_heartbeat_message(2, 3, mode, self.mode, 4, 3)

    # -- what it is told -------------------------------------------------------------------------------------------

    def receive(self, message: Any, t_s: float) -> list[Any]:
        """Take a message of the companion's at a true time, and return the answers."""
        m = self.messages
        match message.get_type():
            case "TIMESYNC" if message.tc1 == 0:
                return [m.MAVLink_timesync_message(self.clock_ns(t_s), message.ts1)]
            case "PARAM_REQUEST_READ" if message.param_id in _PARAMETERS:
                value = _PARAMETERS[message.param_id]
                return [
                    m.MAVLink_param_value_message(message.param_id.encode(), value, 9, len(_PARAMETERS), 0)
                ]
            case "COMMAND_LONG":
                return [m.MAVLink_command_ack_message(message.command, self._obey(message))]
            case "SET_POSITION_TARGET_LOCAL_NED" if self.mode == GUIDED:
                self.set_points += 1
                velocity = np.array([message.vx, message.vy, message.vz])
                if np.isfinite(velocity).all() and not message.type_mask & 0b111000:
                    yaw = (
                        float(message.yaw) if not message.type_mask & 1024 else float(self._set[body.SET_YAW])
                    )
                    self._commanded = self.t_s, velocity, yaw
            case "LANDING_TARGET" if (
                message.frame == 12 and message.position_valid and message.distance > 0.0
            ):
                self.targets += 1
                self._target = self.t_s, np.array([message.x, message.y, message.z])
        return []

    def _obey(self, message: Any) -> int:
        """Obey a command; return its MAV_RESULT."""
        match message.command:
            case 511:
                name = _IDS.get(int(message.param1))
                if name is None:
                    return 2
                self.asked = True
                if message.param2 > 0.0:
                    self._every_s[name] = max(1e-6 * message.param2, 1.0 / self.mission.streams.imu.rate_hz)
                else:
                    self._every_s.pop(name, None)
                return 0
            case 176:
                self.mode = int(message.param2)
                return 0
            case 400:
                self.armed = bool(message.param1)
                return 0
            case _:
                return 3

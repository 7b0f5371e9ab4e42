"""An autopilot for tests, on the loopback: a vehicle that hangs still over the deck and speaks when it is asked."""

from __future__ import annotations

import socket
import threading
import time
from collections import Counter
from typing import Any

import numpy as np

HOME = (63.4394, 10.3986, 0.0)
HEIGHT_M = 3.0
GRAVITY = 9.8214
BOOT_S = 30.0
IDS = {105: "HIGHRES_IMU", 30: "ATTITUDE", 24: "GPS_RAW_INT", 29: "SCALED_PRESSURE", 245: "EXTENDED_SYS_STATE",
       132: "DISTANCE_SENSOR"}  # fmt: skip
CONFIG = f"""
[origin]
latitude_deg = {HOME[0]}
longitude_deg = {HOME[1]}
altitude_m = {HOME[2]}
[platform]
use = true
learn_s = 0.0
[initialisation]
rest_s = 0.5
"""


class ScriptedAutopilot:
    """Sends to a UDP port what it was asked for; keeps what it was sent."""

    def __init__(self, port: int, *, system: int = 1, seed: int = 1, key: bytes | None = None) -> None:
        from pymavlink.dialects.v20 import ardupilotmega

        self.messages: Any = ardupilotmega
        self.wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.wire.setblocking(False)
        self.address = ("127.0.0.1", port)
        self.protocol = ardupilotmega.MAVLink(None, system, 1)
        self.parser = ardupilotmega.MAVLink(None, system, 1)
        if key is not None:
            self.protocol.signing.secret_key = key
            self.protocol.signing.sign_outgoing = True
            self.protocol.signing.timestamp = int((time.time() - 1_420_070_400) * 1e5)
        self.rng = np.random.default_rng(seed)
        self.begin_s = time.monotonic()
        self.mode, self.armed, self.landed_state = 5, True, 2
        self.silent = self.mute_imu = False
        self.parameters = {"INS_GYRO_FILTER": 20.0, "INS_ACCEL_FILTER": 20.0, "PLND_ENABLED": 1.0,
                           "PLND_TYPE": 1.0, "PLND_LAG": 0.02}  # fmt: skip
        self.every_s: dict[str, float] = {}
        self.got: list[tuple[float, Any]] = []
        self.raw: list[bytes] = []
        self.sent: Counter[str] = Counter()
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def __enter__(self) -> ScriptedAutopilot:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(2.0)
        self.wire.close()

    def heard(self, name: str) -> list[Any]:
        return [m for _, m in list(self.got) if m.get_type() == name]

    def boot_us(self) -> int:
        return round((time.monotonic() - self.begin_s + BOOT_S) * 1e6)

    def packed(self, message: Any) -> bytes:
        return bytes(message.pack(self.protocol))

    def send(self, message: Any) -> None:
        self.sent[message.get_type()] += 1
        self.wire.sendto(self.packed(message), self.address)
        self.protocol.seq = (self.protocol.seq + 1) % 256

    def imu(self, boot_us: int, **changes: float) -> Any:
        w, f = 1e-3 * self.rng.standard_normal(3), 0.02 * self.rng.standard_normal(3)
        fields = {
            "xacc": f[0], "yacc": f[1], "zacc": f[2] - GRAVITY, "xgyro": w[0], "ygyro": w[1], "zgyro": w[2],
            "xmag": 0.14, "ymag": 0.0, "zmag": 0.5, "abs_pressure": 0.0, "diff_pressure": 0.0,
            "pressure_alt": 0.0, "temperature": 20.0,
        }  # fmt: skip
        return self.messages.MAVLink_highres_imu_message(boot_us, *{**fields, **changes}.values(), 0x1FF)

    def _run(self) -> None:
        due = {"HEARTBEAT": 0.0}
        while not self._stop.wait(0.002):
            self._listen()
            now = time.monotonic()
            for name, every in {"HEARTBEAT": 0.5, **self.every_s}.items():
                at = due.setdefault(name, now)
                if now >= at:
                    due[name] = max(at + every, now - 0.5)
                    if not self.silent and not (self.mute_imu and name == "HIGHRES_IMU"):
                        self.send(self._made(name))

    def _made(self, name: str) -> Any:
        m, us = self.messages, self.boot_us()
        match name:
            case "HEARTBEAT":
                return m.MAVLink_heartbeat_message(2, 3, 129 if self.armed else 1, self.mode, 4, 3)
            case "HIGHRES_IMU":
                return self.imu(us)
            case "ATTITUDE":
                return m.MAVLink_attitude_message(us // 1000, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0)
            case "GPS_RAW_INT":
                return m.MAVLink_gps_raw_int_message(
                    us, 3, round(HOME[0] * 1e7), round(HOME[1] * 1e7), round(HEIGHT_M * 1e3), 80, 80, 0, 0, 12,
                    round(HEIGHT_M * 1e3), 500, 800, 200, 0, 0,
                )  # fmt: skip
            case "SCALED_PRESSURE":
                pressure = 1013.25 * (1.0 - 0.0065 * HEIGHT_M / 288.15) ** 5.2559
                pressure += 0.005 * self.rng.standard_normal()
                return m.MAVLink_scaled_pressure_message(us // 1000, pressure, 0.0, 1500)
            case "DISTANCE_SENSOR":
                return m.MAVLink_distance_sensor_message(
                    us // 1000, 20, 3000, round(HEIGHT_M * 100), 0, 0, 25, 255
                )
            case _:
                return m.MAVLink_extended_sys_state_message(0, self.landed_state)

    def _listen(self) -> None:
        while True:
            try:
                data, _ = self.wire.recvfrom(65535)
            except OSError:
                return
            self.raw.append(data)
            for message in self.parser.parse_buffer(data) or []:
                self.got.append((time.monotonic(), message))
                if not self.silent:
                    self._answer(message)

    def _answer(self, message: Any) -> None:
        m = self.messages
        match message.get_type():
            case "TIMESYNC" if message.tc1 == 0:
                self.send(m.MAVLink_timesync_message(self.boot_us() * 1000, message.ts1))
            case "PARAM_REQUEST_READ" if message.param_id in self.parameters:
                value = self.parameters[message.param_id]
                self.send(m.MAVLink_param_value_message(message.param_id.encode(), value, 9, 5, 0))
            case "COMMAND_LONG" if message.command == 511:
                name = IDS.get(int(message.param1))
                if name is not None:
                    self.every_s[name] = message.param2 * 1e-6
                self.send(m.MAVLink_command_ack_message(511, 0 if name else 2))
            case "COMMAND_LONG" if message.command == 176:
                self.mode = int(message.param2)

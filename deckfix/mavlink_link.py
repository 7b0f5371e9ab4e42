"""The link to the autopilot: what it says becomes events, what it must know is sent, and the clocks are compared.

Only one system is listened to: the one asked for, or the first autopilot whose heartbeat comes; on UDP also only
from its address, while it speaks. With a signing key only frames with a right signature count. All that is turned
away is counted (``counts``) and goes no further.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

from deckfix.transport import Transport
from estimation.events import AUTOPILOT, COMPANION, Event, TimeSync
from logs.mavlink_frames import Frame, FrameReader
from logs.mavlink_live import SensorStream

COMPONENT = 191
"""MAV_COMP_ID_ONBOARD_COMPUTER."""
LOST_NS = 2_000_000_000
"""The link is lost when the autopilot has said nothing for so long."""
LONGEST_TRIP_NS = 1_000_000_000
GUIDED = 4
LAND = 9
ARDUPILOT = 3
_INVALID_AUTOPILOT = 8
_NOT_VEHICLES = (6, 18)
_SIGNING_EPOCH_NS = 1_420_070_400_000_000_000
_ON_GROUND, _IN_AIR, _LANDING = 1, 2, 4
_ARMED = 128
_MODES = {
    0: "STABILIZE", 2: "ALT_HOLD", 3: "AUTO", 4: "GUIDED", 5: "LOITER", 6: "RTL", 7: "CIRCLE", 9: "LAND",
    13: "SPORT", 16: "POSHOLD", 17: "BRAKE", 21: "SMART_RTL",
}  # fmt: skip


@dataclass(slots=True)
class Vehicle:
    """What the autopilot last said of itself."""

    system: int = 0
    component: int = 1
    ardupilot: bool = True
    heard_ns: int = 0
    heartbeat_ns: int = 0
    armed: bool = False
    mode: int = -1
    landed_state: int = 0
    parameters: dict[str, float] = field(default_factory=dict)

    @property
    def on_ground(self) -> bool:
        """What its landing detector says."""
        return self.landed_state == _ON_GROUND

    @property
    def in_air(self) -> bool:
        """In the air, and not taking off."""
        return self.landed_state in (_IN_AIR, _LANDING)

    @property
    def mode_name(self) -> str:
        """The flight mode, as ArduCopter calls it."""
        return _MODES.get(self.mode, f"mode {self.mode}") if self.mode >= 0 else "no mode"


@dataclass(slots=True)
class Link:
    """One MAVLink link. ``read`` belongs to one thread; ``send`` and the others may be called from any.

    ``give`` takes the events that come; ``now`` is the companion's clock; ``system`` the only system to listen to (0:
    the first autopilot); ``key`` the signing key (32 bytes).
    """

    wire: Transport
    now: Callable[[], int]
    give: Callable[[Sequence[Event]], None]
    system: int = 0
    key: bytes | None = None
    vehicle: Vehicle = field(default_factory=Vehicle)
    counts: Counter[str] = field(default_factory=Counter)
    sent: Counter[str] = field(default_factory=Counter)
    heard: Counter[str] = field(default_factory=Counter)
    sensors: SensorStream = field(default_factory=SensorStream)
    texts: deque[tuple[int, int, str]] = field(default_factory=lambda: deque(maxlen=200))
    bytes_in: int = 0
    frames: int = 0
    broken: str = ""
    messages: Any = None
    _reader: FrameReader = field(default_factory=FrameReader)
    _asked: dict[int, int] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _protocol: Any = None

    def __post_init__(self) -> None:
        """Prepare the writing side."""
        from pymavlink.dialects.v20 import ardupilotmega

        self.messages = ardupilotmega
        self._protocol = ardupilotmega.MAVLink(None, self.system or 1, COMPONENT)
        if self.key is not None:
            signing = self._protocol.signing
            signing.secret_key, signing.sign_outgoing, signing.link_id = self.key, True, COMPONENT
            signing.timestamp = max(0, self.now() - _SIGNING_EPOCH_NS) // 10_000

    @property
    def alive(self) -> bool:
        """True while the autopilot speaks."""
        return self.vehicle.heard_ns > 0 and self.now() - self.vehicle.heard_ns < LOST_NS

    # -- reading -----------------------------------------------------------------------------------------------

    def read(self, timeout_s: float) -> None:
        """Take what has come, waiting at most so long for it. A wire that breaks is noted in ``broken``."""
        if self.broken:
            threading.Event().wait(timeout_s)
            return
        try:
            data = self.wire.receive(timeout_s)
        except ConnectionError as error:
            self.broken = str(error)
            return
        if not data:
            return
        now = self.now()
        self.bytes_in += len(data)
        if self.wire.foreign() and self.alive:
            self.counts["foreign address"] += 1
            return
        before = self._reader.garbage
        frames = self._reader.datagram(data) if self.wire.datagrams else self._reader.stream(data)
        if self._reader.garbage > before:
            self.counts["garbage bytes"] += self._reader.garbage - before
        self.frames += len(frames)
        for frame in frames:
            self._take(frame, now)

    def _take(self, frame: Frame, now: int) -> None:
        if self.key is not None and not self._signed(frame):
            return
        vehicle = self.vehicle
        if not vehicle.system:
            if frame.name != "HEARTBEAT" or not self._is_autopilot(frame):
                return
            vehicle.system, vehicle.component = frame.system, frame.component
            vehicle.ardupilot = int(frame.row["autopilot"][0]) == ARDUPILOT
            self.sensors.ardupilot = vehicle.ardupilot
            with self._lock:
                self._protocol.srcSystem = frame.system
            self.wire.accept()
        if frame.system != vehicle.system:
            self.counts["foreign system"] += 1
            return
        if frame.component != vehicle.component:
            return
        if self.wire.foreign():
            self.wire.accept()  # it was silent, and speaks from another address now
        vehicle.heard_ns = now
        self.heard[frame.name] += 1
        match frame.name:
            case "HEARTBEAT":
                vehicle.heartbeat_ns = now
                vehicle.armed = bool(frame.row["base_mode"][0] & _ARMED)
                vehicle.mode = int(frame.row["custom_mode"][0])
            case "TIMESYNC":
                self._timesync(int(frame.row["tc1"][0]), int(frame.row["ts1"][0]), now)
            case "EXTENDED_SYS_STATE":
                vehicle.landed_state = int(frame.row["landed_state"][0])
            case "PARAM_VALUE":
                name = frame.row["param_id"][0].decode(errors="replace")
                vehicle.parameters[name] = float(frame.row["param_value"][0])
            case "STATUSTEXT":
                text = frame.row["text"][0].decode(errors="replace")
                self.texts.append((now, int(frame.row["severity"][0]), text))
            case "COMMAND_ACK":
                if int(frame.row["command"][0]) == 511 and int(frame.row["result"][0]) != 0:
                    self.counts["stream requests denied"] += 1
            case _:
                before = self.sensors.guard.restarts
                events = self.sensors.take(frame.name, frame.row, now)
                if self.sensors.guard.restarts > before:
                    self.counts["autopilot restarts"] += 1
                if events:
                    self.give(events)

    def _is_autopilot(self, frame: Frame) -> bool:
        if self.system and frame.system != self.system:
            self.counts["foreign system"] += 1
            return False
        kind, autopilot = int(frame.row["type"][0]), int(frame.row["autopilot"][0])
        return autopilot != _INVALID_AUTOPILOT and kind not in _NOT_VEHICLES

    def _signed(self, frame: Frame) -> bool:
        if not frame.signed:
            self.counts["unsigned"] += 1
            return False
        with self._lock:
            right = self._protocol.check_signature(bytearray(frame.raw), frame.system, frame.component)
        if not right:
            self.counts["wrong signature"] += 1
        return bool(right)

    def _timesync(self, tc1: int, ts1: int, now: int) -> None:
        """Answer the autopilot's question, or take its answer to one of ours."""
        if tc1 == 0:
            self.send(self.messages.MAVLink_timesync_message(self.now(), ts1))
            return
        sent = self._asked.pop(ts1, None)
        if sent is None or not 0 <= now - sent < LONGEST_TRIP_NS:
            self.counts["timesync of others"] += 1
            return
        delay = self.sensors.guard.delay_ns
        if delay is not None and abs(now - delay - tc1) > LONGEST_TRIP_NS:
            self.counts["timesync off"] += 1
            return
        self.give([TimeSync(sent, tc1, now, now, "timesync", AUTOPILOT, COMPANION)])

    # -- writing -----------------------------------------------------------------------------------------------

    def send(self, message: Any) -> bool:
        """Send a message (MAVLink 2, signed where there is a key); False where the wire takes nothing now."""
        with self._lock:
            packet = bytes(message.pack(self._protocol))
            self._protocol.seq = (self._protocol.seq + 1) % 256
        done = not self.broken and self.wire.send(packet)
        (self.sent if done else self.counts)[message.get_type() if done else "not sent"] += 1
        return done

    def ask_time(self) -> None:
        """Begin a clock exchange."""
        now = self.now()
        for old in [t for t, sent in list(self._asked.items()) if now - sent > LONGEST_TRIP_NS]:
            self._asked.pop(old, None)
        self._asked[now] = now
        self.send(self.messages.MAVLink_timesync_message(0, now))

    def heartbeat(self, state: int, problems: int) -> None:
        """Say that deckfix is there: its MAV_STATE, and its problems as bits (``deckfix.health``)."""
        self.send(self.messages.MAVLink_heartbeat_message(18, _INVALID_AUTOPILOT, 0, problems, state, 3))

    def say(self, severity: int, text: str) -> None:
        """Send a STATUSTEXT (at most 50 characters)."""
        self.send(self.messages.MAVLink_statustext_message(severity, text.encode()[:50]))

    def command(self, number: int, *parameters: float) -> None:
        """Send a COMMAND_LONG to the autopilot."""
        values = [*parameters, *([0.0] * (7 - len(parameters)))]
        v = self.vehicle
        self.send(self.messages.MAVLink_command_long_message(v.system, v.component, number, 0, *values))

    def request(self, message_id: int, rate_hz: float) -> None:
        """Ask for a message at a rate (SET_MESSAGE_INTERVAL)."""
        self.command(511, float(message_id), 1e6 / rate_hz)

    def ask_parameter(self, name: str) -> None:
        """Ask for a parameter's value."""
        v = self.vehicle
        self.send(self.messages.MAVLink_param_request_read_message(v.system, v.component, name.encode(), -1))

    def close(self) -> None:
        """Let go of the wire."""
        self.wire.close()

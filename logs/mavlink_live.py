"""A live MAVLink link: its sensor messages as events, one at a time, the same as an imported telemetry log gives.

What a link lets in is guarded: a stamp from the future, one that is older than the estimator looks back, and one that
was there before are counted and go no further, so that whoever sends them moves nothing. An autopilot that restarts
is believed once nothing else has come for a while.
"""

from __future__ import annotations

from collections import Counter, deque
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimation.events import Event, Imu
from logs import mavlink_sensors as ms
from logs.events import events_of_series
from logs.recording import Series
from logs.sensors import Times
from logs.stamps import to_ns
from logs.vehicles import IMU_MESSAGES

Rows = NDArray[np.void]

FUTURE_NS = 250_000_000
LATE_NS = 2_000_000_000
BACK_NS = 400_000_000
"""A stamp may be ahead of the clock, behind it, and behind the newest of its message by so much."""
BELIEVE_NS = 3_000_000_000
"""Stamps that fit nothing are believed when nothing else has come for so long."""
CHOOSE_NS = 1_000_000_000
"""How long the messages of inertial sensors are watched before the best of them is taken."""
_UNIX_US = 1_000_000_000_000_000
_REMEMBERED = 512


@dataclass(slots=True)
class StampGuard:
    """Whether a message's stamp since boot fits its arrival and those before it.

    ``delay_ns`` is the smallest arrival less stamp of late. ``restarts`` counts how often the clock was given up for
    another.
    """

    delay_ns: int | None = None
    restarts: int = 0
    _begun_ns: int = 0
    _next_ns: int | None = None
    _heard_ns: int = 0
    _newest: dict[str, int] = field(default_factory=dict)
    _seen: dict[str, deque[int]] = field(default_factory=dict)

    def fault(self, name: str, stamp_ns: int, arrival_ns: int) -> str:
        """Return why a message must go no further (``future``, ``old``, ``repeated``), or nothing."""
        difference = arrival_ns - stamp_ns
        if self.delay_ns is None:
            self._begin(difference, arrival_ns)
        assert self.delay_ns is not None
        fault = ""
        if difference < self.delay_ns - FUTURE_NS:
            fault = "future"
        elif difference > self.delay_ns + LATE_NS:
            fault = "old"
        if fault and arrival_ns - self._heard_ns > BELIEVE_NS:
            self._begin(difference, arrival_ns)
            self.restarts += 1
            fault = ""
        if fault:
            return fault
        newest = self._newest.get(name)
        seen = self._seen.setdefault(name, deque(maxlen=_REMEMBERED))
        if newest is not None and stamp_ns <= newest:
            if stamp_ns in seen:
                return "repeated"
            if stamp_ns < newest - BACK_NS:
                return "old"
        seen.append(stamp_ns)
        self._newest[name] = stamp_ns if newest is None else max(newest, stamp_ns)
        self._heard_ns = arrival_ns
        self._follow(difference, arrival_ns)
        return ""

    def _begin(self, difference: int, arrival_ns: int) -> None:
        self.delay_ns, self._begun_ns, self._next_ns = difference, arrival_ns, None
        self._heard_ns = arrival_ns
        self._newest.clear()
        self._seen.clear()

    def _follow(self, difference: int, arrival_ns: int) -> None:
        """Keep the smallest difference of the last ten to twenty seconds, so that drift is followed."""
        assert self.delay_ns is not None
        self.delay_ns = min(self.delay_ns, difference)
        self._next_ns = difference if self._next_ns is None else min(self._next_ns, difference)
        if arrival_ns - self._begun_ns > 10_000_000_000:
            self.delay_ns, self._next_ns, self._begun_ns = self._next_ns, None, arrival_ns


@dataclass(slots=True)
class _Slow:
    """What was kept of a slow sensor, whose value is sent several times: as ``logs.mavlink`` keeps it."""

    value: bytes = b""
    since_ns: int = 0
    waits: int = 0

    def fresh(self, value: bytes, stamp_ns: int) -> bool:
        if value != self.value:
            self.value, self.since_ns, self.waits = value, stamp_ns, 0
            return True
        waits = (stamp_ns - self.since_ns) // ms.HOLD_NS
        fresh, self.waits = waits > self.waits, waits
        return fresh


@dataclass(slots=True)
class SensorStream:
    """Events out of one autopilot's messages, as they arrive.

    ``ardupilot`` tells whether RAW_IMU has its units. ``counts`` counts the messages used by name, and those turned
    away by reason. ``imu`` names the inertial message that is used, once it is chosen.
    """

    ardupilot: bool = True
    guard: StampGuard = field(default_factory=StampGuard)
    counts: Counter[str] = field(default_factory=Counter)
    imu: str = ""
    undulation_m: float | None = None
    _first_ns: int | None = None
    _offered: set[str] = field(default_factory=set)
    _gauss: float | None = None
    _slow: dict[str, _Slow] = field(default_factory=dict)
    _fix_ns: int = -1
    _range_id: int | None = None
    _attitude: str = ""
    _pressure: str = ""

    @property
    def counts_turned_away(self) -> dict[str, int]:
        """Messages turned away, by reason."""
        return {reason: n for reason, n in self.counts.items() if reason not in _USED}

    def take(self, name: str, row: Rows, arrival_ns: int) -> list[Event]:
        """Return the events of one message (a row of ``logs.tlog.dialect``); none for what is no sensor's."""
        if name not in _USED:
            return []
        stamp = _stamp(row)
        if stamp is None or stamp <= 0:
            self.counts["no time since boot"] += 1
            return []
        if name == "GPS_RAW_INT" and stamp == self._fix_ns:
            return []  # the same fix, sent again
        fault = self.guard.fault(name, stamp, arrival_ns)
        if fault:
            self.counts[fault] += 1
            return []
        self.counts[name] += 1
        times = Times(np.array([stamp]), np.array([arrival_ns]))
        if name in IMU_MESSAGES:
            return self._inertial(name, row, times)
        series: list[Series] = []
        if name == "GPS_RAW_INT":
            self._fix_ns = stamp
            if self.undulation_m is None:
                self.undulation_m = ms.undulation_of(row)
            series = ms.satellite(row, times, self.undulation_m)
        elif name == "SCALED_PRESSURE":
            self._pressure = name
            series = self._air(name, row, times)
        elif name == "DISTANCE_SENSOR":
            series = self._range(row, times)
        elif self._attitude != "ATTITUDE_QUATERNION" or name == self._attitude:
            self._attitude = name
            series = [ms.attitude(name, row, times)]
        return list(events_of_series(series))

    def _inertial(self, name: str, row: Rows, times: Times) -> list[Event]:
        arrival = int(times.arrival_ns[0])
        if not self.imu:
            if name != "RAW_IMU" or self.ardupilot:
                self._offered.add(name)
            self._first_ns = arrival if self._first_ns is None else self._first_ns
            if arrival - self._first_ns < CHOOSE_NS or not self._offered:
                return []
            self.imu = min(self._offered, key=IMU_MESSAGES.index)
        if name != self.imu or not ms.first_imu(name, row)[0]:
            return []
        rate, force = ms.inertial(name, row)
        stamp = int(times.stamp_ns[0])
        w, f = rate[0].tolist(), force[0].tolist()
        events: list[Event] = [Imu(stamp, arrival, (w[0], w[1], w[2]), (f[0], f[1], f[2]))]
        series: list[Series] = []
        if any(row[axis][0] for axis in ("xmag", "ymag", "zmag")):
            if self._gauss is None:
                self._gauss = ms.gauss_factor(row)
            field = ms.magnetic(name, row, self._gauss)
            if self._kept("magnetic").fresh(field.tobytes(), stamp):
                series.append(ms.compass(name, field, times))
        if name == "HIGHRES_IMU" and not self._pressure and row["abs_pressure"][0]:
            series += self._air(name, row, times)
        return events + list(events_of_series(series)) if series else events

    def _air(self, name: str, row: Rows, times: Times) -> list[Series]:
        pressure = ms.pressure(name, row)[0]
        if not self._kept("air").fresh(pressure.tobytes(), int(times.stamp_ns[0])):
            return []
        return ms.air(name, row, times)

    def _range(self, row: Rows, times: Times) -> list[Series]:
        if not ms.downward(row)[0]:
            return []
        if self._range_id is None:
            self._range_id = int(row["id"][0])
        return [ms.ranges(row, times)] if int(row["id"][0]) == self._range_id else []

    def _kept(self, name: str) -> _Slow:
        return self._slow.setdefault(name, _Slow())


_USED = {
    *IMU_MESSAGES,
    "GPS_RAW_INT",
    "SCALED_PRESSURE",
    "DISTANCE_SENSOR",
    "ATTITUDE_QUATERNION",
    "ATTITUDE",
}


def _stamp(row: Rows) -> int | None:
    """Return a message's stamp since boot [ns]; None where it counts from 1970."""
    if "time_boot_ms" in (row.dtype.names or ()):
        return int(row["time_boot_ms"][0]) * 1_000_000
    if row["time_usec"][0] > _UNIX_US:
        return None
    return int(to_ns(row["time_usec"])[0])

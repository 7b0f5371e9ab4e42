"""The messages that the estimator needs from the autopilot, asked for until they come, and asked for again when they
stop: a new link streams nothing but heartbeats, and so does an autopilot that has restarted.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field

from deckfix.mavlink_link import Link

HIGHRES_IMU, RAW_IMU, SCALED_IMU2 = 105, 27, 116
_NAMES = {
    HIGHRES_IMU: "HIGHRES_IMU",
    RAW_IMU: "RAW_IMU",
    SCALED_IMU2: "SCALED_IMU2",
    30: "ATTITUDE",
    24: "GPS_RAW_INT",
    29: "SCALED_PRESSURE",
    132: "DISTANCE_SENSOR",
    245: "EXTENDED_SYS_STATE",
}
_INERTIAL = (HIGHRES_IMU, RAW_IMU, SCALED_IMU2)
PATIENCE = 3
"""After so many requests in vain the next inertial message is asked for."""
ENOUGH = 0.6
"""A message that comes at less than this share of its rate is asked for again."""


@dataclass(slots=True)
class StreamRequests:
    """Asks, every few seconds (``check``), for what does not come at its rate."""

    imu_rate_hz: float = 100.0
    rangefinder: bool = False
    _inertial: int = 0
    _asked: Counter[int] = field(default_factory=Counter)
    _heard: Counter[str] = field(default_factory=Counter)
    _checked_ns: int | None = None

    def wanted(self) -> dict[int, float]:
        """Return the rate [Hz] of each message that is needed."""
        rates = {_INERTIAL[self._inertial]: self.imu_rate_hz, 30: 10.0, 24: 5.0, 29: 10.0, 245: 5.0}
        if self.rangefinder:
            rates[132] = 20.0
        return rates

    def check(self, link: Link, now_ns: int) -> None:
        """Ask for what has come too rarely since the last check."""
        heard, before = Counter(link.heard), self._heard
        span_s = 0.0 if self._checked_ns is None else (now_ns - self._checked_ns) * 1e-9
        self._heard, self._checked_ns = heard, now_ns
        for number, rate in self.wanted().items():
            name = _NAMES[number]
            came = heard[name] - before[name]
            if span_s > 0.0 and came >= ENOUGH * rate * span_s:
                self._asked[number] = 0
                continue
            if number in _INERTIAL and came == 0 and self._asked[number] >= PATIENCE:
                self._inertial = (self._inertial + 1) % len(_INERTIAL)
                self._asked[number] = 0
                number = _INERTIAL[self._inertial]
            self._asked[number] += 1
            link.request(number, rate)

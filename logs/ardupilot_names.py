"""Numbers in ArduPilot's logs that stand for words."""

from __future__ import annotations

from collections.abc import Mapping

ERROR_SUBSYSTEMS: Mapping[int, str] = {
    1: "main", 2: "radio", 3: "compass", 4: "optical flow", 5: "radio failsafe", 6: "battery failsafe",
    7: "GPS failsafe", 8: "ground station failsafe", 9: "fence failsafe", 10: "flight mode", 11: "GPS",
    12: "crash check", 13: "flip", 15: "parachute", 16: "EKF check", 17: "EKF failsafe", 18: "barometer",
    19: "CPU", 20: "ADS-B failsafe", 21: "terrain", 22: "navigation", 23: "terrain failsafe",
    24: "EKF primary", 25: "thrust loss check", 26: "sensors failsafe", 27: "leak failsafe",
    28: "pilot input", 29: "vibration failsafe", 30: "internal error", 31: "dead reckoning failsafe",
}  # fmt: skip
"""``ERR.Subsys``."""

EVENTS: Mapping[int, str] = {
    10: "armed", 11: "disarmed", 15: "auto armed", 17: "land complete maybe", 18: "land complete",
    25: "home set", 28: "not landed", 62: "EKF yaw reset",
}  # fmt: skip
"""``EV.Id``, those that concern an estimate or a landing."""

_COPTER_MODES: Mapping[int, str] = {
    0: "stabilize", 1: "acro", 2: "altitude hold", 3: "auto", 4: "guided", 5: "loiter", 6: "return to launch",
    7: "circle", 9: "land", 11: "drift", 13: "sport", 14: "flip", 15: "autotune", 16: "position hold",
    17: "brake", 18: "throw", 20: "guided without GPS", 21: "smart return to launch",
}  # fmt: skip


def mode_name(number: int, copter: bool) -> str:
    """Return a flight mode's name where it is known, else its number as text."""
    name = _COPTER_MODES.get(number) if copter else None
    return f"{name} ({number})" if name else str(number)

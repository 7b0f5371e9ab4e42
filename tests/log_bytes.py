"""Small logs made byte by byte, for the tests of the importers."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

FMT = ("FMT", 0x80, "BBnNZ", "Type,Length,Name,Format,Columns")
IMU = ("IMU", 163, "QBffffff", "TimeUS,I,GyrX,GyrY,GyrZ,AccX,AccY,AccZ")
GPS = ("GPS", 94, "QBBIHBcLLeffff", "TimeUS,I,Status,GMS,GWk,NSats,HDop,Lat,Lng,Alt,Spd,GCrs,VZ,Yaw")
MSG = ("MSG", 59, "QZ", "TimeUS,Message")
PARM = ("PARM", 32, "QNff", "TimeUS,Name,Value,Default")
BARO = ("BARO", 64, "QBfffc", "TimeUS,I,Alt,AltAMSL,Press,Temp")

_PACKED = {
    "a": "64s", "b": "b", "B": "B", "c": "h", "C": "H", "d": "d", "e": "i", "E": "I", "f": "f", "g": "e",
    "h": "h", "H": "H", "i": "i", "I": "I", "L": "i", "M": "B", "n": "4s", "N": "16s", "q": "q", "Q": "Q",
    "Z": "64s",
}  # fmt: skip

Kind = tuple[str, int, str, str]


def message(kind: Kind, *values: Any) -> bytes:
    """Return one message from its stored (unscaled) values."""
    packed = [v.encode() if isinstance(v, str) else v for v in values]
    return b"\xa3\x95" + bytes([kind[1]]) + struct.pack("<" + "".join(_PACKED[c] for c in kind[2]), *packed)


def definition(kind: Kind) -> bytes:
    """Return the FMT message that defines a kind."""
    length = 3 + struct.calcsize("<" + "".join(_PACKED[c] for c in kind[2]))
    return message(FMT, kind[1], length, kind[0], kind[2], kind[3])


def imu(time_us: int, instance: int = 0, acc_z: float = -9.8) -> bytes:
    return message(IMU, time_us, instance, 0.01, 0.02, 0.03, 0.1, 0.2, acc_z)


def gps(time_us: int, status: int = 3, week: int = 2300, ms: int | None = None) -> bytes:
    at = time_us // 1000 if ms is None else ms
    return message(GPS, time_us, 0, status, at, week, 12, 90, 540000000, 75000000, 1234, 1.5, 90.0, -0.5, 0.0)


def flight(seconds: float = 2.0, rate_hz: int = 100, start_us: int = 1_000_000) -> bytes:
    """Return a small sound log: formats, two parameters, IMU, GPS at 5 Hz, barometer at 10 Hz, one text."""
    parts = [definition(k) for k in (FMT, IMU, GPS, MSG, PARM, BARO)]
    parts.append(message(PARM, start_us, "INS_GYRO_FILTER", 20.0, 20.0))
    parts.append(message(PARM, start_us, "INS_ACCEL_FILTER", 10.0, 20.0))
    parts.append(message(MSG, start_us, "ArduCopter V4.6.0"))
    for k in range(int(seconds * rate_hz)):
        at = start_us + k * 1_000_000 // rate_hz
        parts.append(imu(at))
        if k % (rate_hz // 5) == 0:
            parts.append(gps(at))
        if k % (rate_hz // 10) == 0:
            parts.append(message(BARO, at, 0, 0.0, 0.0, 101325.0, 2500))
    return b"".join(parts)


def text_log(seconds: float = 1.0) -> str:
    """Return a text log with the messages of ``flight``'s beginning."""
    lines = [f"FMT, {k[1]}, 89, {k[0]}, {k[2]}, {k[3]}" for k in (FMT,)]
    for kind in (IMU, GPS, MSG):
        length = 3 + struct.calcsize("<" + "".join(_PACKED[c] for c in kind[2]))
        lines.append(f"FMT, {kind[1]}, {length}, {kind[0]}, {kind[2]}, {kind[3]}")
    lines.append("MSG, 1000000, ArduCopter V4.6.0, with a comma")
    for k in range(int(seconds * 100)):
        lines.append(f"IMU, {1_000_000 + 10_000 * k}, 0, 0.01, 0.02, 0.03, 0.1, 0.2, -9.8")
        if k % 20 == 0:
            at = 1_000_000 + 10_000 * k
            lines.append(f"GPS, {at}, 0, 3, {at // 1000}, 2300, 12, 0.9, 54.0, 7.5, 12.34, 1.5, 90, -0.5, 0")
    return "\n".join(lines) + "\n"


def telemetry(
    items: Sequence[tuple[int, str, Mapping[str, Any], tuple[int, int]]], *, version: int = 2
) -> bytes:
    """Return a telemetry log of (arrival [us], message name, fields, (system, component))."""
    from pymavlink.dialects.v20 import ardupilotmega

    writers: dict[tuple[int, int], Any] = {}
    out = []
    for arrival_us, name, fields, who in items:
        writer = writers.setdefault(who, ardupilotmega.MAVLink(None, *who))
        packet = getattr(ardupilotmega, f"MAVLink_{name.lower()}_message")(**fields)
        out.append(struct.pack(">Q", arrival_us) + packet.pack(writer, force_mavlink1=version == 1))
    return b"".join(out)


UTC_US = 1_700_000_000_000_000


def highres_imu(boot_us: int, acc_z: float = -9.8) -> dict[str, Any]:
    names = (
        "xacc yacc zacc xgyro ygyro zgyro xmag ymag zmag abs_pressure diff_pressure pressure_alt temperature"
    )
    fields: dict[str, Any] = dict.fromkeys(names.split(), 0.0)
    return fields | {"time_usec": boot_us, "zacc": acc_z, "xmag": 0.2, "zmag": 0.4, "abs_pressure": 1013.25,
                     "fields_updated": 4095}  # fmt: skip


def heartbeat(autopilot: int = 3) -> dict[str, Any]:
    return {"type": 2, "autopilot": autopilot, "base_mode": 0, "custom_mode": 0, "system_status": 4,
            "mavlink_version": 3}  # fmt: skip


def telemetry_flight(
    seconds: float = 2.0, system: int = 1, start_us: int = 1_000_000, offset_us: int = UTC_US
) -> list[tuple[int, str, dict[str, Any], tuple[int, int]]]:
    """Return the items of a telemetry log with IMU at 50 Hz, TIMESYNC at 5 Hz and vision fixes at 10 Hz.

    The companion's clock is 100 s ahead of the autopilot's; requests take 2 ms, replies 4 ms.
    """
    me, companion = (system, 1), (system, 191)
    items: list[tuple[int, str, dict[str, Any], tuple[int, int]]] = [
        (offset_us + start_us, "HEARTBEAT", heartbeat(), me)
    ]
    for k in range(int(seconds * 50)):
        boot = start_us + 20_000 * k
        items.append((offset_us + boot + 1000, "HIGHRES_IMU", highres_imu(boot), me))
        mine = (boot + 100_000_000) * 1000
        if k % 10 == 0:
            items.append(
                (offset_us + boot + 2000, "TIMESYNC", {"tc1": 0, "ts1": mine + 2_000_000}, companion)
            )
            reply = {"tc1": (boot + 4000) * 1000, "ts1": mine + 2_000_000}
            items.append((offset_us + boot + 6000, "TIMESYNC", reply, me))
        if k % 5 == 0:
            items.append(
                (offset_us + boot + 7000, "LANDING_TARGET", landing_target(boot + 99_950_000), companion)
            )
    return items


def landing_target(time_us: int, **changes: Any) -> dict[str, Any]:
    fields = {
        "time_usec": time_us, "target_num": 0, "frame": 12, "angle_x": 0.1, "angle_y": -0.2, "distance": 5.0,
        "size_x": 0.0, "size_y": 0.0, "x": 1.0, "y": 0.5, "z": 4.0, "q": [1.0, 0.0, 0.0, 0.0], "type": 2,
        "position_valid": 1,
    }  # fmt: skip
    return fields | changes


def as_bytes(data: bytes) -> np.ndarray[tuple[int], np.dtype[np.uint8]]:
    return np.frombuffer(data, dtype=np.uint8)

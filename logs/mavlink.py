"""What a MAVLink telemetry log means: the autopilot's sensors and estimate, and what its companion said.

Arrivals are the recorder's (UTC). Stamps are the autopilot's, since boot; a message that carries none is
stamped like those that arrived next to it (metadata ``stamp``). Only one vehicle and one of its boots is
imported.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs import mavlink_sensors as ms
from logs.ardupilot import filter_delay
from logs.companion import read_companion
from logs.dataflash_format import text_of
from logs.datum import ARDUPILOT_RADIUS_M, PX4_RADIUS_M, ardupilot_positions, describe_origin
from logs.recording import Recording, Series
from logs.sensors import (
    DEBUG,
    ERROR,
    FATAL,
    INFO,
    WARN,
    Floats,
    Stamps,
    Times,
    columns,
    log_series,
    odometry_series,
)
from logs.tlog import read_telemetry
from logs.vehicles import IMU_MESSAGES, Autopilot, find_autopilot

_ARDUPILOT = 3
_LEVELS = (FATAL, FATAL, FATAL, ERROR, WARN, INFO, INFO, DEBUG)
_HANDLED = {"HEARTBEAT", "PARAM_VALUE", "SYSTEM_TIME", "GPS_GLOBAL_ORIGIN", "HOME_POSITION"}


def import_telemetry(path: Path, system: int | None = None) -> Recording:
    """Read a .tlog file; of several vehicles the one with most IMU data, or that with the id ``system``.

    Raises LogError when no frame can be read or no autopilot speaks in it. What was damaged or left out is in
    the recording's ``problems``.
    """
    log = read_telemetry(path)
    autopilot = find_autopilot(log, path, system)
    out = Recording()
    ardupilot = _is_ardupilot(autopilot)
    parameters = _parameters(autopilot)
    undulation = _undulation(autopilot)
    out.series += _imu(autopilot, ardupilot, filter_delay(parameters) if ardupilot else {})
    out.series += _gps(autopilot, undulation) + _air(autopilot) + _range(autopilot)
    origins, origin = _origins(autopilot, ardupilot, undulation or 0.0)
    if undulation is not None:
        origins |= {"altitude_datum": "ellipsoid", "undulation_m": repr(undulation)}
    out.series += _own_estimate(autopilot, origin, undulation or 0.0)
    out.series += _truth(autopilot, origins, undulation or 0.0)
    companion = read_companion(autopilot)
    out.series += companion.series + _texts(autopilot)
    out.clock_offsets_ns["autopilot"] = autopilot.offset_ns
    if companion.offset_ns is not None:
        out.clock_offsets_ns["companion"] = companion.offset_ns
    out.metadata["deckfix.origin"] = origins
    out.metadata["deckfix.source"] = _source(autopilot, ardupilot)
    if parameters:
        text = json.dumps(parameters, indent=0, sort_keys=True).encode()
        out.attachments["parameters.json"] = ("application/json", text)
    out.problems += log.problems + companion.problems
    if autopilot.left_out:
        which = ", ".join(f"{n} {k}" for n, k in sorted(autopilot.left_out.items()))
        out.problems.append(f"messages whose time was damaged or ran backwards were left out: {which}")
    return out


def _is_ardupilot(autopilot: Autopilot) -> bool:
    beats = autopilot.messages("HEARTBEAT")
    return bool(len(beats)) and int(np.median(beats.data["autopilot"])) == _ARDUPILOT


def _parameters(autopilot: Autopilot) -> dict[str, float]:
    data = autopilot.messages("PARAM_VALUE").data
    names = [text_of(n) for n in data["param_id"].tolist()]
    return dict(zip(names, data["param_value"].astype(np.float64).tolist(), strict=True))


def _imu(autopilot: Autopilot, ardupilot: bool, delay: dict[str, str]) -> list[Series]:
    """Return /imu from the best message there is, and what else of it only HIGHRES_IMU and its kin carry."""
    for name in IMU_MESSAGES:
        if name == "RAW_IMU" and not ardupilot:
            continue  # elsewhere its numbers have no fixed unit
        found = autopilot.timed(name)
        if found is None:
            continue
        data, times = found
        first = ms.first_imu(name, data)
        data, times = data[first], times[first]
        if not len(times):
            continue
        made = [ms.imu(name, data, times, delay)]
        field = ms.magnetic(name, data, ms.gauss_factor(data))
        if np.any(field):
            fresh = _changes(field, times.stamp_ns)
            made.append(ms.compass(name, field[fresh], times[fresh]))
        if (
            name == "HIGHRES_IMU"
            and autopilot.timed("SCALED_PRESSURE") is None
            and data["abs_pressure"].any()
        ):
            made += _pressures(name, data, times)
        return made
    return []


def _changes(values: Floats, stamp_ns: Stamps) -> NDArray[np.bool_]:
    """Return which rows (n, k) to keep of a slow sensor, whose values are sent several times.

    Kept are those that differ from the row before, and of rows that stay equal one every 0.2 s.
    """
    changed = np.ones(len(values), dtype=np.bool_)
    changed[1:] = np.any(values[1:] != values[:-1], axis=1)
    since = np.maximum.accumulate(np.where(changed, np.arange(len(values)), 0))
    waits = (stamp_ns - stamp_ns[since]) // ms.HOLD_NS
    keep = changed.copy()
    keep[1:] |= waits[1:] > waits[:-1]
    return keep


def _undulation(autopilot: Autopilot) -> float | None:
    return ms.undulation_of(autopilot.messages("GPS_RAW_INT").data)


def _gps(autopilot: Autopilot, undulation: float | None) -> list[Series]:
    found = autopilot.timed("GPS_RAW_INT")
    if found is None:
        return []
    data, times = found
    fresh = np.ones(len(times), dtype=np.bool_)
    fresh[1:] = np.diff(times.stamp_ns) > 0
    return ms.satellite(data[fresh], times[fresh], undulation)


def _air(autopilot: Autopilot) -> list[Series]:
    found = autopilot.timed("SCALED_PRESSURE")
    return [] if found is None else _pressures("SCALED_PRESSURE", *found)


def _pressures(name: str, data: NDArray[np.void], times: Times) -> list[Series]:
    fresh = _changes(ms.pressure(name, data)[0][:, np.newaxis], times.stamp_ns)
    return ms.air(name, data[fresh], times[fresh])


def _range(autopilot: Autopilot) -> list[Series]:
    found = autopilot.timed("DISTANCE_SENSOR")
    if found is None:
        return []
    data, times = found
    down = ms.downward(data)
    if not down.any():
        return []
    down &= data["id"] == data["id"][down][0]
    return [ms.ranges(data[down], times[down])]


def _own_estimate(
    autopilot: Autopilot, origin: tuple[float, float, float] | None, undulation: float
) -> list[Series]:
    """Return /attitude and /autopilot/odometry: what the autopilot itself believed."""
    made = []
    for name in ("ATTITUDE_QUATERNION", "ATTITUDE"):
        found = autopilot.timed(name)
        if found is None:
            continue
        made.append(ms.attitude(name, *found))
        break
    local = autopilot.timed("LOCAL_POSITION_NED")
    if local is not None:
        data, times = local
        position = columns(data["x"], data["y"], data["z"])
        velocity = columns(data["vx"], data["vy"], data["vz"])
        metadata = {"message": "LOCAL_POSITION_NED", "origin": "autopilot_origin"}
        made.append(odometry_series("/autopilot/odometry", times, position, velocity, None, metadata))
        return made
    placed = autopilot.timed("GLOBAL_POSITION_INT")
    if placed is not None and origin is not None:
        data, times = placed
        position = ardupilot_positions(
            columns(1e-7 * data["lat"], 1e-7 * data["lon"], 1e-3 * data["alt"] + undulation), origin
        )
        velocity = 1e-2 * columns(data["vx"], data["vy"], data["vz"])
        metadata = {"message": "GLOBAL_POSITION_INT", "origin": "autopilot_origin"}
        made.append(odometry_series("/autopilot/odometry", times, position, velocity, None, metadata))
    return made


def _origins(
    autopilot: Autopilot, ardupilot: bool, undulation: float
) -> tuple[dict[str, str], tuple[float, float, float] | None]:
    """Return the datum of each local frame as metadata, and the origin of the autopilot's estimate."""
    entries = {"altitude_datum": "mean sea level"}
    origin = None
    radius = ARDUPILOT_RADIUS_M if ardupilot else PX4_RADIUS_M
    for message, name in (("GPS_GLOBAL_ORIGIN", "autopilot_origin"), ("HOME_POSITION", "home")):
        data = autopilot.messages(message).data
        if len(data):
            row = data[-1]
            point = (1e-7 * row["latitude"], 1e-7 * row["longitude"], 1e-3 * row["altitude"] + undulation)
            entries |= describe_origin(name, point, radius)
            origin = origin or point
    return entries, origin


def _truth(autopilot: Autopilot, entries: dict[str, str], undulation: float) -> list[Series]:
    """Return /truth/odometry from SIM_STATE, relative to its first place, which is added to the origins.

    SIM_STATE carries no time, and its floating-point latitude and longitude hold 1e-7 deg in some versions:
    only the integers of newer ones are used.
    """
    found = autopilot.messages("SIM_STATE")
    found = found[(found.data["lat_int"] != 0) | (found.data["lon_int"] != 0)]
    if not len(found):
        return []
    data = found.data
    times = autopilot.stamped_by_arrival(found)
    places = columns(1e-7 * data["lat_int"], 1e-7 * data["lon_int"], data["alt"] + undulation)
    origin = (float(places[0, 0]), float(places[0, 1]), float(places[0, 2]))
    entries |= describe_origin("truth_origin", origin)
    velocity = columns(data["vn"], data["ve"], data["vd"])
    q = columns(*(data[f"q{k}"] for k in (1, 2, 3, 4)))
    metadata = {
        "message": "SIM_STATE",
        "origin": "truth_origin",
        "stamp": "of the messages that arrived next to it, for it carries none",
    }
    position = ardupilot_positions(places, origin)
    return [odometry_series("/truth/odometry", times, position, velocity, q, metadata)]


def _texts(autopilot: Autopilot) -> list[Series]:
    """Return /log from STATUSTEXT, long texts put together again; a text is stamped with its arrival."""
    found = autopilot.messages("STATUSTEXT")
    texts: list[str] = []
    levels: list[int] = []
    first: list[int] = []
    open_id = 0
    for k, row in enumerate(found.data):
        text, part = text_of(row["text"]), int(row["id"])
        if part and part == open_id and row["chunk_seq"]:
            texts[-1] += text
            continue
        open_id = part
        texts.append(text)
        levels.append(_LEVELS[min(int(row["severity"]), 7)])
        first.append(k)
    mask = np.zeros(len(found), dtype=np.bool_)
    mask[first] = True
    times = autopilot.stamped_by_arrival(found[mask])
    return log_series(times, "STATUSTEXT", levels, texts)


def _source(autopilot: Autopilot, ardupilot: bool) -> dict[str, str]:
    """Return what is known of the log as a whole; ``utc_offset_ns`` is the autopilot's UTC less boot time."""
    entries = {
        "autopilot": "ardupilot" if ardupilot else "unknown",
        "format": "telemetry",
        "system_id": str(autopilot.system),
    }
    clock = autopilot.messages("SYSTEM_TIME").data
    clock = clock[clock["time_unix_usec"] > 0]
    if len(clock):
        utc = (
            clock["time_unix_usec"].astype(np.int64) * 1000
            - clock["time_boot_ms"].astype(np.int64) * 1_000_000
        )
        entries["utc_offset_ns"] = str(int(np.sort(utc)[len(utc) // 2]))
    left = {n: k for n, k in autopilot.log.names().items() if n not in autopilot.used | _HANDLED}
    entries["not_imported"] = ", ".join(f"{n} {k}" for n, k in sorted(left.items()))
    return entries

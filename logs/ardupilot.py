"""What an ArduPilot dataflash log means: its sensors, its own estimate and, from a simulator, the truth.

Stamps are the log's ``TimeUS`` (microseconds since boot, clock "autopilot"). A log knows no arrivals: they
are the stamps moved to UTC by one constant, taken from GPS week and milliseconds.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.ardupilot_names import ERROR_SUBSYSTEMS, EVENTS, mode_name
from logs.ardupilot_tables import Table, TimedTables, has
from logs.dataflash import is_dataflash, read_dataflash
from logs.dataflash_format import DataflashLog, text_of
from logs.dataflash_text import read_dataflash_text
from logs.datum import ardupilot_origin, describe_origin
from logs.recording import Recording, Series
from logs.sensors import (
    ERROR,
    FIX,
    INFO,
    NO_FIX,
    RTK_FIXED,
    RTK_FLOAT,
    Floats,
    Times,
    attitude_series,
    barometer_series,
    columns,
    fix_series,
    imu_series,
    log_series,
    magnetometer_series,
    odometry_series,
    quaternions_from_euler,
    range_series,
    velocity_series,
)

VISION_HINT = (
    "vision fixes are not taken from PL, which repeats and rounds them: merge the flight's telemetry log "
    "(.tlog), whose LANDING_TARGET messages are exact"
)
"""Problem of a log that a merge with a telemetry log solves."""

_MILLIGAUSS_T = 1e-7
_DOWNWARD = 25
_RANGE_SEEN = 2
_STATUS = np.array([NO_FIX, NO_FIX, NO_FIX, FIX, FIX, RTK_FLOAT, RTK_FIXED, FIX, FIX], dtype=np.int8)
_ALTITUDE_LIMIT_M = 1e6
_NAMED_BY_VEHICLE = ("ArduCopter", "ArduPlane", "ArduRover", "ArduSub", "Blimp", "AntennaTracker")
_DESCRIPTION = {"FMT", "FMTU", "UNIT", "MULT", "FILE"}


def import_dataflash(path: Path) -> Recording:
    """Read a .BIN or .log file.

    Raises LogError when nothing in it can be decoded. What was damaged or is missing is in the recording's
    ``problems``.
    """
    with path.open("rb") as file:
        binary = is_dataflash(file.read(1 << 16))
    return interpret(read_dataflash(path) if binary else read_dataflash_text(path))


def interpret(log: DataflashLog) -> Recording:
    """Return the recording that a decoded log describes."""
    out = Recording(problems=list(log.problems))
    tables = TimedTables(log)
    parameters = tables.parameters()
    if tables.offset_ns is None:
        out.problems.append("the log holds no GPS time: its arrivals start at the epoch instead of in UTC")
    undulation = _undulation(tables)
    out.series += _imu(tables, parameters)
    out.series += _gps(tables, parameters, undulation)
    out.series += _air(tables) + _field(tables, parameters) + _range(tables, parameters)
    out.series += _own_estimate(tables, out) + _truth(tables)
    out.series += _texts(tables)
    out.clock_offsets_ns["autopilot"] = tables.offset_ns or 0
    out.metadata["deckfix.origin"] = _origins(tables, undulation)
    out.metadata["deckfix.source"] = _source(tables, parameters)
    if parameters:
        text = json.dumps(parameters, indent=0, sort_keys=True).encode()
        out.attachments["parameters.json"] = ("application/json", text)
    _tell(tables, out)
    return out


def filter_delay(parameters: Mapping[str, float]) -> dict[str, str]:
    """Return the group delay [s] of the low-pass filters behind the logged IMU, as channel metadata.

    ArduPilot logs what has passed a second-order Butterworth filter at INS_GYRO_FILTER and INS_ACCEL_FILTER
    [Hz]; its delay at low frequency is sqrt(2) / (2 pi f). ``latency_s`` is the mean of the two. Empty where
    the log does not give both parameters.
    """
    cutoffs = [parameters.get("INS_GYRO_FILTER"), parameters.get("INS_ACCEL_FILTER")]
    delays = [math.sqrt(2.0) / (2.0 * math.pi * f) if f > 0.0 else 0.0 for f in cutoffs if f is not None]
    if len(delays) != 2 or not all(math.isfinite(d) for d in delays):
        return {}
    return {
        "latency_s": repr(0.5 * (delays[0] + delays[1])),
        "gyro_latency_s": repr(delays[0]),
        "accelerometer_latency_s": repr(delays[1]),
        "latency_reason": "group delay of the low-pass filters INS_GYRO_FILTER and INS_ACCEL_FILTER",
    }


def _imu(tables: TimedTables, parameters: Mapping[str, float]) -> list[Series]:
    made = []
    names = ("GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
    for instance, (rows, times) in tables.instances("IMU", "IMU2", "IMU3", needed=names).items():
        gyro = columns(*(rows[n] for n in names[:3]))
        accel = columns(*(rows[n] for n in names[3:]))
        made.append(imu_series(times, gyro, accel, instance, filter_delay(parameters)))
    return made


def _gps(tables: TimedTables, parameters: Mapping[str, float], undulation: float | None) -> list[Series]:
    made = []
    needed = ("Status", "Lat", "Lng", "Alt", "Spd", "GCrs")
    accuracies = tables.instances("GPA", "GPA2", needed=("HAcc", "VAcc", "SAcc"))
    for instance, (rows, times) in tables.instances("GPS", "GPS2", needed=needed).items():
        metadata = {"altitude_datum": "mean sea level" if undulation is None else "ellipsoid"}
        delay = parameters.get(f"GPS{instance + 1}_DELAY_MS", parameters.get("GPS_DELAY_MS", 0.0))
        if delay > 0.0:
            metadata |= {"latency_s": repr(delay * 1e-3), "latency_reason": "set by the user in GPS_DELAY_MS"}
        antenna = [
            _first(parameters, f"GPS{instance + 1}_POS_{a}", f"GPS_POS{instance + 1}_{a}") for a in "XYZ"
        ]
        if any(antenna):
            metadata["antenna_frd_m"] = " ".join(repr(a) for a in antenna)
        status = _STATUS[np.clip(rows["Status"], 0, len(_STATUS) - 1)]
        altitude = rows["Alt"] + (undulation or 0.0)
        sigmas = _matched(accuracies.get(instance), times, "HAcc", "VAcc", "SAcc")
        made.append(
            fix_series(
                times, rows["Lat"], rows["Lng"], altitude, status, sigmas[0], sigmas[1], instance, metadata
            )
        )
        speed, course = rows["Spd"].astype(np.float64), np.radians(rows["GCrs"].astype(np.float64))
        down = rows["VZ"] if has(rows, "VZ") else np.full(len(rows), np.nan)
        velocity = columns(speed * np.cos(course), speed * np.sin(course), down)
        velocity[status == NO_FIX] = np.nan
        made.append(velocity_series(times, velocity, sigmas[2], instance, metadata))
    return made


def _matched(other: tuple[Table, Times] | None, times: Times, *names: str) -> list[Floats]:
    """Return columns of another table at the same stamps; NaN where it has no row within 50 ms."""
    found = [np.full(len(times), np.nan) for _ in names]
    if other is None:
        return found
    rows, there = other
    after = np.clip(np.searchsorted(there.stamp_ns, times.stamp_ns), 0, len(there) - 1)
    before = np.maximum(after - 1, 0)
    late = np.abs(there.stamp_ns[after] - times.stamp_ns)
    early = np.abs(there.stamp_ns[before] - times.stamp_ns)
    nearest = np.where(early < late, before, after)
    good = np.minimum(early, late) <= 50_000_000
    for column, name in zip(found, names, strict=True):
        column[good] = rows[name][nearest[good]]
    return found


def _undulation(tables: TimedTables) -> float | None:
    """Return the geoid's height above the ellipsoid [m] that the receiver gave, or None."""
    fixes = tables.instances("GPS", needed=("Alt", "Status")).get(0)
    if fixes is None:
        return None
    accuracy = tables.instances("GPA", needed=("AEl",)).get(0)
    (ellipsoid,) = _matched(accuracy, fixes[1], "AEl")
    good = (fixes[0]["Status"] >= 3) & (np.abs(ellipsoid) < _ALTITUDE_LIMIT_M) & (ellipsoid != 0.0)
    return float(np.median(ellipsoid[good] - fixes[0]["Alt"][good])) if good.any() else None


def _air(tables: TimedTables) -> list[Series]:
    made = []
    for instance, (rows, times) in tables.instances("BARO", "BAR2", "BAR3", needed=("Press",)).items():
        warmth = rows["Temp"] if has(rows, "Temp") else None
        made += barometer_series(times, rows["Press"], warmth, instance)
    return made


def _field(tables: TimedTables, parameters: Mapping[str, float]) -> list[Series]:
    """Return the first compass only: in many logs the others are the same sensor, logged again."""
    names = ("MagX", "MagY", "MagZ")
    compasses = tables.instances("MAG", "MAG2", "MAG3", needed=names)
    if not compasses:
        return []
    instance = min(compasses)
    rows, times = compasses[instance]
    metadata = {"instance": str(instance), "instances_in_log": str(len(compasses))}
    if parameters.get("COMPASS_DEC"):
        metadata["autopilot_declination_rad"] = repr(parameters["COMPASS_DEC"])
    return [magnetometer_series(times, _MILLIGAUSS_T * columns(*(rows[n] for n in names)), 0, metadata)]


def _range(tables: TimedTables, parameters: Mapping[str, float]) -> list[Series]:
    """Return the rangefinders that look down; where a sensor reports no data its range is NaN."""
    made: list[Series] = []
    for instance, (rows, times) in tables.instances("RFND", needed=("Dist",)).items():
        down = rows["Orient"] == _DOWNWARD if has(rows, "Orient") else np.ones(len(rows), dtype=np.bool_)
        if not down.any():
            continue
        distance = rows["Dist"].astype(np.float64)
        if has(rows, "Stat"):
            distance[rows["Stat"] < _RANGE_SEEN] = np.nan
        limits = []
        for limit, missing in (("MIN", 0.0), ("MAX", math.inf)):
            key = f"RNGFND{instance + 1}_{limit}"
            centimetres = parameters.get(f"{key}_CM")
            limits.append(parameters.get(key, missing) if centimetres is None else 0.01 * centimetres)
        made.append(range_series(times[down], distance[down], limits[0], limits[1], instance=len(made)))
    return made


def _own_estimate(tables: TimedTables, out: Recording) -> list[Series]:
    """Return /attitude and /autopilot/odometry: what the autopilot itself believed."""
    made = []
    attitude = tables.rows("ATT", "Roll", "Pitch", "Yaw")
    if attitude is not None:
        made.append(attitude_series(attitude[1], _attitude(attitude[0])))
    needed = ("PN", "PE", "PD", "VN", "VE", "VD", "Roll", "Pitch", "Yaw")
    for name in ("XKF1", "NKF1"):
        cores = tables.instances(name, needed=needed)
        if not cores:
            continue
        core = min(cores)
        rows, times = cores[core]
        position = columns(rows["PN"], rows["PE"], rows["PD"])
        velocity = columns(rows["VN"], rows["VE"], rows["VD"])
        metadata = {"source": f"{name}, core {core}", "origin": "autopilot_origin"}
        made.append(
            odometry_series("/autopilot/odometry", times, position, velocity, _attitude(rows), metadata)
        )
        primary = tables.rows(f"{name[:3]}4", "PI", instance=core)
        if primary is not None and bool(np.any(primary[0]["PI"] != core)):
            out.problems.append(
                f"the autopilot did not fly by the estimator core shown ({core}) all the time: {name[:3]}4.PI"
            )
        break
    return made


def _truth(tables: TimedTables) -> list[Series]:
    """Return the simulator's truth at the stamps that have all of it: those that SIM shares with SIM2."""
    attitude = tables.rows("SIM", "Roll", "Pitch", "Yaw", "Lat", "Lng", "Alt")
    motion = tables.rows("SIM2", "PN", "PE", "PD", "VN", "VE", "VD")
    if attitude is None or motion is None:
        return []
    at, where = _common(attitude[1], motion[1])
    rows, moves = attitude[0][at], motion[0][where]
    if not len(rows):
        return []
    parts = ("Q1", "Q2", "Q3", "Q4")
    q = columns(*(rows[n] for n in parts)) if has(rows, *parts) else _attitude(rows)
    metadata = {
        "source": "position and velocity SIM2, attitude SIM",
        "rates": "only stamps that both messages have; nothing is interpolated",
        "origin": "truth_origin",
    }
    position = columns(moves["PN"], moves["PE"], moves["PD"])
    velocity = columns(moves["VN"], moves["VE"], moves["VD"])
    times = Times(attitude[1].stamp_ns[at], attitude[1].arrival_ns[at])
    return [odometry_series("/truth/odometry", times, position, velocity, q, metadata)]


def _common(a: Times, b: Times) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the rows of a and of b that carry the same stamp."""
    found = np.intersect1d(a.stamp_ns, b.stamp_ns, return_indices=True)
    return found[1], found[2]


def _attitude(rows: Table) -> Floats:
    return quaternions_from_euler(*(np.radians(rows[n].astype(np.float64)) for n in ("Roll", "Pitch", "Yaw")))


def _texts(tables: TimedTables) -> list[Series]:
    """Return /log: messages, errors, events and changes of mode."""
    made: list[Series] = []
    if (found := tables.rows("MSG", "Message")) is not None:
        texts = [text_of(t) for t in found[0]["Message"].tolist()]
        made += log_series(found[1], "MSG", [INFO] * len(texts), texts)
    if (found := tables.rows("ERR", "Subsys", "ECode")) is not None:
        codes = zip(found[0]["Subsys"].tolist(), found[0]["ECode"].tolist(), strict=True)
        texts = [f"{ERROR_SUBSYSTEMS.get(s, f'subsystem {s}')}: error code {e}" for s, e in codes]
        made += log_series(found[1], "ERR", [ERROR] * len(texts), texts)
    if (found := tables.rows("EV", "Id")) is not None:
        texts = [f"event: {EVENTS.get(k, str(k))}" for k in found[0]["Id"].tolist()]
        made += log_series(found[1], "EV", [INFO] * len(texts), texts)
    if (found := tables.rows("MODE", "ModeNum")) is not None:
        copter = _vehicle(tables) in ("ArduCopter", "")
        texts = [f"mode: {mode_name(k, copter)}" for k in found[0]["ModeNum"].tolist()]
        made += log_series(found[1], "MODE", [INFO] * len(texts), texts)
    return made


def _origins(tables: TimedTables, undulation: float | None) -> dict[str, str]:
    """Return each local frame's datum: degrees, metres, and the factors to metres on the ellipsoid."""
    entries = {"altitude_datum": "mean sea level" if undulation is None else "ellipsoid"}
    if undulation is not None:
        entries["undulation_m"] = repr(undulation)
    origin = tables.rows("ORGN", "Type", "Lat", "Lng", "Alt")
    for kind, name in ((0, "autopilot_origin"), (1, "home")):
        if origin is not None and len(rows := origin[0][origin[0]["Type"] == kind]):
            point = (rows[0]["Lat"], rows[0]["Lng"], rows[0]["Alt"] + (undulation or 0.0))
            entries |= describe_origin(name, point)
    place = tables.rows("SIM", "Lat", "Lng", "Alt")
    motion = tables.rows("SIM2", "PN", "PE", "PD")
    if place is not None and motion is not None:
        at, where = _common(place[1], motion[1])
        moves = motion[0][where]
        there = columns(*(place[0][n][at] for n in ("Lat", "Lng", "Alt")))
        truth = ardupilot_origin(there, columns(moves["PN"], moves["PE"], moves["PD"]))
        if truth is not None:
            truth = (truth[0], truth[1], truth[2] + (undulation or 0.0))
            entries |= describe_origin("truth_origin", truth)
    return entries


def _vehicle(tables: TimedTables) -> str:
    """Return ArduCopter, ArduPlane ... as the firmware's own text says, or nothing."""
    return next((v for v in _NAMED_BY_VEHICLE if _firmware(tables).startswith(v)), "")


def _firmware(tables: TimedTables) -> str:
    texts = tables.log.tables.get("VER")
    if texts is not None and has(texts, "FWS") and len(texts):
        return text_of(texts["FWS"][0])
    table = tables.log.tables.get("MSG")
    lines = (
        [text_of(t) for t in table["Message"].tolist()] if table is not None and has(table, "Message") else []
    )
    return next((t for t in lines if t.startswith(_NAMED_BY_VEHICLE)), "")


def _source(tables: TimedTables, parameters: Mapping[str, float]) -> dict[str, str]:
    tables.used.update({"VER"} & set(tables.log.tables))
    entries = {"autopilot": "ardupilot", "format": "dataflash", "firmware": _firmware(tables)}
    system = _first(parameters, "MAV_SYSID", "SYSID_THISMAV")
    if system:
        entries["system_id"] = str(int(system))
    left = {n: len(t) for n, t in tables.log.tables.items() if n not in tables.used | _DESCRIPTION}
    entries["not_imported"] = ", ".join(f"{n} {k}" for n, k in sorted(left.items()))
    return entries


def _first(parameters: Mapping[str, float], *names: str) -> float:
    """Return the first of the parameters that the log has, else 0."""
    return next((parameters[n] for n in names if n in parameters), 0.0)


def _tell(tables: TimedTables, out: Recording) -> None:
    if tables.left_out:
        which = ", ".join(f"{n} {k}" for n, k in sorted(tables.left_out.items()))
        out.problems.append(f"messages whose time was damaged or ran backwards were left out: {which}")
    if "PL" in tables.log.tables:
        out.problems.append(VISION_HINT)

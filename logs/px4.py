"""What a PX4 log (.ulg) means: its sensors and its own estimate. Reading needs the extra ``px4`` (pyulog).

Stamps are microseconds since boot (clock "autopilot"), of the sample where the log has it. A log knows no
arrivals: they are the stamps moved to UTC by one constant, taken from the receiver's UTC.
"""

from __future__ import annotations

import contextlib
import io
import json
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, BinaryIO

import numpy as np
from numpy.typing import NDArray

from logs.datum import PX4_RADIUS_M, describe_origin
from logs.errors import LogError
from logs.recording import Recording, Series
from logs.sensors import (
    DEBUG,
    ERROR,
    FATAL,
    FIX,
    INFO,
    NO_FIX,
    RTK_FIXED,
    RTK_FLOAT,
    WARN,
    Floats,
    Stamps,
    Times,
    attitude_series,
    barometer_series,
    columns,
    fix_series,
    imu_series,
    log_series,
    magnetometer_series,
    odometry_series,
    range_series,
    velocity_series,
)
from logs.stamps import common_offset, in_order, near, to_ns

MAGIC = b"ULog\x01\x12\x35"

_GAUSS_T = 1e-4
_CALLS = 200_000
_DOWNWARD = 25
_STATUS = np.array([NO_FIX, NO_FIX, NO_FIX, FIX, FIX, RTK_FLOAT, RTK_FIXED, NO_FIX, FIX], dtype=np.int8)
_LEVELS = (FATAL, FATAL, FATAL, ERROR, WARN, INFO, INFO, DEBUG)
_TOPICS = (
    "sensor_combined",
    "vehicle_gps_position",
    "sensor_gps",
    "vehicle_air_data",
    "sensor_baro",
    "vehicle_magnetometer",
    "distance_sensor",
    "vehicle_attitude",
    "vehicle_local_position",
)
Data = dict[str, NDArray[Any]]


def import_ulog(path: Path) -> Recording:
    """Read a .ulg file.

    Raises LogError when pyulog is missing or cannot read the file, or the file holds no message of use.
    """
    tables = _read(path)
    out = Recording(problems=tables.problems)
    if tables.offset_ns is None:
        out.problems.append("the log holds no GPS time: its arrivals start at the epoch instead of in UTC")
    out.series += _imu(tables) + _gps(tables) + _air(tables) + _field(tables) + _range(tables)
    out.series += _own_estimate(tables, out) + tables.texts
    if not any(s.topic != "/log" for s in out.series):
        raise LogError(path, "the log holds no sensor data", "check that it is the log of a flight")
    out.clock_offsets_ns["autopilot"] = tables.offset_ns or 0
    left = {n for n in tables.names if n not in tables.used}
    out.metadata["deckfix.source"] = {
        "autopilot": "px4",
        "format": "ulog",
        "firmware": str(tables.info.get("ver_sw", "")),
        "hardware": str(tables.info.get("ver_hw", "")),
        "not_imported": ", ".join(sorted(left)),
    }
    if tables.parameters:
        text = json.dumps(tables.parameters, indent=0, sort_keys=True).encode()
        out.attachments["parameters.json"] = ("application/json", text)
    if tables.left_out:
        which = ", ".join(f"{n} {k}" for n, k in sorted(tables.left_out.items()))
        out.problems.append(f"messages whose time was damaged or ran backwards were left out: {which}")
    return out


@dataclass(slots=True)
class _Tables:
    """The log's topics (first instances) as columns, and what stands beside them."""

    topics: dict[str, Data]
    names: list[str]
    parameters: dict[str, float]
    info: dict[str, Any]
    problems: list[str]
    offset_ns: int | None = None
    centre_ns: int = 0
    texts: list[Series] = field(default_factory=list)
    used: set[str] = field(default_factory=set)
    left_out: dict[str, int] = field(default_factory=dict)

    def rows(self, name: str, *needed: str, stamps: Stamps | None = None) -> tuple[Data, Times] | None:
        """Return a topic's rows in order with their times, None where it lacks a column or has no rows."""
        data = self.topics.get(name)
        if data is None or any(n not in data for n in needed):
            return None
        self.used.add(name)
        stamp = self.stamps(data) if stamps is None else stamps
        keep = near(stamp, self.centre_ns) & (stamp > 0)
        keep[keep] = in_order(stamp[keep])
        lost = int(np.count_nonzero(~keep))
        if lost:
            self.left_out[name] = self.left_out.get(name, 0) + lost
        if not keep.any():
            return None
        stamp = stamp[keep]
        chosen = {n: column[keep] for n, column in data.items()}
        return chosen, Times(stamp, stamp + (self.offset_ns or 0))

    @staticmethod
    def stamps(data: Data) -> Stamps:
        """Return when the rows were sampled, or published where the log does not say [ns]."""
        sampled = data.get("timestamp_sample", np.zeros(1))
        return to_ns(sampled if np.all(sampled > 0) else data["timestamp"])


class EndlessSearchError(Exception):
    """A file is read again and again without getting further."""


@dataclass(slots=True)
class _Watched:
    """A file for pyulog, whose search for the next message runs in circles over some damaged logs."""

    file: BinaryIO
    size: int
    furthest: int = 0
    calls: int = 0

    def read(self, count: int = -1) -> bytes:
        """Read as the file does; raises EndlessSearchError after many calls that did not get further in the file."""
        data = self.file.read(count)
        self.calls += 1
        at = self.file.tell()
        if at > self.furthest:
            self.furthest, self.calls = at, 0
        elif self.calls > max(_CALLS, self.size // 4):
            raise EndlessSearchError("its messages cannot be told apart")
        return data

    def seek(self, offset: int, whence: int = 0) -> int:
        """Seek as the file does."""
        return self.file.seek(offset, whence)

    def tell(self) -> int:
        """Tell as the file does."""
        return self.file.tell()

    def close(self) -> None:
        """Close the file."""
        self.file.close()


def _read(path: Path) -> _Tables:
    try:
        from pyulog import ULog
    except ImportError:
        raise LogError(path, "reading PX4 logs needs pyulog", "pip install 'deckfix[px4]'") from None
    try:
        with path.open("rb") as file, contextlib.redirect_stdout(io.StringIO()):
            log = ULog(_Watched(file, path.stat().st_size), disable_str_exceptions=True)
        tables = _collect(log)
    except Exception as error:  # pyulog raises whatever its parsing stumbles over
        kind = type(error).__name__
        raise LogError(path, f"not a readable ULog file ({kind}: {error})", "copy the log again") from None
    if log.file_corruption:
        tables.problems.append("the log is damaged: pyulog passed over what it could not read")
    if log.dropouts:
        lost = sum(d.duration for d in log.dropouts)
        tables.problems.append(f"the logger dropped data {len(log.dropouts)} times, {lost} ms in all")
    return tables


def _collect(log: Any) -> _Tables:
    """Return the tables of a log that pyulog has read."""
    topics: dict[str, Data] = {}
    for found in log.data_list:
        if found.name in _TOPICS and found.multi_id == 0 and len(found.data["timestamp"]):
            topics[found.name] = dict(found.data)
    names = sorted({d.name for d in log.data_list})
    given = [
        *log.initial_parameters.items(),
        *((name, value) for _, name, value, *_ in log.changed_parameters),
    ]
    parameters = {name: float(value) for name, value in given if isinstance(value, int | float)}
    tables = _Tables(topics, names, parameters, dict(log.msg_info_dict), [])
    if topics:
        every = np.concatenate([_Tables.stamps(d) for d in topics.values()])
        tables.centre_ns = int(np.sort(every)[len(every) // 2])
    tables.offset_ns = _find_utc(topics)
    stamps = np.array([1000 * int(m.timestamp) for m in log.logged_messages], dtype=np.int64)
    times = Times(stamps, stamps + (tables.offset_ns or 0))
    levels = [_LEVELS[min(max(int(m.log_level) - ord("0"), 0), 7)] for m in log.logged_messages]
    good = near(stamps, tables.centre_ns)
    texts = [m.message for m, ok in zip(log.logged_messages, good.tolist(), strict=True) if ok]
    levels = [k for k, ok in zip(levels, good.tolist(), strict=True) if ok]
    tables.texts = log_series(times[good], "px4", levels, texts)
    return tables


def _find_utc(topics: dict[str, Data]) -> int | None:
    for name in ("vehicle_gps_position", "sensor_gps"):
        data = topics.get(name)
        if data is None or "time_utc_usec" not in data:
            continue
        good = (data["time_utc_usec"] > 0) & (data["fix_type"] >= 3)
        found = common_offset(to_ns(data["time_utc_usec"])[good], to_ns(data["timestamp"])[good])
        if found is not None:
            return found
    return None


def _vector(data: Data, name: str, size: int = 3) -> Floats:
    return columns(*(data[f"{name}[{k}]"] for k in range(size)))


def _imu(tables: _Tables) -> list[Series]:
    """Return /imu; a sample is the mean over the interval that ends at its stamp, so half of it late."""
    found = tables.rows("sensor_combined", "gyro_rad[0]", "accelerometer_m_s2[0]")
    if found is None:
        return []
    data, times = found
    metadata = {}
    if "gyro_integral_dt" in data:
        interval = float(np.median(data["gyro_integral_dt"]))
        interval *= 1e-6 if data["gyro_integral_dt"].dtype.kind in "iu" else 1.0
        metadata["latency_s"] = repr(0.5 * interval)
        metadata["latency_reason"] = "half of the interval over which PX4 averages a sample"
    return [imu_series(times, _vector(data, "gyro_rad"), _vector(data, "accelerometer_m_s2"), 0, metadata)]


def _gps(tables: _Tables) -> list[Series]:
    for name in ("vehicle_gps_position", "sensor_gps"):
        found = tables.rows(name, "fix_type", "eph", "epv", "s_variance_m_s", "vel_n_m_s")
        if found is None:
            continue
        data, times = found
        status = _STATUS[np.minimum(data["fix_type"], len(_STATUS) - 1)]
        if "latitude_deg" in data:
            place = [data[n] for n in ("latitude_deg", "longitude_deg", "altitude_ellipsoid_m")]
        else:
            place = [1e-7 * data["lat"], 1e-7 * data["lon"], 1e-3 * data["alt_ellipsoid"]]
        metadata = {"altitude_datum": "ellipsoid"}
        if "EKF2_GPS_DELAY" in tables.parameters:
            metadata["autopilot_delay_s"] = repr(1e-3 * tables.parameters["EKF2_GPS_DELAY"])
        velocity = columns(*(data[f"vel_{axis}_m_s"] for axis in "ned"))
        if "vel_ned_valid" in data:
            velocity[data["vel_ned_valid"] == 0] = np.nan
        return [
            fix_series(times, place[0], place[1], place[2], status, data["eph"], data["epv"], 0, metadata),
            velocity_series(times, velocity, data["s_variance_m_s"], 0, metadata),
        ]
    return []


def _air(tables: _Tables) -> list[Series]:
    for name, pressure, warmth in (
        ("vehicle_air_data", "baro_pressure_pa", "baro_temp_celcius"),
        ("sensor_baro", "pressure", "temperature"),
    ):
        found = tables.rows(name, pressure)
        if found is None:
            continue
        data, times = found
        value = data[pressure].astype(np.float64)
        value *= 100.0 if name == "sensor_baro" and np.median(value) < 2000.0 else 1.0  # hPa before 2022
        temperature = data.get(warmth, data.get("ambient_temperature"))
        return barometer_series(times, value, temperature, 0, {"message": name})
    found = _within(tables, "baro", "baro_alt_meter")
    if found is None:
        return []
    data, times = found
    ratio = 1.0 - 6.5e-3 / 288.15 * data["baro_alt_meter"].astype(np.float64)
    with np.errstate(invalid="ignore"):
        value = 101_325.0 * ratio ** (9.80665 / (6.5e-3 * 287.05))
    metadata = {"message": "sensor_combined", "pressure": "standard atmosphere at PX4's barometric altitude"}
    return barometer_series(times, value, data.get("baro_temp_celcius"), 0, metadata)


def _field(tables: _Tables) -> list[Series]:
    found = tables.rows("vehicle_magnetometer", "magnetometer_ga[0]") or _within(
        tables, "magnetometer", "magnetometer_ga[0]"
    )
    if found is None:
        return []
    return [magnetometer_series(found[1], _GAUSS_T * _vector(found[0], "magnetometer_ga"))]


def _within(tables: _Tables, sensor: str, needed: str) -> tuple[Data, Times] | None:
    """Return what early versions of PX4 carry inside sensor_combined: a sensor's rows at its own stamps."""
    data = tables.topics.get("sensor_combined")
    relative = f"{sensor}_timestamp_relative"
    if data is None or relative not in data:
        return None
    stamps = to_ns(data["timestamp"]) + 1000 * data[relative].astype(np.int64)
    lost = dict(tables.left_out)
    found = tables.rows("sensor_combined", needed, stamps=stamps)
    tables.left_out = lost
    if found is None:
        return None
    fresh = np.append(True, np.diff(found[1].stamp_ns) > 0)
    return {n: column[fresh] for n, column in found[0].items()}, found[1][fresh]


def _range(tables: _Tables) -> list[Series]:
    found = tables.rows("distance_sensor", "current_distance", "orientation")
    if found is None:
        return []
    data, times = found
    down = data["orientation"] == _DOWNWARD
    if not down.any():
        return []
    distance = data["current_distance"].astype(np.float64)
    if "signal_quality" in data:
        distance[data["signal_quality"] == 0] = np.nan
    limits = [
        data.get(n, np.full(len(down), v)) for n, v in (("min_distance", 0.0), ("max_distance", math.inf))
    ]
    return [range_series(times[down], distance[down], limits[0][down], limits[1][down])]


def _own_estimate(tables: _Tables, out: Recording) -> list[Series]:
    """Return /attitude and /autopilot/odometry; what PX4 itself called invalid is NaN."""
    made = []
    found = tables.rows("vehicle_attitude", "q[0]")
    if found is not None:
        made.append(attitude_series(found[1], _vector(found[0], "q", 4)))
    found = tables.rows("vehicle_local_position", "x", "vx")
    if found is None:
        return made
    data, times = found
    position = columns(data["x"], data["y"], data["z"])
    velocity = columns(data["vx"], data["vy"], data["vz"])
    for values, part, name in (
        (position, slice(0, 2), "xy_valid"),
        (position, slice(2, 3), "z_valid"),
        (velocity, slice(0, 2), "v_xy_valid"),
        (velocity, slice(2, 3), "v_z_valid"),
    ):
        if name in data:
            values[data[name] == 0, part] = np.nan
    made.append(
        odometry_series(
            "/autopilot/odometry", times, position, velocity, None, {"origin": "autopilot_origin"}
        )
    )
    referred = data.get("ref_timestamp", np.zeros(len(times))) > 0
    if referred.any():
        last = np.flatnonzero(referred)[-1]
        point = tuple(float(data[n][last]) for n in ("ref_lat", "ref_lon", "ref_alt"))
        origin = describe_origin("autopilot_origin", (point[0], point[1], point[2]), PX4_RADIUS_M)
        out.metadata["deckfix.origin"] = {"altitude_datum": "mean sea level", **origin}
    return made

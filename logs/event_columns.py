"""One kind of sensor event at a time: rows of ``EVENT_DTYPE`` <-> the columns of its topic.

``WRITE[kind](rows)`` gives the columns; ``READ[kind](series, rows, others)`` fills values and covariances of the
rows, taking what the message lacks from the other series (see ``logs.events``).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.events import Kind
from logs.recording import Series
from logs.topics import new_rows

F64 = NDArray[np.float64]

FOREIGN = "ros2"
"""Value of the metadata ``source`` of a series that another program wrote."""

_UPPER = np.array([0, 1, 2, 4, 5, 8])
_FULL = np.array([0, 1, 2, 1, 3, 4, 2, 4, 5])
_BLOCK = np.array([0, 1, 2, 6, 7, 8, 12, 13, 14])
_ROTATION_VARIANCES = np.array([21, 28, 35])
_NOT_MEASURED = 1e6
KELVIN = 273.15
TEMPERATURE = "/baro/temperature"


def degrees_of(radians: F64) -> F64:
    """Return the degrees whose ``np.radians`` is the given angle to the last bit, where there are any."""
    best: F64 = np.degrees(radians)
    up, down = best, best
    for _ in range(2):
        up, down = np.nextafter(up, np.inf), np.nextafter(down, -np.inf)
        for candidate in (up, down):
            better = (np.radians(best) != radians) & (np.radians(candidate) == radians)
            best = np.where(better, candidate, best)
    return best


def count_known(values: F64) -> NDArray[np.int64]:
    """Return how many entries of each row are not NaN."""
    count: NDArray[np.int64] = (~np.isnan(values)).sum(axis=1)
    return count


def _known(upper: F64) -> F64:
    """Replace unknown covariances (all NaN) by zeros."""
    return np.where(np.isnan(upper).all(axis=1, keepdims=True), 0.0, upper)


def _unknown(upper: F64) -> F64:
    """Replace covariances that are all zero by NaN."""
    return np.where((upper == 0.0).all(axis=1, keepdims=True), np.nan, upper)


def _upper_of(covariance: F64) -> F64:
    """Return the upper triangles (n, 6) of the first 3x3 blocks of 6x6 matrices (n, 36); NaN where all is zero.

    A block that is not symmetric (to single precision) is no covariance: it gets a variance below zero, which is
    rejected as that, instead of half of it being believed.
    """
    block = covariance[:, _BLOCK].reshape(-1, 3, 3)
    upper = _unknown(covariance[:, _BLOCK][:, _UPPER])
    size = np.abs(block).max(axis=(1, 2))
    with np.errstate(invalid="ignore"):
        lopsided = np.abs(block - block.transpose(0, 2, 1)).max(axis=(1, 2)) > 1e-6 * size
    upper[lopsided, 0] = -1.0
    return upper


def _write_imu(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/imu", len(rows))
    data["orientation"][:, 3] = 1.0
    data["orientation_covariance"][:, 0] = -1.0
    data["angular_velocity"], data["linear_acceleration"] = rows["value"][:, :3], rows["value"][:, 3:]
    return data


def _read_imu(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    rows["value"][:, :3] = one.data["angular_velocity"]
    rows["value"][:, 3:] = one.data["linear_acceleration"]


def _write_timesync(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/timesync", len(rows))
    trip = rows["value"][:, 0].astype(np.int64)
    data["remote_ns"] = rows["stamp_ns"]
    data["sent_ns"] = rows["arrival_ns"] - trip // 2
    data["received_ns"] = data["sent_ns"] + trip
    return data


def _read_timesync(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    trip = one.data["received_ns"] - one.data["sent_ns"]
    local = one.data["sent_ns"] + trip // 2
    rows["stamp_ns"] = one.data["remote_ns"]
    rows["value"][:, 0] = trip
    rows["value"][:, 1] = one.arrival_ns - local
    rows["arrival_ns"] = local


def _write_position(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/gps/fix", len(rows))
    value = rows["value"]
    data["status_status"] = np.nan_to_num(value[:, 3]).astype(np.int8) - 1
    data["status_service"] = 1
    data["latitude"], data["longitude"] = degrees_of(value[:, 0]), degrees_of(value[:, 1])
    data["altitude"] = value[:, 2]
    nn, ne, nd, ee, ed, dd = _known(rows["covariance"]).T
    data["position_covariance"] = np.stack([ee, ne, -ed, ne, nn, -nd, -ed, -nd, dd], axis=1)
    data["position_covariance_type"] = np.where(np.isnan(rows["covariance"]).all(axis=1), 0, 3)
    return data


def _read_position(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    data = one.data
    rows["value"][:, 0], rows["value"][:, 1] = np.radians(data["latitude"]), np.radians(data["longitude"])
    rows["value"][:, 2], rows["value"][:, 3] = data["altitude"], _fix_type(one)
    c = data["position_covariance"]
    ned = np.stack([c[:, 4], c[:, 1], -c[:, 5], c[:, 0], -c[:, 2], c[:, 8]], axis=1)
    known = data["position_covariance_type"] != 0
    rows["covariance"][known] = ned[known] + 0.0


def _fix_type(one: Series) -> F64:
    status = one.data["status_status"].astype(np.float64)
    if one.metadata.get("source") == FOREIGN:  # SBAS is a single fix, GBAS is what drivers say of RTK
        return np.select([status < 0, status < 2], [0.0, 1.0], 3.0)
    return np.clip(status + 1.0, 0.0, 3.0)


def _write_velocity(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/gps/velocity", len(rows))
    data["twist_twist_linear"] = rows["value"][:, :3]
    _put_block(data["twist_covariance"], _known(rows["covariance"]))
    return data


def _read_velocity(one: Series, rows: NDArray[np.void], everything: Sequence[Series]) -> None:
    rows["value"][:, :3] = one.data["twist_twist_linear"]
    rows["covariance"] = _upper_of(one.data["twist_covariance"])
    stated = one.metadata.get("fix_type", "")
    if stated.isdecimal():
        rows["value"][:, 3] = float(stated)
        return
    rows["value"][:, 3] = 1.0
    partner = one.metadata.get("sensor", "gps_velocity").replace("velocity", "position")
    fixes = [s for s in everything if s.topic == "/gps/fix" and s.clock == one.clock and len(s)]
    named = [s for s in fixes if s.metadata.get("sensor", "gps_position") == partner]
    for fix in named or fixes:
        place, same = _partners(fix.stamp_ns, one.stamp_ns)
        rows["value"][same, 3] = _fix_type(fix)[place]


def _put_block(covariance: F64, upper: F64) -> None:
    """Put 3x3 blocks, given by their upper triangles, into the first rows and columns of 6x6 matrices (n,
    36)."""
    covariance[:, _BLOCK] = upper[:, _FULL]
    covariance[:, _ROTATION_VARIANCES] = np.where(upper.any(axis=1, keepdims=True), _NOT_MEASURED, 0.0)


def _partners(
    stamps: NDArray[np.int64], wanted: NDArray[np.int64]
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the places in ``stamps`` of those of ``wanted`` that are there, and which these are."""
    order = np.argsort(stamps, kind="stable")
    place = np.minimum(np.searchsorted(stamps[order], wanted), len(stamps) - 1)
    same = stamps[order][place] == wanted
    return order[place[same]], same


def _write_barometer(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/baro", len(rows))
    data["fluid_pressure"] = rows["value"][:, 0]
    return data


def _read_barometer(one: Series, rows: NDArray[np.void], everything: Sequence[Series]) -> None:
    rows["value"][:, 0] = one.data["fluid_pressure"]
    sensor = one.metadata.get("sensor")
    for other in everything:
        paired = other.topic == TEMPERATURE and other.clock == one.clock and len(other)
        if paired and other.metadata.get("sensor") == sensor:
            place, same = _partners(other.stamp_ns, one.stamp_ns)
            rows["value"][same, 1] = other.data["temperature"][place] + KELVIN


def _write_field(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/magnetic_field", len(rows))
    data["magnetic_field"] = rows["value"][:, :3]
    return data


def _read_field(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    rows["value"][:, :3] = one.data["magnetic_field"]


def _write_attitude(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/attitude", len(rows))
    data["quaternion"] = rows["value"][:, [1, 2, 3, 0]]
    return data


def _read_attitude(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    rows["value"][:, :4] = one.data["quaternion"][:, [3, 0, 1, 2]]


def _write_range(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/range", len(rows))
    data["radiation_type"] = 1
    for column, name in enumerate(("range", "min_range", "max_range")):
        with np.errstate(over="ignore"):
            data[name] = rows["value"][:, column]
    return data


def _read_range(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    for column, name in enumerate(("range", "min_range", "max_range")):
        rows["value"][:, column] = one.data[name]


def _write_vision(rows: NDArray[np.void]) -> NDArray[np.void]:
    data = new_rows("/vision/fix", len(rows))
    data["pose_pose_position"] = rows["value"][:, :3]
    data["pose_pose_orientation"][:, 3] = 1.0
    _put_block(data["pose_covariance"], _known(rows["covariance"]))
    return data


def _read_vision(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    rows["value"][:, :3] = one.data["pose_pose_position"]
    rows["covariance"] = _upper_of(one.data["pose_covariance"])


def _write_user(rows: NDArray[np.void]) -> NDArray[np.void]:
    size, own = int(count_known(rows["value"][:1])[0]), int(count_known(rows["covariance"][:1])[0])
    data = new_rows("/user", len(rows), value=size, covariance=own)
    data["value"], data["covariance"] = rows["value"][:, :size], rows["covariance"][:, :own]
    return data


def _read_user(one: Series, rows: NDArray[np.void], _all: Sequence[Series]) -> None:
    value, covariance = one.data["value"][:, :6], one.data["covariance"][:, :6]
    rows["value"][:, : value.shape[1]] = value
    rows["covariance"][:, : covariance.shape[1]] = covariance


WRITE: dict[Kind, Callable[[NDArray[np.void]], NDArray[np.void]]] = {
    Kind.IMU: _write_imu,
    Kind.TIMESYNC: _write_timesync,
    Kind.GPS_POSITION: _write_position,
    Kind.GPS_VELOCITY: _write_velocity,
    Kind.BAROMETER: _write_barometer,
    Kind.MAGNETOMETER: _write_field,
    Kind.ATTITUDE: _write_attitude,
    Kind.RANGEFINDER: _write_range,
    Kind.VISION: _write_vision,
    Kind.USER: _write_user,
}

READ: dict[Kind, Callable[[Series, NDArray[np.void], Sequence[Series]], None]] = {
    Kind.IMU: _read_imu,
    Kind.TIMESYNC: _read_timesync,
    Kind.GPS_POSITION: _read_position,
    Kind.GPS_VELOCITY: _read_velocity,
    Kind.BAROMETER: _read_barometer,
    Kind.MAGNETOMETER: _read_field,
    Kind.ATTITUDE: _read_attitude,
    Kind.RANGEFINDER: _read_range,
    Kind.VISION: _read_vision,
    Kind.USER: _read_user,
}

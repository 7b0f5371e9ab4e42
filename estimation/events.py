"""Events: what the estimator takes in, one at a time (``Event``) or as columns (``EventBatch``).

Every event carries the stamp that its source gave (``stamp_ns``, in the clock named ``clock``) and the time at
which it arrived (``arrival_ns``, UTC where known). Nothing here is corrected: clock maps and latencies are
applied by the estimator, so that a replay can apply others. Units are SI, angles in rad, frames as in
``estimation.frames``.

Both forms hold the same numbers: an event is packed into one row of ``EVENT_DTYPE`` and back without loss, and
``LandingEstimator.step`` and ``.run`` therefore give the same bits.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

Vector3 = tuple[float, float, float]
Covariance3 = tuple[float, float, float, float, float, float]
"""Upper triangle of a symmetric 3x3 matrix, row by row: xx, xy, xz, yy, yz, zz."""

AUTOPILOT = "autopilot"
COMPANION = "companion"
CAMERA = "camera"


class Kind(IntEnum):
    """Kind of an event; the order is the order of processing at equal times."""

    IMU = 0
    TIMESYNC = 1
    GPS_POSITION = 2
    GPS_VELOCITY = 3
    BAROMETER = 4
    MAGNETOMETER = 5
    ATTITUDE = 6
    RANGEFINDER = 7
    VISION = 8
    USER = 9


EVENT_DTYPE = np.dtype(
    [
        ("stamp_ns", np.int64),
        ("arrival_ns", np.int64),
        ("kind", np.int16),
        ("sensor", np.int16),
        ("clock", np.int16),
        ("value", np.float64, (6,)),
        ("covariance", np.float64, (6,)),
    ]
)
"""One event as a row. ``sensor`` and ``clock`` index the batch's names; ``covariance`` is the upper triangle of
the measurement's own 3x3 covariance (or only its first entries for fewer dimensions), NaN where the source gives
none. ``value`` by kind:

============ =====================================================================
IMU          angular velocity x y z [rad/s], specific force x y z [m/s^2], FRD
TIMESYNC     round-trip time [ns]; stamp_ns is the remote clock, arrival_ns the local mid-point
GPS_POSITION latitude [rad], longitude [rad], altitude [m], fix type (0 none, 1 single/3-D, 2 RTK float, 3 fixed)
GPS_VELOCITY north, east, down [m/s], fix type
BAROMETER    pressure [Pa], temperature [K] or NaN
MAGNETOMETER field x y z [T], FRD
ATTITUDE     quaternion w x y z, body to NED
RANGEFINDER  range [m], smallest and largest valid range [m]
VISION       P^c x y z [m], camera frame
USER         as the sensor's model defines
============ =====================================================================
"""


@dataclass(frozen=True, slots=True)
class Imu:
    """Angular velocity [rad/s] and specific force [m/s^2] in the body frame (FRD), at ``stamp_ns``."""

    stamp_ns: int
    arrival_ns: int
    angular_velocity_radps: Vector3
    specific_force_mps2: Vector3
    sensor: str = "imu"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class GpsPosition:
    """WGS-84 position [rad, rad, m] with the receiver's own NED covariance [m^2], where it gives one.

    ``fix_type`` is 0 for no fix, 1 for a 3-D fix, 2 for RTK float, 3 for RTK fixed.
    """

    stamp_ns: int
    arrival_ns: int
    latitude_rad: float
    longitude_rad: float
    altitude_m: float
    covariance_ned_m2: Covariance3 | None = None
    fix_type: int = 1
    sensor: str = "gps_position"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class GpsVelocity:
    """Velocity over ground, NED [m/s], with the receiver's own covariance [m^2/s^2], where it gives one."""

    stamp_ns: int
    arrival_ns: int
    velocity_ned_mps: Vector3
    covariance_ned_m2ps2: Covariance3 | None = None
    fix_type: int = 1
    sensor: str = "gps_velocity"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class Barometer:
    """Static pressure [Pa] and, where known, the air's temperature [K]."""

    stamp_ns: int
    arrival_ns: int
    pressure_pa: float
    temperature_k: float = float("nan")
    sensor: str = "barometer"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class Magnetometer:
    """Magnetic field in the body frame (FRD) [T], calibrated by its source."""

    stamp_ns: int
    arrival_ns: int
    field_t: Vector3
    sensor: str = "magnetometer"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class Attitude:
    """An attitude that somebody else estimated: quaternion w, x, y, z, body (FRD) to NED."""

    stamp_ns: int
    arrival_ns: int
    quaternion_wxyz: tuple[float, float, float, float]
    sensor: str = "attitude"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class Rangefinder:
    """Distance along the sensor's axis [m] and the limits between which it is valid."""

    stamp_ns: int
    arrival_ns: int
    range_m: float
    min_m: float = 0.0
    max_m: float = float("inf")
    sensor: str = "rangefinder"
    clock: str = AUTOPILOT


@dataclass(frozen=True, slots=True)
class VisionFix:
    """The target's centre in the camera frame, P^c [m] (seed 4.27), with its 3x3 covariance [m^2]."""

    stamp_ns: int
    arrival_ns: int
    position_cam_m: Vector3
    covariance_m2: Covariance3
    sensor: str = "vision"
    clock: str = CAMERA


@dataclass(frozen=True, slots=True)
class TimeSync:
    """One exchange between two clocks: ``clock`` read ``remote_ns`` while the reference clock went from
    ``sent_ns`` to ``received_ns``.

    For MAVLink's TIMESYNC asked by a companion: ``clock`` is the autopilot's and the reference the companion's.
    """

    sent_ns: int
    remote_ns: int
    received_ns: int
    arrival_ns: int
    sensor: str = "timesync"
    clock: str = AUTOPILOT
    reference_clock: str = COMPANION


@dataclass(frozen=True, slots=True)
class UserMeasurement:
    """A measurement of a sensor that the user has defined (``estimation.LandingEstimator.add_sensor``).

    ``value`` has one to three entries; ``covariance`` is the upper triangle in the order of ``Covariance3``
    restricted to that size, or None for the sensor's own.
    """

    stamp_ns: int
    arrival_ns: int
    value: tuple[float, ...]
    sensor: str
    covariance: tuple[float, ...] | None = None
    clock: str = AUTOPILOT


Event = (
    Imu
    | GpsPosition
    | GpsVelocity
    | Barometer
    | Magnetometer
    | Attitude
    | Rangefinder
    | VisionFix
    | TimeSync
    | UserMeasurement
)

_NAN = float("nan")
_NO_COVARIANCE = (_NAN,) * 6


@dataclass(slots=True)
class EventBatch:
    """Events as columns, in the order of their arrival.

    ``rows`` has ``EVENT_DTYPE``; ``sensors`` and ``clocks`` are the names that its indices mean.
    TIMESYNC rows name the remote clock in ``clock``; their reference is ``timesync_reference``.
    """

    rows: NDArray[np.void]
    sensors: tuple[str, ...]
    clocks: tuple[str, ...] = (AUTOPILOT, COMPANION, CAMERA)
    timesync_reference: str = COMPANION

    def __len__(self) -> int:
        """Return the number of events."""
        return len(self.rows)

    def __iter__(self) -> Iterator[Event]:
        """Yield the events one by one, in order."""
        for row in self.rows:
            yield unpack(row, self.sensors, self.clocks, self.timesync_reference)

    @classmethod
    def concatenate(cls, batches: Sequence[EventBatch]) -> EventBatch:
        """Join batches and put them in the order of arrival (equal arrivals keep the order of the batches)."""
        names = Names()
        parts = []
        for batch in batches:
            rows = batch.rows.copy()
            sensor_map = np.array([names.sensor(s) for s in batch.sensors] or [0], dtype=np.int16)
            clock_map = np.array([names.clock(c) for c in batch.clocks] or [0], dtype=np.int16)
            rows["sensor"] = sensor_map[batch.rows["sensor"]]
            rows["clock"] = clock_map[batch.rows["clock"]]
            parts.append(rows)
        rows = np.concatenate(parts) if parts else np.empty(0, dtype=EVENT_DTYPE)
        rows = rows[np.argsort(rows["arrival_ns"], kind="stable")]
        reference = batches[0].timesync_reference if batches else COMPANION
        return cls(rows, tuple(names.sensors), tuple(names.clocks), reference)

    @classmethod
    def from_events(cls, events: Iterable[Event]) -> EventBatch:
        """Pack events, in the order given."""
        names = Names()
        packed = [pack(event, names) for event in events]
        rows = np.array(packed, dtype=EVENT_DTYPE) if packed else np.empty(0, dtype=EVENT_DTYPE)
        return cls(rows, tuple(names.sensors), tuple(names.clocks))


@dataclass(slots=True)
class Names:
    """Names of sensors and clocks in the order in which they were first met."""

    sensors: list[str] = field(default_factory=list)
    clocks: list[str] = field(default_factory=lambda: [AUTOPILOT, COMPANION, CAMERA])

    def sensor(self, name: str) -> int:
        """Return the index of a sensor's name, adding it when it is new."""
        if name not in self.sensors:
            self.sensors.append(name)
        return self.sensors.index(name)

    def clock(self, name: str) -> int:
        """Return the index of a clock's name, adding it when it is new."""
        if name not in self.clocks:
            self.clocks.append(name)
        return self.clocks.index(name)


def _fill(values: Iterable[float]) -> tuple[float, ...]:
    filled = tuple(values)
    return filled + (_NAN,) * (6 - len(filled))


Row = tuple[int, int, int, int, int, tuple[float, ...], tuple[float, ...]]


def pack(event: Event, names: Names) -> Row:
    """Pack an event into a tuple that fits ``EVENT_DTYPE``; names are looked up in, or added to, ``names``.

    Law: ``unpack(pack(event))`` equals the event for every event whose floats are not NaN.
    """
    kind, value, covariance = _content(event)
    if isinstance(event, TimeSync):
        # The mid-point is kept exact: half of the round trip is implied by value[0].
        local = event.sent_ns + (event.received_ns - event.sent_ns) // 2
        value = _fill((float(event.received_ns - event.sent_ns), float(event.arrival_ns - local)))
        stamp, arrival = event.remote_ns, local
    else:
        stamp, arrival = event.stamp_ns, event.arrival_ns
    return (
        stamp,
        arrival,
        int(kind),
        names.sensor(event.sensor),
        names.clock(event.clock),
        value,
        covariance,
    )


def _content(event: Event) -> tuple[Kind, tuple[float, ...], tuple[float, ...]]:
    match event:
        case Imu():
            return Kind.IMU, event.angular_velocity_radps + event.specific_force_mps2, _NO_COVARIANCE
        case GpsPosition():
            value = (event.latitude_rad, event.longitude_rad, event.altitude_m, float(event.fix_type))
            return Kind.GPS_POSITION, _fill(value), event.covariance_ned_m2 or _NO_COVARIANCE
        case GpsVelocity():
            value = (*event.velocity_ned_mps, float(event.fix_type))
            return Kind.GPS_VELOCITY, _fill(value), event.covariance_ned_m2ps2 or _NO_COVARIANCE
        case Barometer():
            return Kind.BAROMETER, _fill((event.pressure_pa, event.temperature_k)), _NO_COVARIANCE
        case Magnetometer():
            return Kind.MAGNETOMETER, _fill(event.field_t), _NO_COVARIANCE
        case Attitude():
            return Kind.ATTITUDE, _fill(event.quaternion_wxyz), _NO_COVARIANCE
        case Rangefinder():
            return Kind.RANGEFINDER, _fill((event.range_m, event.min_m, event.max_m)), _NO_COVARIANCE
        case VisionFix():
            return Kind.VISION, _fill(event.position_cam_m), event.covariance_m2
        case UserMeasurement():
            return Kind.USER, _fill(event.value), _fill(event.covariance or ())
        case TimeSync():
            return Kind.TIMESYNC, _fill(()), _NO_COVARIANCE


def unpack(
    row: np.void, sensors: Sequence[str], clocks: Sequence[str], timesync_reference: str = COMPANION
) -> Event:
    """Return the event that a row of ``EVENT_DTYPE`` holds."""
    kind = Kind(int(row["kind"]))
    stamp, arrival = int(row["stamp_ns"]), int(row["arrival_ns"])
    sensor, clock = sensors[int(row["sensor"])], clocks[int(row["clock"])]
    v = tuple(float(x) for x in row["value"])
    c = tuple(float(x) for x in row["covariance"])
    own: Covariance3 | None = None if all(math.isnan(x) for x in c) else (c[0], c[1], c[2], c[3], c[4], c[5])
    xyz = (v[0], v[1], v[2])
    match kind:
        case Kind.IMU:
            return Imu(stamp, arrival, xyz, (v[3], v[4], v[5]), sensor, clock)
        case Kind.GPS_POSITION:
            return GpsPosition(stamp, arrival, *xyz, own, _fix_type(v[3]), sensor, clock)
        case Kind.GPS_VELOCITY:
            return GpsVelocity(stamp, arrival, xyz, own, _fix_type(v[3]), sensor, clock)
        case Kind.BAROMETER:
            return Barometer(stamp, arrival, v[0], v[1], sensor, clock)
        case Kind.MAGNETOMETER:
            return Magnetometer(stamp, arrival, xyz, sensor, clock)
        case Kind.ATTITUDE:
            return Attitude(stamp, arrival, (v[0], v[1], v[2], v[3]), sensor, clock)
        case Kind.RANGEFINDER:
            return Rangefinder(stamp, arrival, *xyz, sensor, clock)
        case Kind.VISION:
            return VisionFix(stamp, arrival, xyz, (c[0], c[1], c[2], c[3], c[4], c[5]), sensor, clock)
        case Kind.TIMESYNC:
            round_trip, delay = int(v[0]), int(v[1])
            sent = arrival - round_trip // 2
            return TimeSync(
                sent, stamp, sent + round_trip, arrival + delay, sensor, clock, timesync_reference
            )
        case Kind.USER:
            size = sum(not math.isnan(x) for x in v)
            own_user = tuple(x for x in c if not math.isnan(x)) or None
            return UserMeasurement(stamp, arrival, v[:size], sensor, own_user, clock)


def _fix_type(value: float) -> int:
    return 0 if math.isnan(value) else int(value)

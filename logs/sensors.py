"""Sensor columns as series: what the importers have in common, once their units are SI.

Each function takes the messages' times and plain columns, and returns one ``Series``. What a source does not
give stays unknown in the message's own way: a covariance of zeros, a type that says so, or NaN for a number.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from logs.recording import Series
from logs.topics import TOPICS, new_rows

Floats = NDArray[np.float64]
Stamps = NDArray[np.int64]

NO_FIX = -1
FIX = 0
RTK_FLOAT = 1
RTK_FIXED = 2
"""Values of ``status_status`` on /gps/fix."""

NOT_MEASURED = 1e6
"""Variance of a component that a source does not measure, in a covariance that is otherwise known."""


@dataclass(frozen=True, slots=True)
class Times:
    """When messages were stamped (in ``clock``) and when they arrived: two columns (n,) [ns]."""

    stamp_ns: Stamps
    arrival_ns: Stamps
    clock: str = "autopilot"

    def __getitem__(self, rows: NDArray[np.bool_]) -> Times:
        """Return the times of the rows that a mask (n,) selects."""
        return Times(self.stamp_ns[rows], self.arrival_ns[rows], self.clock)

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamp_ns)

    def series(
        self, topic: str, data: NDArray[np.void], instance: int = 0, metadata: Mapping[str, str] | None = None
    ) -> Series:
        """Return a series of a known topic; instances other than 0 get the topic ``TOPIC/INSTANCE``."""
        known = TOPICS[topic]
        entries = dict(metadata or {})
        if instance:
            entries |= {"instance": str(instance), "message_type": known.message_type}
        return Series(
            topic=topic if instance == 0 else f"{topic}/{instance}",
            stamp_ns=self.stamp_ns,
            arrival_ns=self.arrival_ns,
            data=data,
            clock=self.clock,
            frame_id=known.frame_id,
            strings=dict(known.strings),
            metadata=entries,
        )


def columns(*parts: ArrayLike) -> Floats:
    """Return columns side by side as float64, shape (n, len(parts))."""
    with np.errstate(invalid="ignore"):  # a damaged log may hold signalling NaNs
        return np.stack([np.asarray(p, dtype=np.float64) for p in parts], axis=-1)


def quaternions_from_euler(roll: ArrayLike, pitch: ArrayLike, yaw: ArrayLike) -> Floats:
    """Return body-to-NED quaternions (n, 4), w x y z, of roll, pitch, yaw [rad] (seed 2.6); w >= 0."""
    r, p, y = (0.5 * np.asarray(a, dtype=np.float64) for a in (roll, pitch, yaw))
    cr, sr, cp, sp, cy, sy = np.cos(r), np.sin(r), np.cos(p), np.sin(p), np.cos(y), np.sin(y)
    q = columns(
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )
    return np.where(q[:, :1] < 0.0, -q, q)


def imu_series(
    times: Times,
    angular_velocity_radps: Floats,
    specific_force_mps2: Floats,
    instance: int = 0,
    metadata: Mapping[str, str] | None = None,
) -> Series:
    """Return /imu: angular velocity and specific force (n, 3) in the body frame (FRD)."""
    data = new_rows("/imu", len(times))
    data["orientation"][:, 3] = 1.0
    data["orientation_covariance"][:, 0] = -1.0
    data["angular_velocity"] = angular_velocity_radps
    data["linear_acceleration"] = specific_force_mps2
    return times.series("/imu", data, instance, metadata)


def fix_series(
    times: Times,
    latitude_deg: ArrayLike,
    longitude_deg: ArrayLike,
    altitude_m: ArrayLike,
    status: ArrayLike,
    horizontal_sigma_m: ArrayLike | None = None,
    vertical_sigma_m: ArrayLike | None = None,
    instance: int = 0,
    metadata: Mapping[str, str] | None = None,
) -> Series:
    """Return /gps/fix. A sigma that is zero or not finite, or not given, leaves the covariance unknown."""
    data = new_rows("/gps/fix", len(times))
    data["status_status"] = status
    data["status_service"] = 1
    data["latitude"] = latitude_deg
    data["longitude"] = longitude_deg
    data["altitude"] = altitude_m
    if horizontal_sigma_m is not None and vertical_sigma_m is not None:
        h = np.asarray(horizontal_sigma_m, dtype=np.float64)
        v = np.asarray(vertical_sigma_m, dtype=np.float64)
        known = np.isfinite(h) & np.isfinite(v) & (h > 0.0) & (v > 0.0)
        data["position_covariance"][known, 0] = h[known] ** 2
        data["position_covariance"][known, 4] = h[known] ** 2
        data["position_covariance"][known, 8] = v[known] ** 2
        data["position_covariance_type"][known] = 2
    return times.series("/gps/fix", data, instance, metadata)


def velocity_series(
    times: Times,
    velocity_ned_mps: Floats,
    sigma_mps: ArrayLike | None = None,
    instance: int = 0,
    metadata: Mapping[str, str] | None = None,
) -> Series:
    """Return /gps/velocity (NED), shape (n, 3). An unknown sigma leaves the covariance unknown (zeros)."""
    data = new_rows("/gps/velocity", len(times))
    data["twist_twist_linear"] = velocity_ned_mps
    if sigma_mps is not None:
        sigma = np.asarray(sigma_mps, dtype=np.float64)
        known = np.isfinite(sigma) & (sigma > 0.0)
        for k in range(3):
            data["twist_covariance"][known, 7 * k] = sigma[known] ** 2
        for k in range(3, 6):
            data["twist_covariance"][known, 7 * k] = NOT_MEASURED
    return times.series("/gps/velocity", data, instance, metadata)


def barometer_series(
    times: Times,
    pressure_pa: ArrayLike,
    temperature_c: ArrayLike | None = None,
    instance: int = 0,
    metadata: Mapping[str, str] | None = None,
) -> list[Series]:
    """Return /baro and, where temperatures [deg C] are given, /baro/temperature."""
    data = new_rows("/baro", len(times))
    data["fluid_pressure"] = pressure_pa
    made = [times.series("/baro", data, instance, metadata)]
    if temperature_c is not None:
        warmth = new_rows("/baro/temperature", len(times))
        warmth["temperature"] = temperature_c
        made.append(times.series("/baro/temperature", warmth, instance, metadata))
    return made


def magnetometer_series(
    times: Times, field_t: Floats, instance: int = 0, metadata: Mapping[str, str] | None = None
) -> Series:
    """Return /magnetic_field: calibrated field (n, 3) [T] in the body frame (FRD)."""
    data = new_rows("/magnetic_field", len(times))
    data["magnetic_field"] = field_t
    return times.series("/magnetic_field", data, instance, metadata)


def range_series(
    times: Times,
    range_m: ArrayLike,
    min_m: ArrayLike = 0.0,
    max_m: ArrayLike = np.inf,
    radiation_type: int = 1,
    instance: int = 0,
    metadata: Mapping[str, str] | None = None,
) -> Series:
    """Return /range: distance along a downward axis and its valid limits [m]; NaN where there was none."""
    data = new_rows("/range", len(times))
    data["radiation_type"] = radiation_type
    data["range"] = range_m
    data["min_range"] = min_m
    data["max_range"] = max_m
    return times.series("/range", data, instance, metadata)


def attitude_series(
    times: Times, quaternion_wxyz: Floats, metadata: Mapping[str, str] | None = None
) -> Series:
    """Return /attitude: body-to-NED quaternions (n, 4), w x y z, that the autopilot estimated."""
    data = new_rows("/attitude", len(times))
    data["quaternion"] = quaternion_wxyz[:, [1, 2, 3, 0]]
    return times.series("/attitude", data, 0, metadata)


def odometry_series(
    topic: str,
    times: Times,
    position_ned_m: Floats | None = None,
    velocity_ned_mps: Floats | None = None,
    quaternion_wxyz: Floats | None = None,
    metadata: Mapping[str, str] | None = None,
) -> Series:
    """Return an odometry topic: position and velocity (n, 3), both NED, and body-to-NED quaternions (n, 4).

    What is not given is NaN; covariances are zeros (unknown). The twist is in the axes of the header's frame
    (NED), not in the child's: ``twist_frame`` in the metadata says so.
    """
    data = new_rows(topic, len(times))
    unknown = np.full((len(times), 4), np.nan)
    data["pose_pose_position"] = unknown[:, :3] if position_ned_m is None else position_ned_m
    data["pose_pose_orientation"] = unknown if quaternion_wxyz is None else quaternion_wxyz[:, [1, 2, 3, 0]]
    data["twist_twist_linear"] = unknown[:, :3] if velocity_ned_mps is None else velocity_ned_mps
    data["twist_twist_angular"] = np.nan
    return times.series(topic, data, 0, {"twist_frame": "ned", **(metadata or {})})


def vision_series(times: Times, position_cam_m: Floats, metadata: Mapping[str, str] | None = None) -> Series:
    """Return /vision/fix: P^c (n, 3) in the camera frame; its covariance is unknown (zeros)."""
    data = new_rows("/vision/fix", len(times))
    data["pose_pose_position"] = position_cam_m
    data["pose_pose_orientation"][:, 3] = 1.0
    return times.series("/vision/fix", data, 0, metadata)


def timesync_series(
    times: Times, sent_ns: Stamps, remote_ns: Stamps, received_ns: Stamps, reference_clock: str = "companion"
) -> Series:
    """Return /timesync; ``times.stamp_ns`` is the remote clock's reading, ``times.clock`` its name."""
    data = new_rows("/timesync", len(times))
    data["sent_ns"] = sent_ns
    data["remote_ns"] = remote_ns
    data["received_ns"] = received_ns
    made = times.series("/timesync", data)
    made.strings["reference_clock"] = reference_clock
    return made


DEBUG, INFO, WARN, ERROR, FATAL = 10, 20, 30, 40, 50
"""Levels of /log."""


def log_series(times: Times, name: str, levels: Sequence[int], texts: Sequence[str]) -> list[Series]:
    """Return /log: one series for each different text and level, since a series' strings are constant."""
    rows: dict[tuple[int, str], list[int]] = {}
    for k, (level, text) in enumerate(zip(levels, texts, strict=True)):
        rows.setdefault((level, text), []).append(k)
    made = []
    for (level, text), which in rows.items():
        mask = np.zeros(len(times), dtype=np.bool_)
        mask[which] = True
        data = new_rows("/log", len(which))
        data["level"] = level
        series = times[mask].series("/log", data)
        series.strings.update({"name": name, "msg": text})
        made.append(series)
    return made

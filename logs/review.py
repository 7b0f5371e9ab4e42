"""What a recording lacks for an estimate: sensors, stretches of time, finite numbers, fixes."""

from __future__ import annotations

import numpy as np

from logs.recording import Recording, Series
from logs.stamps import DAY_NS, YEAR_2038_NS

_NEEDED = (
    ("/imu", "no IMU data: the flight can be looked at, but nothing can be estimated from it"),
    ("/gps/fix", "no GPS data: position and velocity will drift"),
)
_FIELDS = {
    "/imu": ("angular_velocity", "linear_acceleration"),
    "/gps/fix": ("latitude", "longitude", "altitude"),
    "/gps/velocity": ("twist_twist_linear",),
    "/baro": ("fluid_pressure",),
    "/magnetic_field": ("magnetic_field",),
    "/vision/fix": ("pose_pose_position",),
}
_SHORTEST_GAP_NS = 1_000_000_000
_INTERVALS = 20
_SHOWN = 3


def review(recording: Recording) -> list[str]:
    """Return sentences for the user about what is missing or wrong in the sensors of a recording."""
    found = [text for topic, text in _NEEDED if not any(len(s) for s in recording.find(topic))]
    for topic in _FIELDS:
        for series in recording.find(topic):
            found += _gaps(series) + _not_finite(series)
    fixes = [s for s in recording.find("/gps/fix") if len(s)]
    if fixes and not any(np.any(s.data["status_status"] >= 0) for s in fixes):
        found.append("the GPS never had a fix")
    return found


def drop_unstorable(recording: Recording) -> None:
    """Leave out messages whose arrival, or whose stamp in UTC, is outside the years that a log can hold.

    An arrival may lie between 1970 and 2038, a stamp between 1902 and 2038. The recording's problems tell how
    many were left out.
    """
    lost = 0
    for series in recording.series:
        utc = series.stamp_ns.astype(np.float64) + float(recording.clock_offsets_ns.get(series.clock, 0))
        good = (series.arrival_ns >= 0) & (series.arrival_ns < YEAR_2038_NS)
        good &= np.abs(utc) < YEAR_2038_NS - DAY_NS
        if not good.all():
            lost += int(np.count_nonzero(~good))
            series.stamp_ns = series.stamp_ns[good]
            series.arrival_ns = series.arrival_ns[good]
            series.data = series.data[good]
    if lost:
        recording.problems.append(f"{lost} messages with an impossible date were left out")


def _gaps(series: Series) -> list[str]:
    """Tell gaps of more than a second and twenty usual intervals."""
    if len(series) < 3:
        return []
    steps = np.diff(series.stamp_ns)
    limit = max(_SHORTEST_GAP_NS, _INTERVALS * int(np.median(steps)))
    wide = np.flatnonzero(steps > limit)
    if len(wide) == 0:
        return []
    longest = wide[np.argsort(steps[wide])[::-1][:_SHOWN]]
    start = int(series.stamp_ns[0])
    places = ", ".join(
        f"{steps[k] / 1e9:.1f} s at {(int(series.stamp_ns[k]) - start) / 1e9:.1f} s" for k in sorted(longest)
    )
    more = f" and {len(wide) - _SHOWN} more" if len(wide) > _SHOWN else ""
    return [f"{series.topic} has gaps: {places}{more}"]


def _not_finite(series: Series) -> list[str]:
    bad = np.zeros(len(series), dtype=np.bool_)
    for name in _FIELDS[series.topic]:
        values = series.data[name].reshape(len(series), -1)
        bad |= ~np.isfinite(values).all(axis=1)
    count = int(np.count_nonzero(bad))
    return (
        [f"{count} of {len(series)} messages on {series.topic} hold numbers that are not finite"]
        if count
        else []
    )

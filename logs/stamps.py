"""Stamps made sound: which of them can be kept in order, and GPS time as UTC."""

from __future__ import annotations

from bisect import bisect_right

import numpy as np
from numpy.typing import NDArray

from logs.sensors import Stamps

_GPS_EPOCH_S = 315_964_800
_WEEK_MS = 604_800_000
_LEAP_SECONDS = (
    (820_108_814, 14),
    (914_803_215, 15),
    (1_025_136_016, 16),
    (1_119_744_017, 17),
    (1_167_264_018, 18),
)
"""GPS time [s] from which on GPS has been ahead of UTC by so many seconds; 13 before (from 1999 on)."""

DAY_NS = 86_400_000_000_000
_YEAR_2000_NS = 946_684_800_000_000_000
YEAR_2038_NS = 2**31 * 1_000_000_000
"""First UTC [ns] that the 32-bit seconds of a ROS 2 time cannot hold."""
_LARGEST_STAMP_NS = 9_000_000_000_000_000_000


def gps_to_utc_ns(week: NDArray[np.int64], milliseconds: NDArray[np.int64]) -> Stamps:
    """Return UTC [ns] of GPS week numbers and milliseconds of the week (n,), leap seconds taken off."""
    gps_ms: Stamps = week.astype(np.int64) * _WEEK_MS + milliseconds.astype(np.int64)
    starts = np.array([s for s, _ in _LEAP_SECONDS], dtype=np.int64) * 1000
    leaps = np.array([13, *(n for _, n in _LEAP_SECONDS)], dtype=np.int64)
    leap: Stamps = leaps[np.searchsorted(starts, gps_ms, side="right")]
    utc: Stamps = ((_GPS_EPOCH_S - leap) * 1000 + gps_ms) * 1_000_000
    return utc


def to_ns(microseconds: NDArray[np.generic]) -> Stamps:
    """Return microseconds as int64 ns; what does not fit becomes the largest stamp."""
    limit = _LARGEST_STAMP_NS // 1000
    if microseconds.dtype.kind == "f":
        clean = np.nan_to_num(microseconds.astype(np.float64), nan=-1.0, posinf=limit, neginf=-1.0)
        rounded: Stamps = np.rint(np.clip(clean, -1.0, limit) * 1e3).astype(np.int64)
        return rounded
    if microseconds.dtype.kind == "u":
        unsigned: Stamps = np.minimum(microseconds, np.uint64(limit)).astype(np.int64) * 1000
        return unsigned
    return np.clip(microseconds.astype(np.int64), -limit, limit) * 1000


def common_offset(utc_ns: Stamps, stamp_ns: Stamps) -> int | None:
    """Return UTC less a clock's stamps (n,), the median over the pairs whose UTC is between 2000 and 2038."""
    good = (utc_ns > _YEAR_2000_NS) & (utc_ns < YEAR_2038_NS) & (stamp_ns < _LARGEST_STAMP_NS)
    if not good.any():
        return None
    offsets = np.sort(utc_ns[good] - stamp_ns[good])
    return int(offsets[len(offsets) // 2])


def in_order(stamp_ns: Stamps) -> NDArray[np.bool_]:
    """Return which stamps (n,) to keep so that the rest never runs backwards and as few as possible are lost.

    A single stamp damaged upwards or downwards costs itself only; where a clock was set back, the longer part
    stays. (Longest non-decreasing subsequence.)
    """
    if len(stamp_ns) < 2 or bool(np.all(stamp_ns[1:] >= stamp_ns[:-1])):
        return np.ones(len(stamp_ns), dtype=np.bool_)
    tails: list[int] = []
    tail_rows: list[int] = []
    previous: list[int] = []
    for row, stamp in enumerate(stamp_ns.tolist()):
        length = bisect_right(tails, stamp)
        previous.append(tail_rows[length - 1] if length else -1)
        if length == len(tails):
            tails.append(stamp)
            tail_rows.append(row)
        else:
            tails[length] = stamp
            tail_rows[length] = row
    keep = np.zeros(len(stamp_ns), dtype=np.bool_)
    row = tail_rows[-1]
    while row >= 0:
        keep[row] = True
        row = previous[row]
    return keep


def near(stamp_ns: Stamps, centre_ns: int, reach_ns: int = DAY_NS) -> NDArray[np.bool_]:
    """Return which stamps (n,) lie within ``reach_ns`` of ``centre_ns`` (others are damaged)."""
    return (stamp_ns >= centre_ns - reach_ns) & (stamp_ns <= centre_ns + reach_ns)

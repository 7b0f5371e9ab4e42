"""The clocks of a flight over time: each one's offset to the inertial clock as it was known then.

``offset_ms`` is the other clock less the inertial one, as in ``estimation.clockbank``.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.clockbank import ClockBank
from estimation.events import AUTOPILOT, EventBatch, Kind, TimeSync, unpack

Array = NDArray[np.float64]

EVERY_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ClockTrack:
    """One clock: at ``t_ns`` (n,) of the inertial clock its offset [ms] and the 1-sigma of that [ms], and what the
    offset rested on at the end (``exchanges`` or ``arrivals``)."""

    clock: str
    t_ns: NDArray[np.int64]
    offset_ms: Array
    sigma_ms: Array
    source: str


def clock_tracks(batch: EventBatch, every_ns: int = EVERY_NS) -> tuple[ClockTrack, ...]:
    """Return the track of every clock but the inertial one, from the events in the order of their arrival."""
    rows = batch.rows
    home = batch.clocks.index(AUTOPILOT) if AUTOPILOT in batch.clocks else -1
    imu = (rows["kind"] == int(Kind.IMU)) & (rows["clock"] == home)
    told = (rows["clock"] != home) | (rows["kind"] == int(Kind.TIMESYNC))
    if not told.any() or not imu.any():
        return ()
    told |= rows["kind"] == int(Kind.GPS_POSITION)
    first, last = int(rows["stamp_ns"][imu].min()), int(rows["stamp_ns"][imu].max())
    inertial = np.maximum.accumulate(np.where(imu, rows["stamp_ns"], first))
    bank = ClockBank(AUTOPILOT)
    seen: dict[str, list[tuple[int, float, float, str]]] = {}
    due = first + every_ns
    for i in np.flatnonzero(told):
        now = int(inertial[i])
        while due <= min(now, last):
            for s in bank.summary(due):
                seen.setdefault(s.clock, []).append((due, s.offset_ns * 1e-6, s.sigma_ns * 1e-6, s.source))
            due += every_ns
        event = unpack(rows[i], batch.sensors, batch.clocks, batch.timesync_reference)
        if isinstance(event, TimeSync):
            bank.exchange(event)
        else:
            bank.observe(event.clock, event.stamp_ns, event.arrival_ns)
    out = []
    for clock, points in sorted(seen.items()):
        t, offset, sigma, source = zip(*points, strict=True)
        out.append(
            ClockTrack(clock, np.array(t, np.int64), np.array(offset), np.array(sigma), str(source[-1]))
        )
    return tuple(out)

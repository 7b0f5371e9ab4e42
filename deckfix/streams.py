"""What came in: rates, gaps and noise of each sensor's events."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.events import EventBatch, Kind

Times = NDArray[np.int64]

GAP_FACTOR = 5.0
GAP_FLOOR_S = 0.02


@dataclass(frozen=True, slots=True)
class Stream:
    """Events of one sensor: ``stamp_ns`` (n,) as its source gave them, ascending; gaps as (start, length)
    in s.

    A gap is an interval of more than five times the median one, and of more than 20 ms; its start counts
    from the first stamp. ``rate_hz`` is one over the median interval (0 where there are fewer than two
    events). ``backwards`` counts stamps that were older than the one before them in the order of arrival.
    """

    name: str
    kind: Kind
    stamp_ns: Times
    rate_hz: float
    gaps: tuple[tuple[float, float], ...]
    backwards: int

    @property
    def count(self) -> int:
        """Number of events."""
        return len(self.stamp_ns)

    @property
    def longest_gap_s(self) -> float:
        """Length of the longest gap [s], 0 without one."""
        return max((length for _, length in self.gaps), default=0.0)


def stream(name: str, kind: Kind, stamp_ns: Times) -> Stream:
    """Return the statistics of the events with these stamps, given in the order of arrival."""
    backwards = int(np.count_nonzero(np.diff(stamp_ns) < 0))
    ordered = np.sort(stamp_ns)
    steps = np.diff(ordered) * 1e-9
    positive = steps[steps > 0]
    if not len(positive):
        return Stream(name, kind, ordered, 0.0, (), backwards)
    median = float(np.median(positive))
    wide = np.flatnonzero(steps > max(GAP_FACTOR * median, GAP_FLOOR_S))
    gaps = tuple(((ordered[i] - ordered[0]) * 1e-9, float(steps[i])) for i in wide)
    return Stream(name, kind, ordered, 1.0 / median, tuple((float(a), b) for a, b in gaps), backwards)


def streams(batch: EventBatch) -> tuple[Stream, ...]:
    """Return the statistics of every sensor of a batch, in the order of its kinds and names."""
    rows = batch.rows
    out = []
    for kind in Kind:
        of_kind = rows["kind"] == int(kind)
        for index in np.unique(rows["sensor"][of_kind]):
            mine = of_kind & (rows["sensor"] == index)
            out.append(stream(batch.sensors[int(index)], kind, rows["stamp_ns"][mine]))
    return tuple(out)


def vibration_mps2(batch: EventBatch) -> float | None:
    """Return the sample-to-sample scatter of the specific force [m/s^2]: rms of its differences over sqrt(2).

    The worst axis of the densest inertial sensor counts; None with fewer than 100 samples.
    """
    rows = batch.rows[batch.rows["kind"] == int(Kind.IMU)]
    if not len(rows):
        return None
    sensor = int(np.argmax(np.bincount(rows["sensor"])))
    force = rows["value"][rows["sensor"] == sensor][:, 3:6]
    force = force[np.isfinite(force).all(axis=1)]
    if len(force) < 100:
        return None
    difference = np.diff(force, axis=0)
    return float(np.sqrt(np.mean(difference**2, axis=0) / 2.0).max())

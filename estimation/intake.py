"""From events to rows: what each says, when its content was on the inertial clock, and whether it can be used."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimation.clockbank import ClockBank
from estimation.config import Config
from estimation.events import (
    AUTOPILOT,
    COMPANION,
    EVENT_DTYPE,
    Event,
    EventBatch,
    Kind,
    Names,
    TimeSync,
    pack,
    unpack,
)
from estimation.frames import Array
from estimation.outcome import Outcome
from estimation.output import Facts
from estimation.rows import OWN, RESULT, VALUE, Int, Rows
from estimation.screening import malformed, malformed_one


@dataclass(slots=True)
class Intake:
    """Takes events in the order of arrival, and keeps what is known of names and clocks.

    ``latency_ns`` (len(Kind),) is the age of each kind's content at its stamp, ``latency_of`` [s] that of the sensors
    that a user added. Rows are numbered in the order in which the events came.
    """

    latency_ns: Array
    names: Names = field(default_factory=Names)
    clocks: ClockBank = field(default_factory=lambda: ClockBank(AUTOPILOT))
    latency_of: dict[str, float] = field(default_factory=dict)
    _next_id: int = 0

    def batch(self, batch: EventBatch) -> Rows:
        """Return the rows of a batch, less the clock exchanges; what is malformed, or of a clock that nothing connects
        to the inertial one, has its outcome already.
        """
        return self._rows(self._named(batch), batch.timesync_reference)

    def single(self, event: Event) -> Rows:
        """Return what ``batch`` would of one event."""
        return self._rows(np.array([pack(event, self.names)], dtype=EVENT_DTYPE))

    def row(self, event: Event) -> Rows | None:
        """Return what ``batch`` would of one event, without columns of one entry; None for a clock exchange."""
        if isinstance(event, TimeSync):
            self._next_id += 1
            self.clocks.exchange(event)
            return None
        stamp, arrival, kind, sensor, _, value, own = pack(event, self.names)
        number, t, known = self._next_id, stamp, True
        self._next_id += 1
        if event.clock != AUTOPILOT or kind == Kind.GPS_POSITION:
            self.clocks.observe(event.clock, stamp, arrival)
            reading = self.clocks.convert(event.clock, stamp)
            known = reading is not None
            t = stamp if reading is None else reading.time_ns
        seconds = self.latency_of.get(event.sensor)
        t -= int(self.latency_ns[kind]) if seconds is None else round(seconds * 1e9)
        outcome = malformed_one(kind, value, own) if known else int(Outcome.REJECTED_NOT_READY)
        row = Rows.empty(1)
        row.ints[0] = (t, kind, sensor, number, 0, stamp, arrival, 0, outcome, 0)
        row.floats[0, VALUE:OWN], row.floats[0, OWN:RESULT] = value, own
        return row

    def _named(self, batch: EventBatch) -> NDArray[np.void]:
        """Return a batch's rows with the indices of these names."""
        rows = batch.rows.copy()
        sensors = np.array([self.names.sensor(s) for s in batch.sensors] or [0], dtype=np.int16)
        clocks = np.array([self.names.clock(c) for c in batch.clocks] or [0], dtype=np.int16)
        rows["sensor"] = sensors[batch.rows["sensor"]]
        rows["clock"] = clocks[batch.rows["clock"]]
        return rows

    def _rows(self, rows: NDArray[np.void], timesync_reference: str = COMPANION) -> Rows:
        ids = self._next_id + np.arange(len(rows))
        self._next_id += len(rows)
        t, known = self._content_times(rows, timesync_reference)
        r = Rows.empty(len(rows))
        r.t_ns[:], r.kind[:], r.sensor[:], r.id[:] = t, rows["kind"], rows["sensor"], ids
        r.stamp_ns[:], r.arrival_ns[:] = rows["stamp_ns"], rows["arrival_ns"]
        r.value[:], r.own[:] = rows["value"], rows["covariance"]
        r.outcome[:] = malformed(r)
        r.outcome[~known] = Outcome.REJECTED_NOT_READY
        return r.take(np.flatnonzero(r.kind != Kind.TIMESYNC))

    def _content_times(
        self, rows: NDArray[np.void], timesync_reference: str
    ) -> tuple[Int, NDArray[np.bool_]]:
        """Return the time of each event's content on the inertial clock, map(stamp) - latency, and where known."""
        t: Int = rows["stamp_ns"].astype(np.int64)
        known = np.ones(len(rows), dtype=bool)
        home = self.names.clocks.index(AUTOPILOT)
        kind = rows["kind"]
        for i in np.flatnonzero(
            (rows["clock"] != home) | (kind == Kind.TIMESYNC) | (kind == Kind.GPS_POSITION)
        ):
            event = unpack(rows[i], self.names.sensors, self.names.clocks, timesync_reference)
            if isinstance(event, TimeSync):
                self.clocks.exchange(event)
                continue
            self.clocks.observe(event.clock, event.stamp_ns, event.arrival_ns)
            reading = self.clocks.convert(event.clock, event.stamp_ns)
            known[i] = reading is not None
            if reading is not None:
                t[i] = reading.time_ns
        latency = self.latency_ns[rows["kind"]]
        for name, seconds in self.latency_of.items():
            latency = np.where(rows["sensor"] == self.names.sensor(name), round(seconds * 1e9), latency)
        result: Int = t - latency.astype(np.int64)
        return result, known


def latencies_s(config: Config, facts: Facts) -> Array:
    """Return the age of each kind's content at its stamp [s], shape (len(Kind),)."""
    latency = np.zeros(len(Kind))
    latency[Kind.IMU] = facts.imu_latency_s if config.imu.latency_s is None else config.imu.latency_s
    latency[Kind.GPS_POSITION] = latency[Kind.GPS_VELOCITY] = config.gps.latency_s
    latency[Kind.BAROMETER] = config.barometer.latency_s
    latency[Kind.MAGNETOMETER] = config.magnetometer.latency_s
    latency[Kind.ATTITUDE] = config.attitude.latency_s
    latency[Kind.RANGEFINDER] = config.rangefinder.latency_s
    latency[Kind.VISION] = config.vision.latency_s
    return latency

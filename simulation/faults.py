"""Faults as data: each function takes a flight's events and returns them with one thing gone wrong.

Times are seconds after the first arrival, by arrival. ``sensor`` is a sensor's name in the batch; a name that is not
in it raises ``ValueError``. Nothing is drawn at random: a fault does the same to the same events.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from estimation.events import EventBatch, Kind
from estimation.frames import ned_to_geodetic

Mask = NDArray[np.bool_]

FOREVER_S = 1e6


def gps_jump(
    batch: EventBatch, offset_ned_m: ArrayLike, start_s: float, duration_s: float = FOREVER_S
) -> EventBatch:
    """Move the GPS positions by an offset (3,) [m]."""
    rows = batch.rows.copy()
    offset = np.asarray(offset_ned_m, dtype=np.float64)
    for i in np.flatnonzero(_during(batch, start_s, duration_s) & (rows["kind"] == Kind.GPS_POSITION)):
        place = rows["value"][i, :3].copy()
        rows["value"][i, :3] = ned_to_geodetic(offset, place)
    return _with(batch, rows)


def gps_drift(batch: EventBatch, rate_ned_mps: ArrayLike, start_s: float) -> EventBatch:
    """Draw the GPS positions away slowly, as a spoofer does, at a rate (3,) [m/s]; its velocities follow."""
    rows = batch.rows.copy()
    rate = np.asarray(rate_ned_mps, dtype=np.float64)
    since = _seconds(batch) - start_s
    for i in np.flatnonzero((since >= 0.0) & (rows["kind"] == Kind.GPS_POSITION)):
        rows["value"][i, :3] = ned_to_geodetic(rate * since[i], rows["value"][i, :3].copy())
    moved = (since >= 0.0) & (rows["kind"] == Kind.GPS_VELOCITY)
    rows["value"][moved, :3] += rate
    return _with(batch, rows)


def not_finite(batch: EventBatch, sensor: str, start_s: float, duration_s: float = FOREVER_S) -> EventBatch:
    """Put NaN into the first value of every reading."""
    rows = batch.rows.copy()
    rows["value"][_of(batch, sensor, start_s, duration_s), 0] = np.nan
    return _with(batch, rows)


def bad_covariance(
    batch: EventBatch,
    sensor: str,
    what: Literal["singular", "negative"],
    start_s: float,
    duration_s: float = FOREVER_S,
) -> EventBatch:
    """State a covariance that is none: without rank, or with a negative variance."""
    rows = batch.rows.copy()
    hit = _of(batch, sensor, start_s, duration_s)
    rows["covariance"][hit] = (
        [1.0, 1.0, 0.0, 1.0, 0.0, 1.0] if what == "singular" else [1.0, 0.0, 0.0, -1.0, 0.0, 1.0]
    )
    return _with(batch, rows)


def frozen(batch: EventBatch, sensor: str, start_s: float, duration_s: float = FOREVER_S) -> EventBatch:
    """Repeat the first reading of that time with fresh stamps."""
    rows = batch.rows.copy()
    hit = np.flatnonzero(_of(batch, sensor, start_s, duration_s))
    rows["value"][hit] = rows["value"][hit[0]]
    return _with(batch, rows)


def offset(
    batch: EventBatch, sensor: str, by: ArrayLike, start_s: float, duration_s: float = FOREVER_S
) -> EventBatch:
    """Add to the values of a sensor, in its own units."""
    rows = batch.rows.copy()
    added = np.atleast_1d(np.asarray(by, dtype=np.float64))
    rows["value"][_of(batch, sensor, start_s, duration_s), : len(added)] += added
    return _with(batch, rows)


def gap(batch: EventBatch, sensor: str, start_s: float, duration_s: float = FOREVER_S) -> EventBatch:
    """Lose the readings of a sensor."""
    return _with(batch, batch.rows[~_of(batch, sensor, start_s, duration_s)])


def without(batch: EventBatch, sensor: str) -> EventBatch:
    """Take a sensor away."""
    return gap(batch, sensor, 0.0)


def begins_at(batch: EventBatch, start_s: float) -> EventBatch:
    """Begin in mid-flight: nothing arrives before that time."""
    return _with(batch, batch.rows[_seconds(batch) >= start_s])


def clock_step(batch: EventBatch, by_s: float, start_s: float, sensor: str | None = None) -> EventBatch:
    """Step the stamps of all sensors (or of one) by a time, backwards for negative ones."""
    rows = batch.rows.copy()
    hit = _during(batch, start_s, FOREVER_S) if sensor is None else _of(batch, sensor, start_s, FOREVER_S)
    rows["stamp_ns"][hit] += round(by_s * 1e9)
    return _with(batch, rows)


def delayed(
    batch: EventBatch, sensor: str, by_s: float, start_s: float, duration_s: float = FOREVER_S
) -> EventBatch:
    """Let the readings of a sensor arrive later, their stamps as they were."""
    rows = batch.rows.copy()
    hit = _of(batch, sensor, start_s, duration_s)
    rows["arrival_ns"][hit] += round(by_s * 1e9)
    when = _arrivals_ns(batch) + np.where(hit, round(by_s * 1e9), 0)
    return _with(batch, rows[np.argsort(when, kind="stable")])


def repeated(batch: EventBatch, sensor: str, start_s: float, duration_s: float = FOREVER_S) -> EventBatch:
    """Deliver readings twice, the second time 50 ms later."""
    hit = _of(batch, sensor, start_s, duration_s)
    copies = batch.rows[hit].copy()
    copies["arrival_ns"] += 50_000_000
    when = _arrivals_ns(batch)
    order = np.argsort(np.concatenate([when, when[hit] + 50_000_000]), kind="stable")
    return _with(batch, np.concatenate([batch.rows, copies])[order])


def _arrivals_ns(batch: EventBatch) -> NDArray[np.int64]:
    """Return when each event arrived. An exchange of times says its middle on its own clock instead: it arrived with
    the event before it.
    """
    arrival: NDArray[np.int64] = batch.rows["arrival_ns"].copy()
    exchange = batch.rows["kind"] == Kind.TIMESYNC
    arrival[exchange] = arrival[~exchange].min()
    result: NDArray[np.int64] = np.maximum.accumulate(arrival)
    return np.where(exchange, result, arrival)


def _seconds(batch: EventBatch) -> NDArray[np.float64]:
    arrival = _arrivals_ns(batch)
    since: NDArray[np.float64] = (arrival - arrival.min()) * 1e-9
    return since


def _during(batch: EventBatch, start_s: float, duration_s: float) -> Mask:
    t = _seconds(batch)
    inside: Mask = (t >= start_s) & (t < start_s + duration_s)
    return inside


def _of(batch: EventBatch, sensor: str, start_s: float, duration_s: float) -> Mask:
    if sensor not in batch.sensors:
        raise ValueError(f"sensor {sensor!r} is not in this flight; it has {', '.join(batch.sensors)}")
    hit: Mask = _during(batch, start_s, duration_s) & (batch.rows["sensor"] == batch.sensors.index(sensor))
    return hit


def _with(batch: EventBatch, rows: NDArray[np.void]) -> EventBatch:
    return EventBatch(rows, batch.sensors, batch.clocks, batch.timesync_reference)

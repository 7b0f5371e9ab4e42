"""Sensor events <-> the columns of their topics.

Laws: ``events_of_series(series_of_batch(batch))`` gives the batch's events back, and ``as_logged`` tells the
event that a log will return. The two are equal to the last bit but where a standard message cannot hold the
event: ranges are float32, and an angle that is no image of a double in degrees moves by one unit in the last
place. A pipeline that records should step ``as_logged(event)``, so that its replay is bit-equal.

Where standard messages lack room: a GPS velocity's fix type is in its channel's metadata (``fix_type``), or,
for columns without it, that of the fix with the same stamp; a barometer's temperature is a message of its own
on ``/baro/temperature`` with the same stamp. Unknown covariances are zero in the log
(``position_covariance_type`` 0 for a fix) and NaN in events.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from estimation.events import (
    EVENT_DTYPE,
    Attitude,
    Event,
    EventBatch,
    Imu,
    Kind,
    Magnetometer,
    Names,
)
from logs.event_columns import KELVIN, READ, TEMPERATURE, WRITE, count_known
from logs.recording import Series
from logs.topics import new_rows, row_dtype

F64 = NDArray[np.float64]

KINDS: dict[str, tuple[Kind, str]] = {
    "/imu": (Kind.IMU, "imu"),
    "/timesync": (Kind.TIMESYNC, "timesync"),
    "/gps/fix": (Kind.GPS_POSITION, "gps_position"),
    "/gps/velocity": (Kind.GPS_VELOCITY, "gps_velocity"),
    "/baro": (Kind.BAROMETER, "barometer"),
    "/magnetic_field": (Kind.MAGNETOMETER, "magnetometer"),
    "/attitude": (Kind.ATTITUDE, "attitude"),
    "/range": (Kind.RANGEFINDER, "rangefinder"),
    "/vision/fix": (Kind.VISION, "vision"),
    "/user": (Kind.USER, "user"),
}
"""Sensor topics: the kind of their events, and the sensor's name where the series' metadata give none."""

EVENT_TOPICS = (*KINDS, "/baro/temperature")

_KEPT = (Imu, Magnetometer, Attitude)
"""Events of which a log holds every bit."""

_TOPIC = {kind: topic for topic, (kind, _) in KINDS.items()}


def series_of_event(event: Event) -> list[Series]:
    """Return the one-message series of an event: one, or two for a barometer that knows its temperature."""
    batch = EventBatch.from_events([event])
    reference = getattr(event, "reference_clock", batch.timesync_reference)
    batch.timesync_reference = reference
    return series_of_batch(batch)


def as_logged(event: Event) -> Event:
    """Return the event as a log gives it back."""
    if isinstance(event, _KEPT):
        return event
    return next(iter(events_of_series(series_of_event(event))))


def series_of_batch(batch: EventBatch) -> list[Series]:
    """Return the columns of a batch: a series for each kind, sensor and clock (and fix type, and size)."""
    found = []
    rows = batch.rows
    split = np.zeros(len(rows), dtype=np.int64)
    velocity, user = rows["kind"] == Kind.GPS_VELOCITY, rows["kind"] == Kind.USER
    split[velocity] = np.nan_to_num(rows["value"][velocity, 3]).astype(np.int64)
    sizes = 10 * count_known(rows["value"]) + count_known(rows["covariance"])
    split[user] = sizes[user]
    keys = np.stack([rows["kind"], rows["sensor"], rows["clock"], split], axis=1)
    for key in np.unique(keys, axis=0):
        chosen = rows[(keys == key).all(axis=1)]
        kind, sensor = Kind(int(key[0])), batch.sensors[int(key[1])]
        arrival = chosen["arrival_ns"].copy()
        series = Series(
            topic=_TOPIC[kind],
            stamp_ns=chosen["stamp_ns"].copy(),
            arrival_ns=arrival,
            data=WRITE[kind](chosen),
            clock=batch.clocks[int(key[2])],
            metadata={"sensor": sensor},
        )
        if kind is Kind.TIMESYNC:
            series.arrival_ns = arrival + chosen["value"][:, 1].astype(np.int64)
            series.strings = {"reference_clock": batch.timesync_reference}
        elif kind is Kind.USER:
            series.strings = {"sensor": sensor}
        elif kind is Kind.GPS_VELOCITY:
            series.metadata["fix_type"] = str(int(key[3]))
        found.append(series)
        if kind is Kind.BAROMETER:
            found += _temperatures(chosen, series)
    return found


def events_of_series(
    series: Sequence[Series], positions: Sequence[NDArray[np.int64]] | None = None
) -> EventBatch:
    """Return the events of all sensor topics among the series, in the order of their arrival.

    ``positions`` orders equal arrivals (one array for each series, for example places in a file); without
    it they keep the order of the series. Other topics, and series that lack their topic's columns, are
    passed over.
    """
    usable = [one for one in series if len(one) and fits(one)]
    names = Names()
    parts, arrivals, places = [], [], []
    reference = None
    for number, one in enumerate(series):
        if one.topic not in KINDS or not len(one) or not fits(one):
            continue
        kind, default = KINDS[one.topic]
        rows = np.empty(len(one), dtype=EVENT_DTYPE)
        rows["stamp_ns"], rows["arrival_ns"] = one.stamp_ns, one.arrival_ns
        rows["kind"] = kind
        sensor = one.metadata.get("sensor", one.strings.get("sensor", default))
        rows["sensor"], rows["clock"] = names.sensor(sensor), names.clock(one.clock)
        rows["value"] = np.nan
        rows["covariance"] = np.nan
        READ[kind](one, rows, usable)
        if kind is Kind.TIMESYNC:
            reference = reference or one.strings.get("reference_clock")
        parts.append(rows)
        arrivals.append(one.arrival_ns)
        places.append(positions[number] if positions is not None else np.full(len(one), number))
    if not parts:
        return EventBatch(np.empty(0, dtype=EVENT_DTYPE), tuple(names.sensors), tuple(names.clocks))
    order = np.lexsort((np.concatenate(places), np.concatenate(arrivals)))
    batch = EventBatch(np.concatenate(parts)[order], tuple(names.sensors), tuple(names.clocks))
    if reference:
        batch.timesync_reference = reference
    return batch


def fits(series: Series) -> bool:
    """Tell whether a series has the columns of its sensor topic (it may have more), of their shapes and
    kinds.
    """
    if series.topic not in EVENT_TOPICS:
        return False
    expected, found = row_dtype(series.topic), series.data.dtype
    for name in expected.names or ():
        if name not in (found.names or ()):
            return False
        one, other = expected[name], found[name]
        sizes = one.ndim == other.ndim if series.topic == "/user" else one.shape == other.shape
        if not sizes or one.base.kind != other.base.kind:
            return False
    return True


def _temperatures(rows: NDArray[np.void], barometer: Series) -> list[Series]:
    known = ~np.isnan(rows["value"][:, 1])
    if not known.any():
        return []
    data = new_rows(TEMPERATURE, int(known.sum()))
    data["temperature"] = rows["value"][known, 1] - KELVIN
    stamp, arrival = barometer.stamp_ns[known], barometer.arrival_ns[known]
    return [Series(TEMPERATURE, stamp, arrival, data, barometer.clock, metadata=dict(barometer.metadata))]

"""A live link's messages: found in any cut of the stream, guarded, and the same events as an import of them gives."""

from __future__ import annotations

import struct
from pathlib import Path

import log_bytes as lb
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.events import Barometer, Event, Imu, Magnetometer
from logs.events import events_of_series
from logs.mavlink import import_telemetry
from logs.mavlink_frames import LONGEST, Frame, FrameReader
from logs.mavlink_live import BELIEVE_NS, FUTURE_NS, LATE_NS, SensorStream, StampGuard
from logs.tlog import dialect

MS = 1_000_000
BEGIN = 1_795_000_000_000_000_000


def packets(data: bytes) -> list[tuple[int, bytes]]:
    """Return the arrivals [ns] and frames of a telemetry log of MAVLink 2 without signatures."""
    out, at = [], 0
    while at < len(data):
        (us,) = struct.unpack_from(">Q", data, at)
        size = 12 + data[at + 9]
        out.append((us * 1000, data[at + 8 : at + 8 + size]))
        at += 8 + size
    return out


def flight(seconds: float = 3.0) -> bytes:
    return lb.telemetry(lb.telemetry_flight(seconds=seconds))


def taken(items: list[tuple[int, bytes]], stream: SensorStream) -> list[Event]:
    reader, out = FrameReader(), []
    for arrival, raw in items:
        for frame in reader.datagram(raw):
            if (frame.system, frame.component) == (1, 1):
                out += stream.take(frame.name, frame.row, arrival)
    return out


def test_live_events_are_those_of_an_import(tmp_path: Path) -> None:
    data = flight(4.0)
    path = tmp_path / "flight.tlog"
    path.write_bytes(data)
    imported = {repr(e) for e in events_of_series(import_telemetry(path).series)}
    stream = SensorStream()
    live = taken(packets(data), stream)
    kinds = {type(e) for e in live}
    assert {Imu, Barometer, Magnetometer} <= kinds
    # A value that repeats is kept every 0.2 s from the first on, which live comes a second later.
    assert [e for e in live if repr(e) not in imported and not isinstance(e, Magnetometer)] == []
    assert stream.imu == "HIGHRES_IMU"
    assert sum(isinstance(e, Imu) for e in live) == 150


@settings(max_examples=30, deadline=None)
@given(cuts=st.lists(st.integers(1, 400), max_size=30), junk=st.binary(max_size=60))
def test_every_frame_is_found_however_the_stream_is_cut(cuts: list[int], junk: bytes) -> None:
    junk = junk.replace(b"\xfd", b"\0").replace(b"\xfe", b"\0")
    frames = [raw for _, raw in packets(flight(0.3))]
    data = junk.join([b"", *frames])
    reader, found = FrameReader(), list[Frame]()
    for cut in cuts:
        found += reader.stream(data[:cut])
        data = data[cut:]
    found += reader.stream(data)
    assert [f.raw for f in found] == frames
    assert reader.garbage == len(junk) * len(frames)


@settings(max_examples=100, deadline=None)
@given(junk=st.lists(st.binary(max_size=LONGEST + 20), max_size=8))
def test_garbage_makes_no_frame_and_costs_none_that_follows_in_a_packet_of_its_own(junk: list[bytes]) -> None:
    frames = [raw for _, raw in packets(flight(0.1))]
    reader = FrameReader()
    for data in junk:
        assert all(f.name in {m.name for m in dialect().values()} for f in reader.datagram(data))
    assert [f.raw for raw in frames for f in reader.datagram(raw)] == frames


def test_a_frame_that_lies_about_its_length_holds_nothing_back() -> None:
    (_, frame), *_ = packets(flight(0.1))
    reader = FrameReader()
    assert reader.datagram(b"\xfd\xff" + frame[2:10]) == []
    assert [f.raw for f in reader.datagram(frame)] == [frame]
    assert reader.garbage == 10


def test_stamps_from_the_future_the_past_and_before_are_turned_away() -> None:
    guard = StampGuard()
    for k in range(50):
        assert guard.fault("IMU", (1000 + 10 * k) * MS, BEGIN + 10 * k * MS) == ""
    now, stamp = BEGIN + 500 * MS, 1500 * MS
    assert guard.fault("IMU", stamp + FUTURE_NS + MS, now) == "future"
    assert guard.fault("IMU", stamp - LATE_NS - MS, now) == "old"
    assert guard.fault("IMU", 1490 * MS, now) == "repeated"
    assert guard.fault("IMU", 1495 * MS, now) == ""
    assert guard.fault("IMU", stamp, now) == ""


def test_an_autopilot_that_restarts_is_believed_after_a_silence_only() -> None:
    guard = StampGuard()
    for k in range(100):
        guard.fault("IMU", (60_000 + 10 * k) * MS, BEGIN + 10 * k * MS)
    assert guard.fault("IMU", 1000 * MS, BEGIN + 1000 * MS) == "old"
    later = BEGIN + 1000 * MS + BELIEVE_NS
    assert guard.fault("IMU", 1000 * MS, later) == ""
    assert guard.restarts == 1
    assert guard.fault("IMU", 1010 * MS, later + 10 * MS) == ""


def test_a_clock_that_drifts_is_followed() -> None:
    guard = StampGuard()
    for k in range(60_000):  # ten minutes, 500 ppm
        arrival = k * 10 * MS
        assert guard.fault("IMU", 1000 * MS + round(arrival * (1 + 500e-6)), BEGIN + arrival) == ""
    assert guard.restarts == 0


@pytest.mark.parametrize("field", ["xacc", "zgyro"])
def test_numbers_that_are_none_are_passed_on_for_the_estimator_to_refuse(field: str) -> None:
    stream = SensorStream()
    out: list[Event] = []
    reader = FrameReader()
    for k in range(80):
        fields = lb.highres_imu(1_000_000 + 20_000 * k)
        if k == 70:
            fields[field] = float("nan")
        data = lb.telemetry([(lb.UTC_US + 20_000 * k, "HIGHRES_IMU", fields, (1, 1))])
        for frame in reader.datagram(data[8:]):
            out += stream.take(frame.name, frame.row, (lb.UTC_US + 20_000 * k) * 1000)
    samples = [e for e in out if isinstance(e, Imu)]
    bad = [e for e in samples if not np.isfinite([*e.angular_velocity_radps, *e.specific_force_mps2]).all()]
    assert len(bad) == 1

"""Rates, gaps and vibration of the input."""

from __future__ import annotations

import numpy as np
import pytest

from deckfix.streams import stream, streams, vibration_mps2
from estimation.events import Barometer, EventBatch, Imu, Kind


def test_a_steady_stream_has_its_rate_and_no_gap() -> None:
    s = stream("baro", Kind.BAROMETER, (np.arange(500) * 50_000_000).astype(np.int64))
    assert (s.count, s.gaps, s.backwards) == (500, (), 0)
    assert s.rate_hz == pytest.approx(20.0)
    assert s.longest_gap_s == 0.0


def test_gaps_and_disorder_are_told() -> None:
    t = (np.arange(400) * 2_500_000).astype(np.int64)
    t[200:] += 1_300_000_000
    order = np.arange(400)
    order[[10, 11]] = order[[11, 10]]
    s = stream("imu", Kind.IMU, t[order])
    assert s.backwards == 1
    assert len(s.gaps) == 1
    assert s.gaps[0] == pytest.approx((199 * 0.0025, 1.3025))


def test_short_and_empty_streams_have_no_rate() -> None:
    for stamps in ([], [5], [5, 5]):
        s = stream("x", Kind.USER, np.array(stamps, dtype=np.int64))
        assert (s.rate_hz, s.gaps) == (0.0, ())


def test_each_sensor_is_its_own_stream() -> None:
    events = [Barometer(i * 10**8, i * 10**8, 1e5, sensor=f"baro{i % 2}") for i in range(20)]
    got = streams(EventBatch.from_events(events))
    assert [(s.name, s.count) for s in got] == [("baro0", 10), ("baro1", 10)]


def test_vibration_is_the_scatter_from_sample_to_sample() -> None:
    rng = np.random.default_rng(2)
    force = rng.normal(size=(2000, 3)) * np.array([0.1, 4.0, 1.0]) + np.array([0.0, 0.0, -9.8])
    events = [
        Imu(i, i, (0.0, 0.0, 0.0), (float(f[0]), float(f[1]), float(f[2]))) for i, f in enumerate(force)
    ]
    assert vibration_mps2(EventBatch.from_events(events)) == pytest.approx(4.0, rel=0.1)
    assert vibration_mps2(EventBatch.from_events(events[:50])) is None

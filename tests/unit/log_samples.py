"""Recordings made for the tests of the log."""

from __future__ import annotations

import numpy as np

from logs.recording import Recording, Series
from logs.topics import new_rows

UTC = 1_700_000_000_000_000_000


def series(
    topic: str,
    rate_hz: float,
    duration_s: float,
    rng: np.random.Generator,
    *,
    clock: str = "autopilot",
    sensor: str | None = None,
    delay_ns: int = 2_000_000,
) -> Series:
    """Return random messages of a topic at a constant rate; the clock started at 12.345 us."""
    n = int(rate_hz * duration_s)
    stamp = (np.arange(n) / rate_hz * 1e9).astype(np.int64) + 12_345
    data = new_rows(topic, n)
    for name in data.dtype.names or ():
        if data.dtype[name].base.kind == "f":
            data[name] = rng.normal(size=data[name].shape)
    metadata = {"sensor": sensor} if sensor else {}
    return Series(topic, stamp, stamp + UTC + delay_ns, data, clock, metadata=metadata)


def flight(duration_s: float = 20.0, seed: int = 1) -> Recording:
    """Return a small recording of the usual sensors."""
    rng = np.random.default_rng(seed)
    fix = series("/gps/fix", 5, duration_s, rng, delay_ns=90_000_000)
    fix.data["latitude"], fix.data["longitude"] = 54.1, 10.2
    fix.data["position_covariance_type"] = 3
    velocity = series("/gps/velocity", 5, duration_s, rng, delay_ns=90_000_000)
    return Recording(
        [
            series("/imu", 200, duration_s, rng, sensor="imu"),
            fix,
            velocity,
            series("/baro", 20, duration_s, rng),
            series("/magnetic_field", 10, duration_s, rng),
            series("/attitude", 10, duration_s, rng),
            series("/truth/odometry", 10, duration_s, rng),
        ],
        {"autopilot": UTC},
        {"deckfix.vehicle": {"name": "raft <lander>"}},
        {"params.txt": ("text/plain", b"INS_GYRO_FILTER 20\n")},
        ["The compass was calibrated in flight."],
    )


def same(a: Series, b: Series) -> None:
    """Assert that two series hold the same bits."""
    assert a.topic == b.topic
    assert np.array_equal(a.stamp_ns, b.stamp_ns)
    assert np.array_equal(a.arrival_ns, b.arrival_ns)
    assert a.data.dtype == b.data.dtype
    assert a.data.tobytes() == b.data.tobytes()
    assert a.clock == b.clock

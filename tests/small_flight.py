"""A small log of a flight that hovers, written with the product's own writer; quick to replay."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimation.events import (
    COMPANION,
    Barometer,
    Event,
    EventBatch,
    GpsPosition,
    GpsVelocity,
    Imu,
    Magnetometer,
    TimeSync,
    VisionFix,
)
from logs.events import series_of_batch
from logs.recording import Recording, Series
from logs.sensors import Times, odometry_series
from logs.writer import FlightWriter

UTC = 1_795_342_500_000_000_000
BOOT = 40_000_000_000
LATITUDE, LONGITUDE = np.deg2rad(54.0), np.deg2rad(7.5)
COMPANION_AHEAD_NS = 3_000_000_000
DECK_M = np.array([0.4, -0.3, 6.0])
HEAVE_M, HEAVE_S = 0.3, 5.0


def small_events(seconds: float = 16.0, seed: int = 7) -> list[Event]:
    """Return the events of a vehicle at rest that faces north: IMU 100 Hz, GPS 5, barometer 10, compass 10."""
    rng = np.random.default_rng(seed)
    events: list[Event] = []
    for i in range(int(seconds * 100)):
        t = BOOT + i * 10_000_000
        gyro, force = rng.normal(size=3) * 1e-3, rng.normal(size=3) * 0.02 + np.array([0, 0, -9.8146])
        events.append(Imu(t, UTC + t, _three(gyro), _three(force)))
        if i % 10 == 0:
            events.append(Barometer(t, UTC + t, 101_325.0 + float(rng.normal()) * 1.5))
            field = np.array([1.8e-5, 0.0, 4.6e-5]) + rng.normal(size=3) * 1e-7
            events.append(Magnetometer(t, UTC + t, _three(field)))
        if i % 20 == 0:
            north, east, up = rng.normal(size=3) * np.array([0.3, 0.3, 0.6])
            place = (LATITUDE + north / 6.37e6, LONGITUDE + east / 3.75e6, 12.0 + up)
            events.append(GpsPosition(t, UTC + t, *(float(v) for v in place)))
            events.append(GpsVelocity(t, UTC + t, _three(rng.normal(size=3) * 0.1)))
    return events


def small_recording(seconds: float = 16.0, seed: int = 7, truth: bool = True) -> Recording:
    """Return the flight as a recording, with its truth and another estimate beside it."""
    batch = EventBatch.from_events(small_events(seconds, seed))
    series: list[Series] = series_of_batch(batch)
    if truth:
        t = BOOT + np.arange(int(seconds * 25), dtype=np.int64) * 40_000_000
        times = Times(t, t + UTC)
        zero = np.zeros((len(t), 3))
        level = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
        drift = 0.5 * np.sin(np.arange(len(t)) / 40.0)[:, None] * np.ones(3)
        series.append(odometry_series("/truth/odometry", times, zero, zero, level))
        series.append(odometry_series("/autopilot/odometry", times, drift, zero + 0.2, level))
    return Recording(series, {"autopilot": UTC}, {"deckfix.source": {"format": "made by hand"}})


def deck_down_m(seconds: np.ndarray) -> np.ndarray:
    """Return how far below the vehicle (which is the origin) the deck of ``deck_recording`` is."""
    down: np.ndarray = DECK_M[2] - HEAVE_M * np.sin(2.0 * np.pi * seconds / HEAVE_S)
    return down


def deck_events(seconds: float, seed: int = 7) -> list[Event]:
    """Return what a camera sees of a heaving deck below the vehicle at rest: 10 Hz, 2 cm, 50 ms late, on the
    companion's clock, with its exchanges of time."""
    rng = np.random.default_rng(seed)
    events: list[Event] = []
    for i in range(int(seconds * 10)):
        t = i * 100_000_000
        down = float(deck_down_m(np.array(i / 10.0)))
        seen = np.array([DECK_M[1], -DECK_M[0], down]) + rng.normal(size=3) * 0.02
        stamp, arrival = BOOT + t + COMPANION_AHEAD_NS, UTC + BOOT + t + 50_000_000
        own = (4e-4, 0.0, 0.0, 4e-4, 0.0, 4e-4)
        events.append(VisionFix(stamp, arrival, _three(seen), own, clock=COMPANION))
        remote = BOOT + t
        sent, received = remote + COMPANION_AHEAD_NS - 1_000_000, remote + COMPANION_AHEAD_NS + 1_000_000
        events.append(TimeSync(sent, remote, received, UTC + remote + 1_000_000))
    return events


def deck_recording(seconds: float = 24.0, seed: int = 7, truth: bool = True) -> Recording:
    """Return the flight above a deck that heaves by 0.3 m every 5 s, with its truth."""
    out = small_recording(seconds, seed, truth)
    events = sorted(small_events(seconds, seed) + deck_events(seconds, seed), key=lambda e: e.arrival_ns)
    out.series = series_of_batch(EventBatch.from_events(events)) + out.series[len(out.series) - 2 * truth :]
    out.clock_offsets_ns["companion"] = UTC - COMPANION_AHEAD_NS
    if truth:
        s = np.arange(0.0, seconds, 0.04)
        t = BOOT + np.round(s * 1e9).astype(np.int64)
        place = np.tile(DECK_M, (len(t), 1))
        place[:, 2] = deck_down_m(s)
        speed = np.zeros((len(t), 3))
        speed[:, 2] = -HEAVE_M * 2.0 * np.pi / HEAVE_S * np.cos(2.0 * np.pi * s / HEAVE_S)
        level = np.tile([1.0, 0.0, 0.0, 0.0], (len(t), 1))
        out.series.append(odometry_series("/truth/platform", Times(t, t + UTC), place, speed, level))
    return out


def small_log(path: Path, seconds: float = 16.0, seed: int = 7, truth: bool = True) -> Path:
    """Write the flight to an MCAP file and return its path."""
    with FlightWriter(path) as writer:
        writer.write_recording(small_recording(seconds, seed, truth))
    return path


def _three(v: np.ndarray) -> tuple[float, float, float]:
    return float(v[0]), float(v[1]), float(v[2])

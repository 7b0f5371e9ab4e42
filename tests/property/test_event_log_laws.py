"""Events written to a log are the events read from it, to the last bit."""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.events import (
    Attitude,
    Barometer,
    Covariance3,
    Event,
    EventBatch,
    GpsPosition,
    GpsVelocity,
    Imu,
    Magnetometer,
    Rangefinder,
    TimeSync,
    UserMeasurement,
    VisionFix,
)
from logs import FlightWriter, open_flight
from logs.event_columns import degrees_of
from logs.events import as_logged, events_of_series, series_of_batch

UTC = 1_700_000_000_000_000_000
number = st.floats(-1e6, 1e6)
single = st.floats(-1e6, 1e6, width=32)
vector = st.tuples(number, number, number)
variance = st.floats(1e-6, 1e6)
# Axes change their signs on the way into a message and back: a zero has none.
mixed = number.map(lambda x: x + 0.0)
covariance: st.SearchStrategy[Covariance3] = st.tuples(variance, mixed, mixed, variance, mixed, variance)
fix_type = st.integers(0, 3)
clocks = st.sampled_from(["autopilot", "companion", "camera", "sonar"])
# Receivers count in 1e-7 deg; these are the angles that a source of fixes can give.
angle = st.integers(-900_000_000, 900_000_000).map(lambda e7: float(np.radians(e7 * 1e-7)))
kelvin = st.one_of(st.floats(200.0, 340.0), st.just(math.nan))


@st.composite
def events(draw: st.DrawFn, arrival_ns: int) -> Event:
    """Draw an event of any kind."""
    stamp = draw(st.integers(0, 10**12))
    clock = draw(clocks)
    xyz, c = draw(vector), draw(covariance)
    maybe = draw(st.sampled_from([None, c]))
    match draw(st.integers(0, 9)):
        case 0:
            sensor = draw(st.sampled_from(["imu", "imu2"]))
            return Imu(stamp, arrival_ns, xyz, draw(vector), sensor, clock)
        case 1:
            lat, lon = draw(angle), draw(angle)
            return GpsPosition(
                stamp, arrival_ns, lat, lon, draw(number), maybe, draw(fix_type), "gps_position", clock
            )
        case 2:
            return GpsVelocity(stamp, arrival_ns, xyz, maybe, draw(fix_type), "gps_velocity", clock)
        case 3:
            # One barometer has one message a stamp.
            return Barometer(arrival_ns - UTC, arrival_ns, draw(number), draw(kelvin), "barometer", clock)
        case 4:
            return Magnetometer(stamp, arrival_ns, xyz, "compass", clock)
        case 5:
            return Attitude(stamp, arrival_ns, (*xyz, draw(number)), "attitude", clock)
        case 6:
            lowest, highest = draw(single), draw(st.sampled_from([math.inf, 40.0]))
            return Rangefinder(stamp, arrival_ns, draw(single), lowest, highest, "lidar", clock)
        case 7:
            return VisionFix(stamp, arrival_ns, xyz, c, "vision", clock)
        case 8:
            sent = arrival_ns - draw(st.integers(0, 10**8))
            received = draw(st.integers(sent, arrival_ns))
            return TimeSync(sent, stamp, received, arrival_ns, "timesync", "autopilot", "companion")
        case _:
            size = draw(st.integers(1, 3))
            own = draw(st.sampled_from([None, c[: size * (size + 1) // 2]]))
            return UserMeasurement(stamp, arrival_ns, xyz[:size], "sonar", own, clock)


@st.composite
def flights(draw: st.DrawFn) -> list[Event]:
    """Draw events in the order of arrival; some arrive together."""
    steps = draw(st.lists(st.sampled_from([1, 5_000_000, 700_000_000]), min_size=1, max_size=12))
    arrivals = (UTC + np.cumsum(steps)).tolist()
    return [draw(events(int(a))) for a in arrivals]


def same(a: Event, b: Event) -> bool:
    """Compare exactly; NaN equals NaN, as the temperature that is not known does."""
    return repr(a) == repr(b)


@settings(max_examples=60, deadline=None)
@given(flights())
def test_events_written_one_by_one_come_back(flight: list[Event]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "f.mcap"
        with FlightWriter(path, clock_offsets_ns=dict.fromkeys(["autopilot", "camera"], UTC)) as writer:
            for event in flight:
                writer.write_event(event)
        back = list(open_flight(path).events())
    assert len(back) == len(flight)
    for wrote, read in zip(flight, back, strict=True):
        assert same(wrote, read), (wrote, read)
        assert same(as_logged(wrote), wrote)


@settings(max_examples=60, deadline=None)
@given(flights())
def test_a_batch_comes_back_from_its_columns(flight: list[Event]) -> None:
    batch = EventBatch.from_events(flight)
    back = events_of_series(series_of_batch(batch))
    assert [repr(e) for e in back] == [repr(e) for e in flight]


@given(st.lists(st.integers(-1_800_000_000, 1_800_000_000), min_size=1, max_size=50))
def test_angles_of_receivers_survive_degrees(e7: list[int]) -> None:
    radians = np.radians(np.array(e7) * 1e-7)
    assert np.array_equal(np.radians(degrees_of(radians)), radians)


@given(st.floats(-math.pi, math.pi))
def test_any_angle_survives_degrees_but_for_its_last_bit(angle_rad: float) -> None:
    back = np.radians(degrees_of(np.array([angle_rad])))[0]
    assert abs(back - angle_rad) <= np.spacing(abs(angle_rad))
    logged = np.radians(degrees_of(np.array([back])))[0]
    assert logged == back

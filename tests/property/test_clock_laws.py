"""Laws of the clock maps: map and inverse give the stamp back, array and scalar agree, order is kept."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.clock import ClockMap
from estimation.clockbank import ArrivalMap, ClockBank
from estimation.events import TimeSync

MS = 1_000_000
stamps = st.integers(min_value=0, max_value=2 * 10**18)


def learned(reference_ns: int, remote_ns: int, skew_ppm: float, delays_us: list[int]) -> ClockMap:
    clock = ClockMap()
    for k, delay in enumerate(delays_us):
        sent = reference_ns + k * 100 * MS
        middle = k * 100 * MS + delay * 500
        remote = remote_ns + middle + round(middle * skew_ppm * 1e-6)
        clock.update(sent, remote, sent + delay * 1000)
    return clock


maps = st.builds(
    learned,
    stamps,
    stamps,
    st.floats(-100, 100),
    st.lists(st.integers(0, 20_000), min_size=1, max_size=30),
)


@given(maps, stamps)
@settings(max_examples=300, deadline=None)
def test_map_and_inverse_give_the_stamp_back(clock: ClockMap, stamp: int) -> None:
    assert abs(clock.from_reference(clock.to_reference(stamp)) - stamp) <= 1
    assert abs(clock.to_reference(clock.from_reference(stamp)) - stamp) <= 1


@given(stamps, stamps, st.integers(0, 10**6), stamps)
@settings(max_examples=200, deadline=None)
def test_without_skew_the_round_trip_is_exact(reference: int, remote: int, delay: int, stamp: int) -> None:
    clock = ClockMap()
    clock.update(reference, remote, reference + delay)
    assert clock.from_reference(clock.to_reference(stamp)) == stamp
    assert clock.to_reference(stamp) - stamp == reference + delay // 2 - remote


@given(maps, st.lists(stamps, min_size=1, max_size=20))
@settings(max_examples=200, deadline=None)
def test_arrays_are_mapped_as_scalars_and_in_order(clock: ClockMap, values: list[int]) -> None:
    ordered = sorted(values)
    mapped = clock.to_reference_array(np.array(ordered, np.int64))
    assert mapped.tolist() == [clock.to_reference(v) for v in ordered]
    assert np.all(np.diff(mapped) >= 0)


@given(maps, stamps)
@settings(max_examples=100, deadline=None)
def test_restored_map_gives_the_same_bits(clock: ClockMap, stamp: int) -> None:
    other = ClockMap()
    other.restore(clock.snapshot())
    assert other.to_reference(stamp) == clock.to_reference(stamp)
    assert other.snapshot() == clock.snapshot()


@given(st.lists(st.tuples(stamps, stamps), min_size=1, max_size=20), stamps)
@settings(max_examples=200, deadline=None)
def test_arrival_map_and_inverse_give_the_stamp_back(rows: list[tuple[int, int]], stamp: int) -> None:
    clock = ArrivalMap()
    for source, arrival in rows:
        clock.update(source, arrival)
    assert clock.from_reference(clock.to_reference(stamp)) == stamp


@given(
    st.lists(st.tuples(st.integers(0, 30_000), st.integers(-200, 200)), min_size=2, max_size=40),
    st.randoms(use_true_random=False),
)
@settings(max_examples=150, deadline=None)
def test_bank_keeps_the_order_of_stamps(steps: list[tuple[int, int]], random: object) -> None:
    """Converted in order of stamps, with exchanges of any quality in between, times never go back unsaid."""
    bank = ClockBank()
    last, said = -(10**19), 0
    for k, (delay_us, error_us) in enumerate(steps):
        sent = 10**18 + k * 10 * MS
        remote = 5 * 10**9 + k * 10 * MS + delay_us * 500 + error_us * 1000
        bank.exchange(TimeSync(sent, remote, sent + delay_us * 1000, sent))
        reading = bank.convert("companion", sent)
        assert reading is not None
        if bank.reacquired > said:
            said, last = bank.reacquired, -(10**19)
        assert reading.time_ns >= last
        last = reading.time_ns

"""Clock maps: accuracy, honesty, steps, outliers, and what they do with bad input."""

from __future__ import annotations

import json
import math

import numpy as np
import pytest

from estimation.clock import ClockMap, ClockSettings, SyncStatus
from estimation.clockbank import ARRIVAL, ArrivalMap, ClockBank
from estimation.events import TimeSync
from estimation.outcome import Outcome

REFERENCE = 1_700_000_000_000_000_000
REMOTE = 4_000_000_000
MS = 1_000_000
SECOND = 1_000_000_000


def exchanges(
    rng: np.random.Generator, n: int, skew: float = 20e-6, jitter_s: float = 2e-3, start_s: float = 0.0
) -> list[tuple[int, int, int]]:
    """10 Hz exchanges with a remote clock that started REMOTE ns before the reference's REFERENCE."""
    out = []
    for k in range(n):
        t = start_s + 0.1 * k
        there, back = rng.exponential(jitter_s, 2) + 0.5e-3
        remote = REMOTE + round((t + there) * 1e9) + round((t + there) * skew * 1e9)
        out.append((REFERENCE + round(t * 1e9), remote, REFERENCE + round((t + there + back) * 1e9)))
    return out


def true_offset_ns(reference_ns: int, skew: float = 20e-6) -> int:
    return REMOTE - REFERENCE + round((reference_ns - REFERENCE) * skew)


def test_offset_and_skew_are_learned_with_an_honest_sigma() -> None:
    errors, nees = [], []
    for seed in range(20):
        clock = ClockMap()
        for e in exchanges(np.random.default_rng(seed), 1200):
            clock.update(*e)
        at = REFERENCE + 119 * SECOND
        error = clock.offset_ns(at) - true_offset_ns(at)
        errors.append(error)
        nees.append((error / clock.sigma_ns(at)) ** 2)
        assert clock.status(at) is SyncStatus.LOCKED
        assert clock.skew_ppm == pytest.approx(20.0, abs=5 * clock.skew_sigma_ppm)
        assert clock.steps == clock.slips == 0
    assert np.sqrt(np.mean(np.square(errors))) < 100_000
    assert 0.3 < np.mean(nees) < 2.0


def test_sigma_grows_without_exchanges_and_the_map_becomes_stale() -> None:
    clock = ClockMap()
    assert clock.status() is SyncStatus.NONE
    assert math.isinf(clock.sigma_ns(REFERENCE))
    for e in exchanges(np.random.default_rng(1), 200):
        clock.update(*e)
    now = REFERENCE + 20 * SECOND
    assert clock.sigma_ns(now + 60 * SECOND) > 3 * clock.sigma_ns(now)
    assert clock.status(now + 60 * SECOND) is SyncStatus.STALE


def test_an_unused_map_refuses_to_convert() -> None:
    with pytest.raises(ValueError, match="no exchange yet"):
        ClockMap().to_reference(5)


def test_slow_round_trips_hardly_count() -> None:
    clock = ClockMap()
    for e in exchanges(np.random.default_rng(2), 300, jitter_s=0.2e-3):
        clock.update(*e)
    at = REFERENCE + 30 * SECOND
    before = clock.offset_ns(at)
    update = clock.update(at, REMOTE + 30 * SECOND + 100 * MS, at + 100 * MS)
    assert update.outcome is Outcome.FUSED
    assert abs(clock.offset_ns(at) - before) < 10_000


@pytest.mark.parametrize("jump_s", [1.0, -1.0, 0.2])
def test_a_step_of_the_remote_clock_is_reacquired_and_said(jump_s: float) -> None:
    rng = np.random.default_rng(3)
    clock = ClockMap()
    for e in exchanges(rng, 300):
        clock.update(*e)
    jump = round(jump_s * 1e9)
    updates = []
    for sent, remote, received in exchanges(rng, 100, start_s=30.0):
        updates.append(clock.update(sent, remote + jump, received))
    said = [u.step_ns for u in updates if u.step_ns]
    assert len(said) == 1
    assert said[0] == pytest.approx(jump, abs=10 * MS)
    assert [u.outcome for u in updates[:4]] == [Outcome.REJECTED_GATE] * 4
    assert clock.steps == 1
    at = REFERENCE + 40 * SECOND
    assert abs(clock.offset_ns(at) - jump - true_offset_ns(at)) < 5 * clock.sigma_ns(at) + 20_000
    assert clock.skew_ppm == pytest.approx(20.0, abs=5.0)


def test_one_outlier_is_set_aside_and_moves_nothing() -> None:
    rng = np.random.default_rng(4)
    with_outlier, without = ClockMap(), ClockMap()
    for k, (sent, remote, received) in enumerate(exchanges(rng, 300)):
        if k == 200:
            update = with_outlier.update(sent + 1, remote + SECOND, received + 1)
            assert update.outcome is Outcome.REJECTED_GATE
            assert with_outlier.status() is SyncStatus.SUSPECT
        with_outlier.update(sent, remote, received)
        without.update(sent, remote, received)
    at = REFERENCE + 30 * SECOND
    assert with_outlier.status(at) is SyncStatus.LOCKED
    assert with_outlier.steps == 0
    assert with_outlier.offset_ns(at) == without.offset_ns(at)


def test_scattered_outliers_are_never_believed() -> None:
    rng = np.random.default_rng(5)
    clock = ClockMap()
    for k, (sent, remote, received) in enumerate(exchanges(rng, 600)):
        bad = k > 100 and k % 20 < 8
        clock.update(sent, remote + (round(rng.uniform(1e8, 5e9)) if bad else 0), received)
    at = REFERENCE + 60 * SECOND
    assert clock.steps == 0
    assert abs(clock.offset_ns(at) - true_offset_ns(at)) < 300_000


def test_a_small_slip_is_followed() -> None:
    rng = np.random.default_rng(6)
    clock = ClockMap()
    for e in exchanges(rng, 300, jitter_s=0.2e-3):
        clock.update(*e)
    for sent, remote, received in exchanges(rng, 100, jitter_s=0.2e-3, start_s=30.0):
        assert clock.update(sent, remote + 10 * MS, received).step_ns == 0
    at = REFERENCE + 40 * SECOND
    assert (clock.steps, clock.slips) == (0, 1)
    assert abs(clock.offset_ns(at) - 10 * MS - true_offset_ns(at)) < 100_000


def test_reference_clock_running_backwards_is_reacquired() -> None:
    rng = np.random.default_rng(7)
    clock = ClockMap()
    for e in exchanges(rng, 300):
        clock.update(*e)
    back = 5 * SECOND
    updates = [
        clock.update(sent - back, remote, received - back)
        for sent, remote, received in exchanges(rng, 50, start_s=30.0)
    ]
    assert updates[0].outcome is Outcome.REJECTED_TOO_OLD
    assert [u.step_ns for u in updates if u.step_ns] == [pytest.approx(back, abs=10 * MS)]
    at = REFERENCE + 30 * SECOND
    assert abs(clock.offset_ns(at) - back - true_offset_ns(at + back)) < 2 * MS


@pytest.mark.parametrize(
    ("exchange", "outcome"),
    [
        ((REFERENCE + 100, REMOTE, REFERENCE), Outcome.REJECTED_NOT_READY),
        ((REFERENCE, REMOTE, REFERENCE + 2 * SECOND), Outcome.REJECTED_NOT_READY),
        ((REFERENCE - SECOND, REMOTE - SECOND, REFERENCE - SECOND + MS), Outcome.REJECTED_TOO_OLD),
    ],
)
def test_impossible_exchanges_are_named(exchange: tuple[int, int, int], outcome: Outcome) -> None:
    clock = ClockMap()
    last = exchanges(np.random.default_rng(8), 50)[-1]
    for e in exchanges(np.random.default_rng(8), 50):
        clock.update(*e)
    before = clock.snapshot()["state"]["line"]
    assert clock.update(*exchange).outcome is outcome
    assert clock.update(*last).outcome in {Outcome.REJECTED_DUPLICATE, Outcome.REJECTED_TOO_OLD}
    assert clock.snapshot()["state"]["line"] == before


def test_the_same_exchange_twice_is_a_duplicate() -> None:
    clock = ClockMap()
    (exchange,) = exchanges(np.random.default_rng(9), 1)
    clock.update(*exchange)
    assert clock.update(*exchange).outcome is Outcome.REJECTED_DUPLICATE
    assert clock.exchanges == 1


def test_a_longer_path_is_learned() -> None:
    """The quickest round trip of an hour ago must not make every exchange of a slower link look queued."""
    rng = np.random.default_rng(10)
    clock = ClockMap(ClockSettings(path_window_ns=10 * SECOND))
    for e in exchanges(rng, 300, jitter_s=0.1e-3):
        clock.update(*e)
    for sent, remote, received in exchanges(rng, 600, jitter_s=0.1e-3, start_s=30.0):
        clock.update(sent, remote + 10 * MS, received + 20 * MS)
    at = REFERENCE + 90 * SECOND
    assert abs(clock.offset_ns(at) - true_offset_ns(at)) < 50_000
    assert clock.asymmetry_bound_ns == pytest.approx(10.5 * MS, rel=0.05)


def sync(e: tuple[int, int, int], clock: str = "autopilot", reference: str = "companion") -> TimeSync:
    return TimeSync(e[0], e[1], e[2], e[2], clock=clock, reference_clock=reference)


def test_bank_takes_companion_stamps_to_the_autopilot_through_exchanges() -> None:
    bank = ClockBank()
    for e in exchanges(np.random.default_rng(11), 600):
        bank.exchange(sync(e))
    stamp = REFERENCE + 60 * SECOND
    reading = bank.convert("companion", stamp)
    assert reading is not None
    assert reading.source == "exchanges"
    assert abs(reading.time_ns - (stamp + true_offset_ns(stamp))) < 5 * reading.sigma_ns
    same = bank.convert("autopilot", 123)
    assert same is not None
    assert (same.time_ns, same.sigma_ns, same.source) == (123, 0.0, "same")
    (row,) = bank.summary(reading.time_ns)
    assert row.clock == "companion"
    assert row.offset_ns == pytest.approx(-true_offset_ns(stamp), abs=200_000)
    assert row.skew_ppm == pytest.approx(-20.0, abs=3.0)


def test_bank_chains_two_exchanges() -> None:
    bank = ClockBank()
    rng = np.random.default_rng(12)
    for a, b in zip(exchanges(rng, 300), exchanges(rng, 300, skew=-30e-6), strict=True):
        bank.exchange(sync(a, "autopilot", "companion"))
        bank.exchange(sync(b, "camera", "companion"))
    at = REFERENCE + 30 * SECOND
    reading = bank.convert("camera", at + true_offset_ns(at, -30e-6))
    assert reading is not None
    assert abs(reading.time_ns - (at + true_offset_ns(at))) < 5 * reading.sigma_ns
    assert bank.convert("elsewhere", at) is None


def test_bank_falls_back_to_arrivals_and_says_how_little_it_knows() -> None:
    bank = ClockBank()
    rng = np.random.default_rng(13)
    for k in range(400):
        t = k * 50 * MS
        bank.observe("autopilot", 7 * SECOND + t, REFERENCE + t + round(rng.exponential(1 * MS)))
        bank.observe("camera", t, REFERENCE + t + 40 * MS + round(rng.exponential(5 * MS)))
    reading = bank.convert("camera", 10 * SECOND)
    assert reading is not None
    assert reading.source == "arrivals"
    assert reading.time_ns == pytest.approx(17 * SECOND + 40 * MS, abs=2 * MS)
    assert reading.sigma_ns > 40 * MS
    stamped_at_arrival = bank.convert(ARRIVAL, REFERENCE + 10 * SECOND)
    assert stamped_at_arrival is not None
    assert stamped_at_arrival.time_ns == pytest.approx(17 * SECOND, abs=2 * MS)
    (row,) = bank.summary(17 * SECOND)
    assert (row.source, row.status) == ("arrivals", SyncStatus.ACQUIRING)
    assert row.offset_ns == pytest.approx(-7 * SECOND - 40 * MS, abs=2 * MS)


def test_bank_never_turns_back_within_a_clock_unless_it_says_so() -> None:
    bank = ClockBank()
    rng = np.random.default_rng(14)
    last, reports = -1, 0
    for k, e in enumerate(exchanges(rng, 400)):
        jump = -SECOND if k >= 250 else 0
        before = bank.reacquired
        bank.exchange(sync((e[0], e[1] + jump, e[2])))
        reports += bank.reacquired - before
        if bank.reacquired > before:
            last = -1
        for stamp in range(e[0], e[0] + 100 * MS, 10 * MS):
            reading = bank.convert("companion", stamp)
            assert reading is not None
            assert reading.time_ns >= last
            last = reading.time_ns
    assert reports == 1


def test_arrival_map_follows_a_step_but_not_an_outlier_or_a_stall() -> None:
    rng = np.random.default_rng(15)
    clock = ArrivalMap()
    said: list[int] = []
    for k in range(600):
        t = k * 50 * MS
        stamp, arrival = t, REFERENCE + t + 20 * MS + round(rng.exponential(3 * MS))
        if k == 100:
            stamp += 3 * SECOND
        if 200 <= k < 230:
            arrival = REFERENCE + 230 * 50 * MS + 20 * MS + k
        if k >= 400:
            stamp += SECOND
        update = clock.update(stamp, arrival)
        if update.step_ns:
            said.append(update.step_ns)
        if k == 100:
            assert update.outcome is Outcome.REJECTED_GATE
        if k == 399:
            assert clock.delay_ns == pytest.approx(REFERENCE + 20 * MS, abs=MS)
    assert said == [pytest.approx(SECOND, abs=5 * MS)]
    assert clock.delay_ns == pytest.approx(REFERENCE + 20 * MS - SECOND, abs=5 * MS)


def test_a_restored_bank_continues_with_the_same_bits() -> None:
    rng = np.random.default_rng(16)
    rows = exchanges(rng, 300)
    whole, half = ClockBank(), ClockBank()
    for k, e in enumerate(rows):
        if k == 150:
            half.restore(json.loads(json.dumps(whole.snapshot())))
        for bank in (whole, half) if k >= 150 else (whole,):
            bank.exchange(sync(e))
            bank.observe("camera", e[1], e[2])
            bank.observe("autopilot", e[1], e[2])
            bank.convert("companion", e[0])
            bank.convert("camera", e[1])
    assert whole.snapshot() == half.snapshot()

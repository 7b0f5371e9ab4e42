"""Smoothing whole flights: what it must keep, where it must stop, and what it may cost."""

from __future__ import annotations

import math
import tracemalloc
from collections.abc import Iterable

import numpy as np
import pytest
from numpy.typing import NDArray
from small_flight import LATITUDE, LONGITUDE, deck_events, small_events

from estimation import smoother
from estimation.config import Config, parse_config
from estimation.deck import HEAVE
from estimation.estimator import LandingEstimator
from estimation.events import Event, EventBatch, GpsPosition, Kind
from estimation.heave.model import HeaveModel
from estimation.learning import MotionLearner
from estimation.output import Run
from estimation.parameters import pack_parameters
from estimation.rows import Rows
from estimation.state import CAMERA_LATENCY, CAMERA_MOUNT, NOMINAL, Layout
from estimation.update import reset_datum, reset_transition

Array = NDArray[np.float64]
DECK = "[platform]\nuse = true\nlearn_s = 5.0\n"
UNLEARNED = "[platform]\nuse = true\nlearn_s = 0.0\n"


def in_order(events: Iterable[Event]) -> EventBatch:
    return EventBatch.from_events(sorted(events, key=lambda e: e.arrival_ns))


def smoothed(batch: EventBatch, config: Config, engine: str = "auto") -> tuple[Run, Run]:
    estimator = LandingEstimator(config, engine, smooth=True)  # type: ignore[arg-type]
    run = estimator.run(batch)
    return run, estimator.smoothed(run)


@pytest.fixture(scope="module")
def deck_flight() -> EventBatch:
    return in_order(small_events(20.0) + deck_events(20.0))


@pytest.fixture(scope="module")
def both(deck_flight: EventBatch) -> tuple[Run, Run]:
    return smoothed(deck_flight, parse_config(DECK))


def test_it_ends_where_the_filter_ends(both: tuple[Run, Run]) -> None:
    run, smooth = both
    assert smooth.t_ns[-1] == run.t_ns[-1]
    # The last estimate; an inertial sample or two behind it tell nothing more.
    assert np.abs(smooth.nominal[-1] - run.nominal[-1]).max() < 1e-12
    assert np.abs(smooth.covariance[-1] - run.covariance[-1]).max() < 1e-12
    assert np.abs(smooth.deck_covariance[-1] - run.deck_covariance[-1]).max() < 1e-12


def test_it_is_surer_and_nearer_the_truth(both: tuple[Run, Run]) -> None:
    """The vehicle rests at a place; its deck heaves below it."""
    run, smooth = both
    late = np.isin(smooth.t_ns, run.t_ns)
    assert np.array_equal(smooth.t_ns[late], run.t_ns)
    assert np.all(smooth.sigma[late][:, :6] <= run.sigma[:, :6] * (1.0 + 1e-9))
    assert np.sqrt(np.mean(smooth.velocity_mps[late] ** 2)) < 0.8 * np.sqrt(np.mean(run.velocity_mps**2))
    heave = 0.3 * np.sin(2.0 * np.pi * (run.t_ns * 1e-9 - 40.0) / 5.0)
    seen = run.t_ns > run.t_ns[0] + 5_000_000_000
    errors = [up[seen] - heave[seen] for up in (run.deck[:, 6], smooth.deck[late][:, 6])]
    filtered_rms, smoothed_rms = (float(np.std(e)) for e in errors)
    assert smoothed_rms < 0.8 * filtered_rms


def test_covariances_stay_positive(both: tuple[Run, Run]) -> None:
    for P in (both[1].covariance, both[1].deck_covariance):
        scale = np.sqrt(np.einsum("nii->ni", P))
        unit = P / (scale[:, :, None] * scale[:, None, :])
        assert np.array_equal(P[:, :9, :9], P[:, :9, :9].transpose(0, 2, 1)) or P.shape[1] == 8
        assert np.linalg.eigvalsh(unit).min() > -1e-9


@pytest.mark.parametrize("latency_walk", [0.0, 3e-5])
def test_considered_states_are_left_alone(deck_flight: EventBatch, latency_walk: float) -> None:
    """Without rotation neither the camera's mounting nor its age can be learned, before or after: but for a little of
    the walk of the age, 0.1 ms in 20 s, which a smoother sees at both ends."""
    run, smooth = smoothed(deck_flight, parse_config(f"{DECK}[vision]\nlatency_walk = {latency_walk}\n"))
    mount = slice(NOMINAL[CAMERA_MOUNT], NOMINAL[CAMERA_MOUNT] + 3)
    assert np.abs(smooth.nominal[:, mount] - run.nominal[-1, mount]).max() < 1e-12
    age = NOMINAL[CAMERA_LATENCY]
    walked = latency_walk * math.sqrt(20.0)
    assert np.abs(smooth.nominal[:, age] - run.nominal[-1, age]).max() < 1e-12 + 1e-3 * walked


def test_both_engines_give_the_same(deck_flight: EventBatch, monkeypatch: pytest.MonkeyPatch) -> None:
    """With a heave model taken up in flight; a given one, since learning is not the engines' part."""
    pytest.importorskip("numba", reason="the compiled engine needs numba")
    taken = np.array([0.05, 1.2566, 1.2566, 1.1, 0.1, 0.1, 0.3, 0.2, 0.1, 1.3, 0.05])
    due_ns = int(deck_flight.rows["stamp_ns"].min()) + 8_000_000_000
    changed = {HEAVE: np.array([*taken[:7], taken[-1]])}

    def take(self: MotionLearner, settled: Rows) -> list[tuple[int, HeaveModel | None, dict[int, Array]]]:
        return [(due_ns, None, changed)] if settled.t_ns[0] <= due_ns < settled.t_ns[-1] else []

    monkeypatch.setattr(MotionLearner, "take", take)
    one, other = (smoothed(deck_flight, parse_config(DECK), e) for e in ("compiled", "filterpy"))
    assert len(one[0].heave) == 1
    assert np.abs(one[0].deck - smoothed(deck_flight, parse_config(UNLEARNED))[0].deck).max() > 1e-3
    for column in ("nominal", "sigma", "covariance", "deck", "deck_covariance"):
        assert np.abs(getattr(one[1], column) - getattr(other[1], column)).max() < 1e-9, column


@pytest.mark.parametrize("engine", ["filterpy", "compiled"])
def test_order_of_arrival_does_not_matter(engine: str) -> None:
    if engine == "compiled":
        pytest.importorskip("numba", reason="the compiled engine needs numba")
    batch = in_order(small_events(6.0))
    delay = np.random.default_rng(3).integers(0, 200_000_000, len(batch))
    late = EventBatch(batch.rows[np.argsort(batch.rows["arrival_ns"] + delay, kind="stable")], batch.sensors)
    # The declination is of the day of the first event that arrives.
    config = parse_config("[magnetometer]\ndeclination_deg = 3.0\n")
    one, other = (smoothed(b, config, engine)[1] for b in (batch, late))
    for column in ("t_ns", "nominal", "sigma", "covariance"):
        assert getattr(one, column).tobytes() == getattr(other, column).tobytes(), column


def test_nothing_is_carried_over_a_new_alignment() -> None:
    """Inertial samples are missing for long: what comes later does not touch what was before."""
    events = small_events(20.0)
    begin = min(e.stamp_ns for e in events)
    gap = (begin + 8_000_000_000, begin + 12_000_000_000)
    broken = [e for e in events if not gap[0] < e.stamp_ns < gap[1]]
    run, whole = smoothed(in_order(broken), Config())
    assert any("aligning again" in text for _, text in run.notes)
    first = smoothed(in_order(e for e in broken if e.stamp_ns <= gap[0]), Config())[1]
    before = whole.t_ns <= gap[0]
    assert np.array_equal(whole.t_ns[before], first.t_ns)
    assert whole.nominal[before].tobytes() == first.nominal.tobytes()
    assert np.abs(whole.nominal[~before][-1] - run.nominal[-1]).max() < 1e-12


def test_what_a_reset_cuts_is_not_carried_back() -> None:
    """A receiver jumps by 200 m for good: once the filter is moved onto it, the track before stays where it was."""
    jump_ns = 40_000_000_000 + 10_000_000_000
    moved = [
        GpsPosition(e.stamp_ns, e.arrival_ns, e.latitude_rad + 200.0 / 6.37e6, e.longitude_rad, e.altitude_m)
        if isinstance(e, GpsPosition) and e.stamp_ns > jump_ns
        else e
        for e in small_events(20.0)
    ]
    run, smooth = smoothed(in_order(moved), parse_config("[gps]\nreset_after_s = 2.0\n"))
    assert any("moved onto it" in text for _, text in run.notes)
    assert run.position_m[-1, 0] > 190.0
    before = smooth.t_ns < jump_ns
    assert np.abs(smooth.position_m[before, :2]).max() < 5.0
    assert np.abs(smooth.position_m[-200:, 0] - 200.0).max() < 5.0
    assert pytest.approx((0.9424778, 0.1308997)) == (LATITUDE, LONGITUDE)


@pytest.mark.parametrize("kind", [Kind.GPS_POSITION, Kind.GPS_VELOCITY, Kind.BAROMETER, Kind.VISION])
def test_a_reset_is_a_transition(kind: Kind) -> None:
    layout = Layout.of(parse_config(DECK))
    n = layout.size
    rng = np.random.default_rng(1)
    A = rng.normal(size=(n, n))
    P = A @ A.T + np.eye(n)
    R = np.diag([0.3, 0.4, 0.5])
    dimension = 1 if kind == Kind.BAROMETER else 3
    T = reset_transition(int(kind), dimension, layout.offsets, n)
    moved = P.copy()
    reset_datum(int(kind), np.zeros(60), moved, np.ones(3), R, dimension, layout.offsets)
    noise = moved - T @ P @ T.T
    assert np.abs(noise - np.diag(np.diag(noise))).max() < 1e-9
    assert np.diag(noise).min() > -1e-9
    assert np.count_nonzero(np.diag(noise) > 1e-6) == dimension


def test_memory_is_flat_in_the_length_of_the_flight(monkeypatch: pytest.MonkeyPatch) -> None:
    """Beyond the events themselves and the result, which are as long as the flight."""
    peaks = []
    for seconds in (8.0, 32.0):
        estimator = LandingEstimator(Config(), smooth=True)
        estimator.run(in_order(small_events(seconds)))
        tape, layout = estimator._history.tape, estimator.layout
        assert tape is not None
        assert estimator._site is not None
        p = pack_parameters(Config(), estimator._site)
        (interval,) = tape.intervals
        rows = interval.rows()
        monkeypatch.setattr(type(interval), "rows", lambda _, rows=rows: rows)
        list(smoother._interval(interval, layout, p, 20_000_000))
        tracemalloc.start()
        for _ in smoother._interval(interval, layout, p, 20_000_000):
            pass
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
        assert len(interval.states) <= 1 + interval.size // 4096
    assert peaks[1] < 1.1 * peaks[0], peaks


def test_it_must_have_been_asked_for() -> None:
    estimator = LandingEstimator()
    run = estimator.run(in_order(small_events(3.0)))
    with pytest.raises(ValueError, match="smooth=True"):
        estimator.smoothed(run)


def test_a_flight_that_never_starts_is_smoothed_to_nothing() -> None:
    run, smooth = smoothed(in_order(e for e in small_events(3.0) if not isinstance(e, GpsPosition)), Config())
    assert len(run.t_ns) == len(smooth.t_ns) == 0

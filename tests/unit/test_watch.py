"""A learned heave is let go when the deck moves otherwise, and only then."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from small_flight import BOOT, UTC, small_events

from estimation.band import band_derivatives, band_stationary
from estimation.camera_age import SCATTER_SIZE
from estimation.config import parse_config
from estimation.deck import HEAVE, MOTION_SIZE, prior_motion
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import AUTOPILOT, Event, EventBatch, VisionFix
from estimation.heave.model import HeaveModel
from estimation.learning import MotionLearner
from estimation.output import Run
from estimation.parameters import PRIOR_HEAVE, Site, pack_parameters
from estimation.rows import Rows
from estimation.state import PH0, PLATFORM_HEAVE, Layout, nominal_zero
from estimation.update import MEMORY_SIZE
from estimation.watch import let_go, unexplained

Array = NDArray[np.float64]
CONFIG = parse_config("[platform]\nuse = true\n")
LAYOUT = Layout.of(CONFIG)
P = pack_parameters(CONFIG, Site((0.9, 0.1, 50.0), 0.0))
STILL_S, MOVING_S, HEAVE_M, PERIOD_S = 20.0, 16.0, 0.5, 5.0
LET_GO = "no longer moves as was learned"


def learned(sigma_m: float) -> Array:
    heave = prior_motion(CONFIG.platform)
    heave[1:4] *= 1.3
    heave[0] = 1.0
    heave[0] = sigma_m / math.sqrt(band_stationary(heave[:7])[5, 5])
    return heave


def watched(up_m: Array, sigma_m: float, heave: Array, weight: float = 1.0) -> list[int]:
    """Return at which of the fixes, 20 Hz, with these innovations (up) the motion would be let go."""
    memory, S = np.zeros(MEMORY_SIZE), np.eye(3) * sigma_m**2
    x = nominal_zero()
    out = []
    for k, up in enumerate(up_m.tolist()):
        # A level camera that looks down: z of the camera is down.
        r = np.array([0.0, 0.0, -up])
        if unexplained(memory, 10.0 + 0.05 * k, r, S, weight, x, P, heave):
            out.append(k)
            memory[7:] = 0.0
    return out


def test_white_innovations_never_let_the_motion_go() -> None:
    rng = np.random.default_rng(3)
    assert not watched(0.1 * rng.standard_normal(40_000), 0.1, learned(0.05))


def test_single_wild_fixes_do_not_either() -> None:
    up = 0.1 * np.random.default_rng(4).standard_normal(2_000)
    up[::100] += 1.5
    assert not watched(up, 0.1, learned(0.05))
    assert not watched(np.full(200, 2.0), 0.1, learned(0.05), weight=0.0)


def test_a_deck_that_stays_away_does_within_two_seconds() -> None:
    up = 0.1 * np.random.default_rng(5).standard_normal(400)
    up[200:] += 0.15
    first = watched(up, 0.1, learned(0.05))[0]
    assert 200 < first < 240


def test_a_misfit_small_against_the_sea_is_none_and_any_sea_is_not_let_go() -> None:
    up = 0.01 * np.random.default_rng(6).standard_normal(400) + 0.02
    assert watched(up, 0.01, learned(0.03))
    assert not watched(up, 0.01, learned(0.3))
    assert not watched(up + 1.0, 0.01, prior_motion(CONFIG.platform))


def test_letting_go_keeps_the_motion_and_opens_its_doubt() -> None:
    rng = np.random.default_rng(7)
    heave, before = learned(0.05), learned(0.05)
    A = rng.normal(size=(LAYOUT.size, LAYOUT.size)) * 0.1
    covariance = A @ A.T + 1e-6 * np.eye(LAYOUT.size)
    x = nominal_zero()
    x[PH0 : PH0 + 6] = rng.normal(size=6) * 0.1
    moved = band_derivatives(x[PH0 : PH0 + 6], before[:7])
    memory, scatter = np.full(MEMORY_SIZE, 0.5), np.zeros(SCATTER_SIZE)
    old = covariance.copy()
    let_go(12.0, x, covariance, memory, scatter, heave, P, LAYOUT.offsets, np.empty((0, 0)))
    assert np.array_equal(heave[:7], P[PRIOR_HEAVE : PRIOR_HEAVE + 7]) and len(heave) == MOTION_SIZE
    np.testing.assert_allclose(band_derivatives(x[PH0 : PH0 + 6], heave[:7])[3:], moved[3:], rtol=1e-9)
    assert np.linalg.eigvalsh(covariance).min() > 0.0
    start = int(LAYOUT.offsets[PLATFORM_HEAVE])
    sea = band_stationary(heave[:7])
    grown = covariance[start + 5, start + 5] - old[start + 5, start + 5]
    assert grown == pytest.approx(sea[5, 5], rel=1e-6)
    assert scatter[3] == 12.0 and not memory[7:].any()


def deck_m(seconds: float) -> float:
    moved = max(0.0, seconds - STILL_S)
    return HEAVE_M * math.sin(2.0 * math.pi * moved / PERIOD_S)


def flight() -> EventBatch:
    """Return the small flight over a deck that stands still at first: 10 Hz, 10 cm of noise in height, 50 ms late."""
    rng = np.random.default_rng(8)
    seconds = STILL_S + MOVING_S
    events: list[Event] = small_events(seconds)
    for i in range(int(seconds * 10)):
        t = BOOT + i * 100_000_000
        seen = np.array([0.0, 0.0, 6.0 - deck_m(i / 10.0)]) + rng.normal(size=3) * np.array([0.02, 0.02, 0.1])
        own = (4e-4, 0.0, 0.0, 4e-4, 0.0, 1e-2)
        place = (float(seen[0]), float(seen[1]), float(seen[2]))
        events.append(VisionFix(t, UTC + t + 50_000_000, place, own, clock=AUTOPILOT))
    return EventBatch.from_events(sorted(events, key=lambda e: e.arrival_ns))


def flown(engine: EngineName) -> Run:
    return LandingEstimator(CONFIG, engine).run(flight())


def let_go_s(run: Run) -> list[float]:
    return [(t - BOOT) * 1e-9 for t, text in run.notes if LET_GO in text]


def test_a_deck_that_begins_to_move_is_followed() -> None:
    one = flown("auto")
    times = let_go_s(one)
    assert len(times) == 1 and STILL_S < times[0] < STILL_S + 3.0
    seconds = (one.t_ns - BOOT) * 1e-9
    late = seconds > STILL_S + 4.0
    error = one.deck[late, 6] - np.array([deck_m(s) for s in seconds[late]])
    assert np.std(error) < 0.08


def test_both_engines_let_go_at_the_same_fix(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of a given heave, since learning is not the engines' part; the one that is still on its way is not taken up."""
    pytest.importorskip("numba", reason="the compiled engine needs numba")
    still = prior_motion(CONFIG.platform)
    still[0] *= 0.05
    dues = [BOOT + int(s * 1e9) for s in (12.0, STILL_S + 0.5)]

    changed = {HEAVE: np.array([*still[:7], still[-1]])}

    def take(self: MotionLearner, settled: Rows) -> list[tuple[int, HeaveModel | None, dict[int, Array]]]:
        return [(due, None, changed) for due in dues if settled.t_ns[0] <= due < settled.t_ns[-1]]

    monkeypatch.setattr(MotionLearner, "take", take)
    one, other = flown("compiled"), flown("filterpy")
    assert let_go_s(one) == let_go_s(other) and len(let_go_s(one)) == 1
    assert np.abs(one.deck - other.deck).max() < 1e-9
    assert np.abs(one.deck_covariance - other.deck_covariance).max() < 1e-9


def test_the_order_of_arrival_does_not_show() -> None:
    batch = flight()
    rng = np.random.default_rng(9)
    shuffled = [
        (e.arrival_ns + (int(rng.uniform(0.0, 3e8)) if isinstance(e, VisionFix) else 0), k, e)
        for k, e in enumerate(batch)
    ]
    moved = EventBatch.from_events([e for _, _, e in sorted(shuffled, key=lambda s: s[:2])])
    one, other = (LandingEstimator(CONFIG).run(b) for b in (batch, moved))
    assert let_go_s(one) == let_go_s(other) and len(let_go_s(one)) == 1
    assert np.array_equal(one.records["nis"], other.records["nis"], equal_nan=True)

"""What the landing modes never do, whatever they are told."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.ahead import DeckForecast
from estimation.frames import euler_to_quat
from estimation.guidance import (
    FRESH_S,
    PRESS_MPS,
    deck_rate_ahead,
    falls_faster,
    held_up,
    inside_probability,
    keeps_sight,
    probably_inside_at_contact,
    probably_met,
    search_altitude_m,
    time_to_contact,
)
from estimation.landing import BOUNCE, step
from estimation.landing_config import LandingConfig
from estimation.modes import EXPLANATIONS, Mode, Progress, Reason, Situation
from estimation.output import Estimate
from estimation.state import NOMINAL_SIZE, Q0

C = LandingConfig()
HORIZON = np.arange(0.0, 6.0, 0.1)

number = st.floats(-3.0, 3.0)
small = st.floats(0.01, 1.5)


@st.composite
def situations(draw: st.DrawFn, now_ns: int = 0) -> Situation:
    relative = np.array([draw(st.floats(-1.5, 1.5)), draw(st.floats(-1.5, 1.5)), -draw(st.floats(0.0, 8.0))])
    covariance = np.diag([draw(small) ** 2 * 0.05 for _ in range(8)])
    deck = np.concatenate([relative, [draw(number) for _ in range(3)], [0.0, draw(st.floats(-1.0, 1.0))]])
    nominal = np.zeros(NOMINAL_SIZE)
    q = euler_to_quat(draw(st.floats(-0.5, 0.5)), draw(st.floats(-0.5, 0.5)), draw(number))
    nominal[Q0 : Q0 + 4] = q
    nine = np.eye(9) * draw(st.sampled_from([0.01, 0.04, 100.0]))
    bad = draw(st.sampled_from([0.0] * 9 + [math.nan]))
    position = relative + bad
    age = draw(st.sampled_from([0, 0, 0, 20_000_000, 400_000_000]))
    estimate = Estimate(
        now_ns - age, position, deck[3:6].copy(), q, nine, nominal, np.ones(36), deck, covariance
    )
    rate, sigma = draw(st.floats(-0.8, 0.8)), draw(st.floats(0.01, 0.5))
    growth = draw(st.floats(0.0, 0.5))
    forecast = DeckForecast(
        now_ns, HORIZON, 0.0 * HORIZON, 0.1 + 0.0 * HORIZON, rate * np.cos(HORIZON), sigma + 0.0 * HORIZON,
        0.0 * HORIZON + draw(st.floats(0.0, 1.0)), 0.5, draw(st.booleans()),
        np.zeros((len(HORIZON), 2)),
        covariance[:2, :2] + (growth * HORIZON)[:, None, None] ** 2 * np.eye(2),
    )  # fmt: skip
    return Situation(
        now_ns,
        draw(st.sampled_from([estimate] * 9 + [None])),
        draw(st.sampled_from([0.0, 0.1, 0.3, 0.9, 1.5, math.inf])),
        draw(st.sampled_from([forecast, None])),
        draw(st.booleans()),
    )


@st.composite
def missions(draw: st.DrawFn) -> list[Situation]:
    """A situation that lasts for a while, then another: so that all modes are reached."""
    flown: list[Situation] = []
    for _ in range(draw(st.integers(1, 8))):
        seen = draw(situations())
        for _ in range(draw(st.integers(1, 12))):
            now = len(flown) * 300_000_000
            age = 0 if seen.estimate is None else seen.now_ns - seen.estimate.t_ns
            estimate = None if seen.estimate is None else replace(seen.estimate, t_ns=now - age)
            flown.append(replace(seen, now_ns=now, estimate=estimate))
    return flown


starts = st.sampled_from([Mode.IDLE, Mode.SEARCH, Mode.TRACKING, Mode.OBSERVATION, Mode.LANDING, Mode.ABORT])


@given(starts, st.booleans(), missions())
@settings(max_examples=150, deadline=None)
def test_no_mission_breaks_the_rules(mode: Mode, descending: bool, mission: list[Situation]) -> None:
    descent = 0 if descending and mode is Mode.LANDING else None
    before = Progress(mode, Reason.STARTED, descent_ns=descent)
    for seen in mission:
        after, decision = step(before, seen, C)
        assert step(before, seen, C)[0] == after
        assert decision.mode is after.mode
        assert decision.reason in EXPLANATIONS
        assert np.all(np.isfinite(decision.velocity_mps))
        e = seen.estimate
        stale = e is None or seen.now_ns - e.t_ns > C.stale_s * 1e9
        if after.mode is Mode.LANDED and before.mode is not Mode.LANDED:
            assert before.mode is Mode.LANDING
            late = before.rose_ns is not None and seen.now_ns - before.rose_ns <= C.contact_s * 1e9
            assert before.descent_ns is not None or late
            assert seen.on_deck
        elif stale:
            assert after.mode in (Mode.ABORT, Mode.IDLE, Mode.LANDED)
            if after.mode is Mode.ABORT:
                assert decision.velocity_mps[2] < 0.0
        elif after.mode is Mode.LANDING and e is not None:
            height, rate = -e.deck[2], deck_rate_ahead(e, seen.forecast, C.response_s)
            # At most 0.5 m/s relative to the deck; where it may stand, to the vehicle, which goes as the deck does.
            pressed = after.met_ns is not None and after.descent_ns is not None
            most = max(C.touchdown_rate_mps, e.velocity_mps[2] + PRESS_MPS) if pressed else -math.inf
            # Out of sight the deck falls as it must where it has not been met.
            blind = after.descent_ns is not None and seen.detection_age_s >= FRESH_S
            falls = falls_faster(e, C) if blind else 0.0
            assert 0.0 <= falls <= C.approach_rate_mps
            assert decision.velocity_mps[2] <= max(most, C.approach_rate_mps + falls - rate) + 1e-12
            pauses = after.descent_ns is not None and not blind and not keeps_sight(e, seen.forecast, C)
            if pauses:
                assert decision.velocity_mps[2] <= max(most, -rate) + 1e-12
            if before.mode is Mode.LANDING:
                risen = before.rose_ns is not None and seen.now_ns - before.rose_ns <= C.lost_s * 1e9
                stands = after.descent_ns is not None and held_up(after, e, C)
                assert seen.detection_age_s <= C.lost_s or height <= C.blind_height_m or risen or stands
            if after.descent_ns is not None:
                P, fresh = e.deck_covariance, before.descent_ns is None
                # In the descent it is the place at contact that counts: in sight as far ahead as the vehicle takes to
                # answer, without it low over the deck all the way down.
                blind = seen.detection_age_s >= FRESH_S and height <= C.blind_height_m
                ahead = 0.0 if fresh else min(time_to_contact(height, C), C.response_s)
                T = np.hstack([np.eye(2), np.zeros((2, 1)), ahead * np.eye(2), np.zeros((2, 3))])
                inside = inside_probability(T @ e.deck, T @ P @ T.T, C.r_land_m)
                if blind and not fresh:
                    inside = probably_inside_at_contact(e, seen.forecast, C)
                asked = C.land_probability if fresh or blind else C.abort_probability
                # Where touching on the way up is the greater risk, or it stands or should by now, it is not led up.
                met = 0.0 if fresh else probably_met(e, seen.forecast, C)
                stood = after.met_ns is not None and seen.now_ns - after.met_ns >= C.response_s * 1e9
                stood = stood or (not fresh and held_up(after, e, C))
                assert stood or 1.0 - inside <= max(1.0 - asked, BOUNCE * met) + 1e-9
                if met < 0.5 and not blind and after.met_ns is not None:
                    # In sight there is one more reason to hold that it stands: it does not go down as it is told.
                    assert before.answers_mps is not None
                    assert held_up(after, e, C)
        if after.mode is not before.mode:
            assert after.since_ns == seen.now_ns
        before = after


mean = st.tuples(number, number).map(np.array)
sigma = st.floats(0.02, 2.0)


@given(mean, sigma, sigma, st.floats(0.0, math.pi), st.floats(0.1, 3.0))
@settings(max_examples=40, deadline=None)
def test_the_probability_of_being_inside_is_that_of_draws(
    m: np.ndarray, a: float, b: float, turn: float, radius: float
) -> None:
    axes = np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    S = axes @ np.diag([a * a, b * b]) @ axes.T
    chance = inside_probability(m, S, radius)
    drawn = m + (np.random.default_rng(1).standard_normal((40_000, 2)) * [a, b]) @ axes.T
    share = float(np.mean(np.hypot(drawn[:, 0], drawn[:, 1]) < radius))
    assert abs(chance - share) < 0.015
    assert inside_probability(m, S, 1.2 * radius) >= chance - 1e-9


@given(mean, st.floats(0.1, 3.0))
@settings(deadline=None)
def test_a_point_is_inside_or_not(m: np.ndarray, radius: float) -> None:
    distance = float(np.hypot(*m))
    if abs(distance - radius) > 1e-3 * radius:
        chance = inside_probability(m, np.zeros((2, 2)), radius)
        assert abs(chance - (distance < radius)) < 1e-6


@given(st.floats(0.5, 30.0), st.floats(0.0, 10.0), st.floats(0.0, 10.0), st.floats(0.3, 2.0))
@settings(deadline=None)
def test_from_the_search_altitude_the_platform_is_in_view(
    r: float, horizontal: float, vertical: float, fov: float
) -> None:
    c = LandingConfig(
        anchor_radius_m=r, gps_horizontal_error_m=horizontal, gps_vertical_error_m=vertical,
        field_of_view_rad=fov,
    )  # fmt: skip
    lowest = search_altitude_m(c) - vertical
    assert lowest * math.tan(0.5 * fov) >= (r + horizontal) * (1.0 - 1e-12)

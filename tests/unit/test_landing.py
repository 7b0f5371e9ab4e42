"""The landing modes: the seed's numbers, and one landing from the search to contact."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from estimation.ahead import DeckForecast
from estimation.config import Config, ConfigError, parse_config
from estimation.frames import euler_to_quat
from estimation.guidance import (
    FOLLOW_MPS2,
    FRESH_S,
    descent_rate,
    falls_faster,
    held_up,
    inside_probability,
    keeps_sight,
    probably_inside_at_contact,
    probably_met,
    search_altitude_m,
    time_to_contact,
)
from estimation.landing import OVERDUE_S, step
from estimation.landing_config import LandingConfig
from estimation.modes import EXPLANATIONS, Decision, Mode, Progress, Reason, Situation
from estimation.output import Estimate
from estimation.state import NOMINAL_SIZE
from logs.estimates import landing_series
from logs.topics import definition_text

HORIZON = np.arange(0.0, 6.0, 0.1)


def estimate(
    t_ns: int,
    relative: tuple[float, float, float],
    rate: float = 0.0,
    roll: float = 0.0,
    down_mps: float = 0.0,
) -> Estimate:
    deck = np.array([*relative, 0.0, 0.0, 0.0, 0.0, rate])
    return Estimate(
        t_ns, np.array(relative), np.array([0.0, 0.0, down_mps]), euler_to_quat(roll, 0.0, 0.3), 0.01 * np.eye(9),
        np.zeros(NOMINAL_SIZE), np.ones(36), deck, 1e-4 * np.eye(8),
    )  # fmt: skip


def forecast(t_ns: int, rate: float, skill: float = 0.8, growth_mps: float = 0.0) -> DeckForecast:
    """A forecast whose relative place, if nothing more is seen, becomes unknown at this rate (1-sigma)."""
    ones = np.ones(len(HORIZON))
    apart = (1e-4 + (growth_mps * HORIZON) ** 2)[:, None, None] * np.eye(2)
    return DeckForecast(
        t_ns,
        HORIZON,
        0 * ones,
        0.1 * ones,
        rate * ones,
        0.05 * ones,
        skill * ones,
        0.4,
        True,
        np.zeros((len(HORIZON), 2)),
        apart,
    )


def fly(p: Progress, seconds: float, seen: Situation, c: LandingConfig) -> tuple[Progress, Decision]:
    """Let a situation last, at 20 Hz."""
    for _ in range(max(1, round(20 * seconds))):
        now = seen.now_ns + 50_000_000
        e = None if seen.estimate is None else replace(seen.estimate, t_ns=now)
        seen = replace(seen, now_ns=now, estimate=e)
        p, decision = step(p, seen, c)
    return p, decision


def test_the_seeds_example_is_searched_from_42_m() -> None:
    c = LandingConfig(
        anchor_radius_m=15.0, gps_horizontal_error_m=2.0, gps_vertical_error_m=5.0,
        field_of_view_rad=math.radians(50.0),
    )  # fmt: skip
    assert search_altitude_m(c) == 42.0
    assert search_altitude_m(replace_field(c, search_altitude_m=20.5)) == 20.5


def replace_field(c: LandingConfig, **changed: float) -> LandingConfig:
    return LandingConfig(**{f: changed.get(f, getattr(c, f)) for f in c.__struct_fields__})


def test_a_landing_goes_through_all_modes_in_order() -> None:
    c = LandingConfig()
    high = search_altitude_m(c)
    p, said = step(Progress(), Situation(0, None), c)
    assert said.mode is Mode.IDLE
    p, said = fly(p, 0.1, Situation(0, estimate(0, (8.0, -6.0, -high))), c)
    assert (said.mode, said.reason) == (Mode.SEARCH, Reason.STARTED)
    assert said.velocity_mps == pytest.approx([-3.2, 2.4, 0.0])
    p, said = fly(p, 1.0, Situation(p.since_ns, estimate(0, (1.0, 0.0, -high)), 0.1), c)
    assert (said.mode, said.reason) == (Mode.TRACKING, Reason.TARGET_FOUND)
    assert said.velocity_mps[2] > 0.5
    low = c.track_share * high
    p, said = fly(p, 1.2, Situation(p.since_ns, estimate(0, (0.1, 0.0, -low)), 0.1), c)
    assert (said.mode, said.reason) == (Mode.OBSERVATION, Reason.ALIGNED)
    moving = Situation(p.since_ns, estimate(0, (0.1, 0.0, -low), 0.4), 0.1, forecast(0, 0.4))
    p, said = fly(p, c.observe_s - 1.0, moving, c)
    assert said.mode is Mode.OBSERVATION
    p, said = fly(p, 1.5, replace(moving, now_ns=p.since_ns + round((c.observe_s - 1.0) * 1e9)), c)
    assert (said.mode, said.reason) == (Mode.LANDING, Reason.FORECAST_SKILFUL)
    assert said.velocity_mps[2] == pytest.approx(0.5 - 0.4)
    hold = Situation(p.since_ns, estimate(0, (0.05, 0.0, -c.hold_height_m), 0.4), 0.1, forecast(0, 0.6))
    p, said = fly(p, 1.0, hold, c)
    assert p.descent_ns is None
    p, said = fly(p, 0.05, replace(hold, now_ns=p.since_ns + 10**9, forecast=forecast(0, 0.1)), c)
    assert (said.mode, said.reason) == (Mode.LANDING, Reason.DECK_QUIET)
    assert said.velocity_mps[2] == pytest.approx(c.approach_rate_mps - 0.1)
    low = Situation(p.since_ns, estimate(0, (0.05, 0.0, -0.4), 0.4), 0.1, forecast(0, 0.1))
    # With what is not known of the deck's rate, 0.05 m/s.
    assert fly(p, 0.05, low, c)[1].velocity_mps[2] == pytest.approx(c.touchdown_rate_mps + 0.05 - 0.1)
    p, said = fly(p, 0.05, replace(hold, now_ns=(p.descent_ns or 0) + 10**9, on_deck=True), c)
    assert (said.mode, said.reason) == (Mode.LANDED, Reason.CONTACT)


def landing(descending: bool = True) -> Progress:
    return Progress(Mode.LANDING, Reason.DECK_QUIET, descent_ns=0 if descending else None)


@pytest.mark.parametrize(
    ("seen", "reason"),
    [
        (Situation(10**9, estimate(10**9, (0.0, 0.0, -0.7)), 1.5), Reason.TARGET_LOST),
        (Situation(10**9, estimate(10**9, (0.0, 0.0, -0.3), roll=0.4), 0.1), Reason.TILTED),
        (Situation(60 * 10**9, estimate(60 * 10**9, (0.0, 0.0, -0.3)), 0.1), Reason.NO_CONTACT),
        (Situation(10**9, estimate(5 * 10**8, (0.0, 0.0, -0.3)), 0.1), Reason.ESTIMATE_STALE),
        (Situation(10**9, estimate(10**9, (math.nan, 0.0, -0.3)), 0.1), Reason.ESTIMATE_UNSURE),
    ],
)
def test_a_descent_is_broken_off_when_it_must_be(seen: Situation, reason: Reason) -> None:
    p, said = step(landing(), seen, LandingConfig())
    assert (said.mode, said.reason) == (Mode.ABORT, reason)
    assert said.velocity_mps[2] == -LandingConfig().climb_mps
    assert p.attempts == 1


@pytest.mark.parametrize("height_m", [0.8, 0.3])
def test_a_place_that_is_off_is_corrected_and_the_quiet_moment_waited_for_anew(height_m: float) -> None:
    seen = Situation(10**9, estimate(10**9, (0.6, 0.0, -height_m)), 0.1)
    p, said = step(landing(), seen, LandingConfig())
    assert (said.mode, said.reason) == (Mode.LANDING, Reason.OUTSIDE_R_LAND)
    assert p.descent_ns is None
    assert p.rose_ns == seen.now_ns
    assert p.attempts == 0
    assert said.velocity_mps[2] < 0.0


def test_from_the_deck_the_vehicle_rises_as_fast_as_it_would_in_an_abort() -> None:
    c = LandingConfig()
    for height, climb in ((c.gear_m, c.climb_mps), (c.hold_height_m, 0.0)):
        seen = Situation(10**9, estimate(10**9, (0.0, 0.0, -height), 0.3), 0.6, forecast(10**9, 0.3))
        assert step(landing(False), seen, c)[1].velocity_mps[2] == pytest.approx(-climb - 0.3)
    low = replace_field(c, gear_m=0.5, blind_height_m=0.5, hold_height_m=0.5)
    seen = Situation(10**9, estimate(10**9, (0.0, 0.0, -0.4)), 0.6)
    assert step(landing(False), seen, low)[1].velocity_mps[2] == pytest.approx(-c.climb_mps)


@pytest.mark.parametrize(("met_s", "stays"), [(0.31, True), (0.1, False)])
def test_what_should_stand_by_now_is_not_led_up_for_its_place(met_s: float, stays: bool) -> None:
    """Beside the circle for sure; contact is probable, and has been for longer or shorter than an answer takes."""
    near = estimate(10**9, (0.6, 0.0, -0.12))
    near.deck[5] = 0.25
    before = replace(landing(), met_ns=10**9 - round(met_s * 1e9))
    p, _ = step(before, Situation(10**9, near, 0.1), LandingConfig())
    assert (p.descent_ns is not None) == stays


@pytest.mark.parametrize(("sigma_m", "stays"), [(0.15, True), (0.02, False)])
def test_a_deck_that_may_come_up_first_is_not_broken_off_from_for_a_lesser_doubt(
    sigma_m: float, stays: bool
) -> None:
    """3.5 in 1000 to stand outside, 5 cm over the deck: a hundredth of 37 in 100 to be met first, or surely not."""
    blind = estimate(10**9, (0.2, 0.0, -0.15))
    blind.deck_covariance[0, 0] = blind.deck_covariance[1, 1] = 0.105**2
    blind.deck_covariance[2, 2] = sigma_m**2
    p, _ = step(landing(), Situation(10**9, blind, 0.6), LandingConfig())
    assert (p.descent_ns is not None) == stays


@pytest.mark.parametrize(
    ("relative", "age_s", "pauses"),
    [
        ((0.1, 0.0, -0.4), 0.1, False),
        ((0.3, 0.0, -0.4), 0.1, True),
        ((0.0, 0.3, -0.4), 0.1, True),
        ((0.3, 0.0, -0.9), 0.1, False),
        ((0.3, 0.0, -0.15), 0.1, False),
        ((0.1, 0.0, -0.15), 0.6, False),
    ],
)
def test_the_descent_pauses_where_it_would_lose_sight_of_the_target(
    relative: tuple[float, float, float], age_s: float, pauses: bool
) -> None:
    """Lower the picture is smaller; so near that contact comes first it goes on, without sight as fast as it may."""
    c = LandingConfig()
    seen = Situation(10**9, estimate(10**9, relative, 0.1), age_s, forecast(10**9, 0.1))
    p, said = step(landing(), seen, c)
    assert p.descent_ns is not None
    firm = max(c.touchdown_rate_mps + 0.05, descent_rate(-relative[2], c))
    descent = c.approach_rate_mps if age_s > FRESH_S else 0.0 if pauses else firm
    assert said.velocity_mps[2] == pytest.approx(descent - 0.1)


def test_a_pause_ends_where_the_vehicle_is_carried_over_the_target() -> None:
    c = LandingConfig()
    e = estimate(10**9, (0.3, 0.0, -0.4))
    assert not keeps_sight(e, None, c)
    e.deck[3] = -0.5
    assert keeps_sight(e, None, c)
    e.deck[0], e.deck[3] = 0.1, 0.5
    assert not keeps_sight(e, None, c)


@pytest.mark.parametrize(
    ("age_s", "growth_mps", "stays"), [(0.1, 0.6, True), (0.6, 0.6, False), (0.6, 0.2, True)]
)
def test_without_sight_the_whole_way_to_the_deck_is_judged(
    age_s: float, growth_mps: float, stays: bool
) -> None:
    """0.4 s at the approach's rate: 0.24 m of doubt at contact are too many, 0.08 m and the following's own are not."""
    c = LandingConfig()
    e = estimate(10**9, (0.15, 0.0, -0.3))
    told = forecast(10**9, 0.0, growth_mps=growth_mps)
    p, _ = step(landing(), Situation(10**9, e, age_s, told), c)
    assert (p.descent_ns is not None) == stays
    ahead = (0.3 - c.gear_m) / c.approach_rate_mps
    left = 0.15 * math.exp(-c.follow_gain * (ahead - c.response_level_s))
    covariance = told.apart_at(ahead) + c.follow_sigma_m**2 * np.eye(2)
    expected = inside_probability(np.array([left, 0.0]), covariance, c.r_land_m)
    assert probably_inside_at_contact(e, told, c) == pytest.approx(expected)


@pytest.mark.parametrize("gap_m", [0.3, 0.05, 0.0, -0.2])
def test_a_deck_that_has_not_been_met_falls_faster_than_estimated(gap_m: float) -> None:
    """The mean of what is left of a Gaussian gap and closing rate, where the gap is positive, drawn."""
    c = LandingConfig()
    e = estimate(10**9, (0.0, 0.0, -gap_m - c.gear_m), 0.0, down_mps=0.4)
    e.deck[5] = 0.4
    e.deck_covariance[2, 2], e.deck_covariance[5, 5] = 0.1**2, 0.25**2
    e.deck_covariance[2, 5] = e.deck_covariance[5, 2] = 0.8 * 0.1 * 0.25
    drawn = np.random.default_rng(3).multivariate_normal(
        e.deck[[2, 5]], e.deck_covariance[np.ix_([2, 5], [2, 5])], 10**6
    )
    closing = drawn[drawn[:, 0] < -c.gear_m, 1].mean()
    assert falls_faster(e, c) == pytest.approx(0.4 - closing, abs=0.003)
    # Out of sight it is followed.
    _, said = step(landing(), Situation(10**9, e, 0.6, forecast(10**9, 0.1)), c)
    assert said.velocity_mps[2] == pytest.approx(c.approach_rate_mps - 0.1 + falls_faster(e, c))


@pytest.mark.parametrize("age_s", [0.1, 0.6])
def test_a_deck_that_should_have_been_met_by_now_is_risen_from_to_be_seen_again(age_s: float) -> None:
    """What stood would be held up; in sight the deck is where it seems."""
    c = LandingConfig()
    given = c.response_s + OVERDUE_S
    own = c.touchdown_rate_mps if age_s < FRESH_S else c.approach_rate_mps
    met = Situation(10**9, estimate(10**9, (0.0, 0.0, -0.08), down_mps=own), age_s)
    p, _ = fly(landing(), 0.1, met, c)
    assert p.met_ns is not None
    # Once contact was probable, an estimate that takes it back proves nothing out of sight.
    away = replace(met, now_ns=p.met_ns, estimate=estimate(p.met_ns, (0.4, 0.0, -0.3), down_mps=own))
    p, said = fly(p, given - 0.1, away if age_s > FRESH_S else met, c)
    assert p.descent_ns is not None
    p, said = fly(p, 0.3, replace(met, now_ns=round((p.met_ns or 0) + (given - 0.1) * 1e9)), c)
    assert said.reason is (Reason.DECK_QUIET if age_s < FRESH_S else Reason.NO_CONTACT)
    assert (p.descent_ns is None) == (age_s > FRESH_S)


@pytest.mark.parametrize(("told_after_s", "landed"), [(0.1, True), (0.9, True), (1.1, False)])
def test_contact_told_late_is_taken_though_the_descent_was_broken_off(
    told_after_s: float, landed: bool
) -> None:
    c = LandingConfig()
    risen = replace(landing(descending=False), rose_ns=10**9, reason=Reason.OUTSIDE_R_LAND)
    now = round((1.0 + told_after_s) * 1e9)
    told = Situation(now, estimate(now, (0.4, 0.0, -0.3)), 0.8, on_deck=True)
    p, said = step(risen, told, c)
    assert (p.mode is Mode.LANDED) == landed
    assert np.allclose(said.velocity_mps, 0.0) == landed


def test_contact_told_before_any_descent_is_not_taken() -> None:
    now = 10**9
    told = Situation(now, estimate(now, (0.0, 0.0, -1.0)), 0.1, on_deck=True)
    assert step(landing(descending=False), told, LandingConfig())[0].mode is Mode.LANDING


@pytest.mark.parametrize(
    ("answer", "own", "height", "sigma", "held"),
    [
        ((0.25, 0.3), 0.0, 0.1, 0.01, True),
        ((0.25, 0.3), 0.1, 0.1, 0.01, False),
        ((0.3, 0.1), 0.0, 0.1, 0.01, False),
        ((0.25, 0.3), -0.4, 0.5, 0.01, False),
        ((0.25, 0.3), -0.4, 0.5, 0.11, True),
        (None, 0.0, 0.1, 0.01, False),
    ],
)
def test_what_does_not_go_down_as_told_near_the_deck_is_held_up(
    answer: tuple[float, float] | None, own: float, height: float, sigma: float, held: bool
) -> None:
    e = estimate(0, (0.0, 0.0, -height), down_mps=own)
    e.deck_covariance[2, 2] = sigma**2
    assert held_up(replace(landing(), answers_mps=answer), e, LandingConfig()) == held


def test_the_answer_lies_between_a_lag_and_one_of_bounded_acceleration() -> None:
    c = LandingConfig()
    p = replace(landing(), stepped_ns=10**9, answers_mps=(0.1, -0.2), asked_mps=0.5)
    now = 10**9 + 200_000_000
    seen = Situation(now, estimate(now, (0.0, 0.0, -1.0), down_mps=0.2), 0.1)
    p, said = step(p, seen, c)
    quick = 0.5 - 0.4 * math.exp(-0.2 / c.response_s)
    assert p.answers_mps == pytest.approx((quick, -0.2 + 0.2 * c.response_mps2))
    assert p.asked_mps == said.velocity_mps[2]


@pytest.mark.parametrize(("own_mps", "asked_mps"), [(0.3, 1.3), (-0.9, 0.25)])
def test_a_vehicle_that_may_stand_is_pressed_onto_the_deck_and_not_led_up_for_its_place(
    own_mps: float, asked_mps: float
) -> None:
    """The estimate has it 0.2 m over a deck that comes up, and beside the circle: out of sight that is a guess."""
    c = LandingConfig()
    e = estimate(10**9, (0.45, 0.0, -0.3), 0.5, down_mps=own_mps)
    e.deck_covariance[2, 2] = 0.1**2
    flying = replace(landing(), stepped_ns=10**9, asked_mps=own_mps, answers_mps=(own_mps, own_mps))
    seen = Situation(10**9, e, 0.8, forecast(10**9, 0.5, growth_mps=0.5))
    p, said = step(flying, seen, c)
    assert (p.descent_ns, said.reason) == (None, Reason.OUTSIDE_R_LAND)
    p, said = step(
        replace(flying, asked_mps=own_mps + 0.3, answers_mps=(own_mps + 0.5, own_mps + 0.3)), seen, c
    )
    assert p.descent_ns is not None
    assert said.velocity_mps[2] == pytest.approx(asked_mps)


def test_where_contact_is_probable_a_descent_is_asked_for_whatever_the_deck_does() -> None:
    c = LandingConfig()
    e = estimate(10**9, (0.0, 0.0, -0.08), 0.6)
    seen = Situation(10**9, e, 0.6, forecast(10**9, 0.6))
    p, said = step(landing(), seen, c)
    assert said.velocity_mps[2] == pytest.approx(c.approach_rate_mps - 0.6)
    late = 10**9 + round((c.response_s + 0.01) * 1e9)
    said = step(p, replace(seen, now_ns=late, estimate=replace(e, t_ns=late)), c)[1]
    assert said.velocity_mps[2] == pytest.approx(c.touchdown_rate_mps)


def test_after_a_rise_the_target_is_given_time_to_come_into_view() -> None:
    c = LandingConfig()
    e = estimate(2 * 10**9, (0.0, 0.0, -0.9))
    risen = replace(landing(False), rose_ns=round(1.5e9))
    assert step(risen, Situation(2 * 10**9, e, 1.8), c)[1].mode is Mode.LANDING
    late = 10**9 + risen.rose_ns + 10**8
    said = step(risen, Situation(late, replace(e, t_ns=late), 2.4), c)[1]
    assert (said.mode, said.reason) == (Mode.ABORT, Reason.TARGET_LOST)


def test_the_probability_of_being_met_is_that_of_draws() -> None:
    c = LandingConfig()
    e = estimate(0, (0.0, 0.0, -0.3))
    e.deck[5] = 0.3
    e.deck_covariance[2, 2], e.deck_covariance[5, 5] = 0.1**2, 0.2**2
    e.deck_covariance[2, 5] = e.deck_covariance[5, 2] = 0.5 * 0.1 * 0.2
    draws = np.random.default_rng(3).multivariate_normal(
        e.deck[[2, 5]], e.deck_covariance[np.ix_([2, 5], [2, 5])], 200_000
    )
    stands = draws[:, 0] + c.response_s * draws[:, 1] > -c.gear_m
    assert probably_met(e, None, c) == pytest.approx(stands.mean(), abs=0.004)
    # A deck that comes to rest does not meet it, one that comes up faster does.
    for rise, less in ((0.0, True), (0.3, False)):
        told = replace(forecast(0, 0.0), height_m=rise * HORIZON / c.response_s)
        assert (probably_met(replace(e, velocity_mps=np.zeros(3)), told, c) < stands.mean()) == less


def test_over_the_deck_what_is_off_is_closed_and_no_faster_than_it_can_come_to_rest() -> None:
    c = LandingConfig()
    still = estimate(0, (0.1, 0.0, -1.5))
    _, said = step(landing(False), Situation(10**9, replace(still, t_ns=10**9), 0.1), c)
    assert said.velocity_mps[:2] == pytest.approx([-0.1 * c.follow_gain, 0.0])
    far = estimate(10**9, (4.0, 0.0, -1.5))
    _, said = step(landing(False), Situation(10**9, far, 0.1), c)
    assert said.velocity_mps[0] == pytest.approx(-math.sqrt(2.0 * FOLLOW_MPS2 * 4.0))


@pytest.mark.parametrize(("rate", "climb"), [(0.4, 2.4), (-0.4, 2.0)])
def test_breaking_off_leads_away_from_a_deck_that_comes_up(rate: float, climb: float) -> None:
    c = LandingConfig()
    p = replace(landing(), mode=Mode.ABORT, reason=Reason.OUTSIDE_R_LAND, descent_ns=None)
    seen = Situation(10**9, estimate(10**9, (0.3, 0.0, -0.4), rate), 0.1, forecast(10**9, rate))
    assert step(p, seen, c)[1].velocity_mps[2] == pytest.approx(-climb)


def test_a_drifting_place_is_followed_without_a_lasting_error() -> None:
    c = replace_field(LandingConfig(), observe_s=90.0, observe_max_s=90.0)
    p, lag_s, t_ns = Progress(Mode.OBSERVATION), 0.4, 0
    place, velocity = np.array([0.0, 0.0]), np.zeros(2)
    for k in range(60 * 20):
        t_ns = k * 50_000_000
        deck = 0.2 * k * 0.05 * np.array([1.0, -0.5])
        off = place - deck
        p, said = step(
            p,
            Situation(t_ns, estimate(t_ns, (off[0], off[1], -7.0)), 0.1),
            c,
        )
        assert said.mode is Mode.OBSERVATION
        velocity += (said.velocity_mps[:2] - velocity) * 0.05 / lag_s
        place += velocity * 0.05
    assert np.abs(off).max() < 0.01
    assert p.drift_mps == pytest.approx([0.2, -0.1], abs=0.01)
    away, _ = step(p, Situation(t_ns, estimate(t_ns, (0.0, 0.0, -7.0)), 1.5), c)
    assert away.drift_mps == (0.0, 0.0)


def test_the_time_to_contact_is_that_of_the_descent() -> None:
    c = LandingConfig()
    for height in (0.05, 0.3, 0.6, 1.2, 3.0):
        h, t = height, 0.0
        while h > c.gear_m:
            h -= 1e-3 * descent_rate(h, c)
            t += 1e-3
        assert time_to_contact(height, c) == pytest.approx(t, abs=0.01)


def test_below_the_blind_height_the_target_need_not_be_in_view() -> None:
    seen = Situation(10**9, estimate(10**9, (0.0, 0.0, -0.3)), 1.5)
    assert step(landing(), seen, LandingConfig())[1].mode is Mode.LANDING


def test_a_lost_target_is_searched_for_again() -> None:
    c = LandingConfig()
    for mode in (Mode.TRACKING, Mode.OBSERVATION):
        seen = Situation(10**9, estimate(10**9, (0.0, 0.0, -7.0)), 1.5)
        assert step(Progress(mode), seen, c)[1].mode is Mode.SEARCH
    p = Progress(Mode.TRACKING)
    for _ in range(100):
        if p.mode is Mode.ABORT:
            break
        p = step(replace(p, mode=Mode.TRACKING), seen, c)[0]
    assert (p.reason, p.attempts) == (Reason.TARGET_LOST, 1)
    p = Progress(Mode.ABORT, Reason.TARGET_LOST, attempts=1)
    low = Situation(10**9, estimate(10**9, (0.0, 0.0, -1.0)), 1.5)
    assert step(p, low, c)[1].mode is Mode.ABORT
    clear = replace(low, estimate=estimate(10**9, (0.0, 0.0, -search_altitude_m(c))))
    assert step(p, clear, c)[1].reason is Reason.TRY_AGAIN
    tired = replace(p, attempts=c.attempts)
    assert step(tired, clear, c)[1].reason is Reason.GIVEN_UP


def test_a_calm_deck_needs_no_forecast_and_a_wild_one_is_landed_on_in_the_end() -> None:
    c = LandingConfig()
    for rate, reason in ((0.05, Reason.DECK_CALM), (0.8, Reason.OBSERVED_LONG_ENOUGH)):
        seen = Situation(0, estimate(0, (0.0, 0.0, -7.0), rate), 0.1, forecast(0, rate, skill=0.1))
        _, said = fly(Progress(Mode.OBSERVATION), c.observe_max_s + 0.1, seen, c)
        assert (said.mode, said.reason) == (Mode.LANDING, reason)


def test_every_reason_is_explained_and_every_mode_is_in_the_message() -> None:
    assert set(EXPLANATIONS) == set(Reason)
    text = definition_text("deckfix_msgs/msg/LandingMode")
    for mode in Mode:
        assert f"uint8 {mode.name}={mode.value}\n" in text


def test_decisions_become_messages_a_series_for_each_reason() -> None:
    c = LandingConfig()
    said = [
        step(landing(), Situation(10**9, estimate(10**9, (0.0, 0.0, -0.7)), age), c)[1]
        for age in (0.1, 0.1, 1.5)
    ]
    times = np.array([1, 2, 3], dtype=np.int64)
    quiet, lost = landing_series(times, times + 5, said)
    assert (quiet.strings["reason"], lost.strings["reason"]) == ("deck_quiet", "target_lost")
    assert quiet.stamp_ns.tolist() == [1, 2]
    assert lost.data["mode"].tolist() == [int(Mode.ABORT)]
    assert lost.data["velocity"][0].tolist() == [0.0, 0.0, -c.climb_mps]
    assert quiet.data["inside_probability"][0] > 0.99


@pytest.mark.parametrize(
    "text",
    [
        "r_land_m = 2.0",
        "touchdown_rate_mps = 0.6",
        "observe_s = 100.0",
        "approach_rate_mps = 0.7",
        "search_altitude_m = -3.0",
    ],
)
def test_a_table_that_contradicts_itself_or_the_seed_is_refused(text: str) -> None:
    with pytest.raises(ConfigError):
        parse_config(f"[landing]\n{text}\n")
    assert Config().landing == LandingConfig()

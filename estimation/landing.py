"""The landing modes (seed chapter 3) as a pure state machine: what is known goes in, what to do comes out.

    SEARCH       over the anchor, high enough to see the platform wherever it may be (3.1 to 3.4)
    TRACKING     over the target, down to the tracking altitude, inside r_track (3.5); heave is ignored
    OBSERVATION  there, until the deck's motion is foreseen with skill, is calm, or time is up (3.6)
    LANDING      down to a height over the deck, wait there for a quiet moment, then down to contact (3.7); back to
                 that height where the place is not good enough, or contact does not come
    ABORT        up and away from the deck; then the search begins anew, or the landing is given up

Nothing is commanded here: a ``Decision`` holds the velocity that the vehicle should fly (``estimation.guidance``), and
the reason for the mode, which is one of a closed list (``estimation.modes``). There is no clock: time is
``Situation.now_ns``, on the estimator's clock.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from estimation.guidance import (
    FRESH_S,
    decide,
    heading_rad,
    held_up,
    probably_inside,
    probably_inside_at_contact,
    probably_met,
    probably_quiet,
    search_altitude_m,
    tilt_rad,
    time_to_contact,
    unfit,
)
from estimation.landing_config import LandingConfig
from estimation.modes import Decision, Mode, Progress, Reason, Situation
from estimation.state import PL0

if TYPE_CHECKING:
    from estimation.output import Estimate

FOUND_S = 0.5
"""How long it must be in view, and how long the other conditions must hold, before the next mode."""
ALIGNED_S = 1.0
ALTITUDE_SHARE = 0.1
"""Tracking altitude counts as reached within this share of it, and half a metre."""
HOLD_TOLERANCE_M = 0.2
OVERDUE_S = 0.5
"""Contact may come so much later than it was expected at: what the height's error takes at the touchdown's rate."""
LONGEST_DESCENT = 4.0
"""A last descent that takes longer than this multiple of what it should take is broken off."""
STATION_M = 3.0
MOST_LOSSES = 6
"""A target that was lost so often, in tracking or observation, is no target."""
FASTEST_DRIFT_MPS = 0.5
"""The velocity that a lasting error may add: more than a drift unforeseen and an autopilot's own error come to."""
LEFT_PROBABILITY = 0.5
"""The observation ends when being inside r_track is no more probable than this."""

BOUNCE = 0.01
"""To touch the deck on the way up is so bad as a share of standing outside r_land."""

_OVER_THE_DECK = (Mode.TRACKING, Mode.OBSERVATION, Mode.LANDING)


def step(before: Progress, seen: Situation, c: LandingConfig) -> tuple[Progress, Decision]:
    """Return the next state of the landing and what to do. Same arguments, same result."""
    before = _answered(before, seen, c)
    after = _followed(before, _transition(before, seen, c), seen, c)
    decision = decide(after, seen, c)
    return replace(after, asked_mps=float(decision.velocity_mps[2])), decision


# -- transitions ---------------------------------------------------------------------------------------------------


def _transition(p: Progress, seen: Situation, c: LandingConfig) -> Progress:
    if p.mode is Mode.LANDED:
        return p
    trouble = unfit(seen, c)
    if p.mode is Mode.IDLE:
        if trouble is not None:
            return p
        assert seen.estimate is not None
        yaw = heading_rad(seen.estimate)
        return replace(_enter(p, Mode.SEARCH, Reason.STARTED, seen), yaw_rad=yaw)
    if seen.on_deck and _may_have_met(p, seen, c):
        return _enter(p, Mode.LANDED, Reason.CONTACT, seen)
    if trouble is not None:
        # An abort goes on as it is; its reason is the one that it began with.
        return p if p.mode is Mode.ABORT else _abort(p, trouble, seen)
    assert seen.estimate is not None
    match p.mode:
        case Mode.SEARCH:
            return _search(p, seen, seen.estimate, c)
        case Mode.TRACKING:
            return _tracking(p, seen, seen.estimate, c)
        case Mode.OBSERVATION:
            return _observation(p, seen, seen.estimate, c)
        case Mode.LANDING:
            return _landing(p, seen, seen.estimate, c)
        case _:
            return _aborting(p, seen, seen.estimate, c)


def _search(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> Progress:
    p = _holding(p, seen.detection_age_s < FRESH_S and len(e.deck) > 0, seen)
    if _held_s(p, seen) >= FOUND_S:
        return _enter(p, Mode.TRACKING, Reason.TARGET_FOUND, seen)
    if p.station_ns is None and math.hypot(e.position_m[0], e.position_m[1]) < STATION_M:
        p = replace(p, station_ns=seen.now_ns)
    if p.station_ns is not None and (seen.now_ns - p.station_ns) * 1e-9 > c.search_s:
        return _abort(p, Reason.TARGET_NOT_FOUND, seen)
    return p


def _tracking(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> Progress:
    if seen.detection_age_s > c.lost_s:
        return _lost(p, seen)
    altitude = c.track_share * search_altitude_m(c)
    off = abs(-e.position_m[2] - e.nominal[PL0] - altitude)
    aligned = (
        off < max(0.5, ALTITUDE_SHARE * altitude)
        and tilt_rad(e) < c.track_tilt_rad
        and probably_inside(e, c.r_track_m) >= c.track_probability
    )
    p = _holding(p, aligned, seen)
    return _enter(p, Mode.OBSERVATION, Reason.ALIGNED, seen) if _held_s(p, seen) >= ALIGNED_S else p


def _observation(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> Progress:
    if seen.detection_age_s > c.lost_s:
        return _lost(p, seen)
    if probably_inside(e, c.r_track_m) < LEFT_PROBABILITY:
        return _enter(p, Mode.TRACKING, Reason.OUTSIDE_R_TRACK, seen)
    power = float(e.deck[7] ** 2 + e.deck_covariance[7, 7])
    count = p.rate_count + 1
    p = replace(
        p, rate_power_m2ps2=p.rate_power_m2ps2 + (power - p.rate_power_m2ps2) / count, rate_count=count
    )
    observed = _mode_s(p, seen)
    if observed < c.observe_s:
        return p
    f = seen.forecast
    if f is not None and f.learned and float(np.interp(c.skill_horizon_s, f.horizon_s, f.skill)) >= c.skill:
        return _enter(p, Mode.LANDING, Reason.FORECAST_SKILFUL, seen)
    if math.erf(c.quiet_rate_mps / math.sqrt(2.0 * p.rate_power_m2ps2)) >= c.quiet_probability:
        return _enter(p, Mode.LANDING, Reason.DECK_CALM, seen)
    if observed >= c.observe_max_s:
        return _enter(p, Mode.LANDING, Reason.OBSERVED_LONG_ENOUGH, seen)
    return p


def _landing(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> Progress:
    height = -float(e.deck[2])
    stopped = p.descent_ns is not None and held_up(p, e, c)
    lost = seen.detection_age_s > c.lost_s and height > c.blind_height_m and not stopped
    if lost and (p.rose_ns is None or (seen.now_ns - p.rose_ns) * 1e-9 > c.lost_s):
        return _abort(p, Reason.TARGET_LOST, seen)
    if tilt_rad(e) > c.abort_tilt_rad:
        return _abort(p, Reason.TILTED, seen)
    fall_s = time_to_contact(c.hold_height_m, c)
    if p.descent_ns is not None:
        if (seen.now_ns - p.descent_ns) * 1e-9 > LONGEST_DESCENT * fall_s + c.contact_s:
            return _abort(p, Reason.NO_CONTACT, seen)
        met = probably_met(e, seen.forecast, c)
        blind = seen.detection_age_s >= FRESH_S and height <= c.blind_height_m
        # A vehicle that may stand is not led up again: the autopilot is given its time to tell. What is not held up by
        # then has not met the deck where the estimate has it.
        if stopped:
            return replace(p, met_ns=seen.now_ns)
        p = _holding(p, met > 0.5 or (blind and p.met_ns is not None), seen)
        held = _held_s(p, seen)
        if blind and held > c.response_s + OVERDUE_S:
            return _rise(p, Reason.NO_CONTACT, seen)
        # Judged is the place at contact: as far ahead as an answer takes while the target is in view, all the way
        # where it is not.
        if blind:
            inside, asked = probably_inside_at_contact(e, seen.forecast, c), c.land_probability
        else:
            ahead = min(time_to_contact(height, c), c.response_s)
            inside, asked = probably_inside(e, c.r_land_m, ahead), c.abort_probability
        # A vehicle that should stand by now is not led up again for its place.
        if held < c.response_s and 1.0 - inside > max(1.0 - asked, BOUNCE * met):
            return _rise(p, Reason.OUTSIDE_R_LAND, seen)
        return p
    low = height < c.hold_height_m + HOLD_TOLERANCE_M
    p = _holding(p, low, seen)
    waited = _held_s(p, seen)
    ahead = min(time_to_contact(height, c), c.response_s)
    if low and probably_inside(e, c.r_land_m, ahead) >= c.land_probability and tilt_rad(e) < c.track_tilt_rad:
        asked = c.quiet_probability * max(0.0, 1.0 - waited / c.wait_s)
        if waited >= c.wait_s:
            return replace(p, descent_ns=seen.now_ns, met_ns=None, reason=Reason.WAITED_LONG_ENOUGH)
        if probably_quiet(e, seen.forecast, c) >= asked:
            return replace(p, descent_ns=seen.now_ns, met_ns=None, reason=Reason.DECK_QUIET)
    if waited > 2.0 * c.wait_s or _mode_s(p, seen) > 60.0 + 2.0 * c.wait_s:
        return _abort(p, Reason.NEVER_INSIDE_R_LAND, seen)
    return p


def _may_have_met(p: Progress, seen: Situation, c: LandingConfig) -> bool:
    """Tell whether contact that the autopilot tells of can be that of a descent: of one that goes on, or was broken off
    no longer ago than a landing detector takes.
    """
    if p.mode is not Mode.LANDING:
        return False
    late = p.rose_ns is not None and (seen.now_ns - p.rose_ns) * 1e-9 <= c.contact_s
    return p.descent_ns is not None or late


def _aborting(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> Progress:
    if p.reason is Reason.GIVEN_UP:
        return p
    clear = -float(e.position_m[2]) - float(e.nominal[PL0]) > c.track_share * search_altitude_m(c)
    if not clear:
        return p
    if p.attempts >= c.attempts:
        return replace(p, reason=Reason.GIVEN_UP)
    return _enter(p, Mode.SEARCH, Reason.TRY_AGAIN, seen)


def _enter(p: Progress, mode: Mode, reason: Reason, seen: Situation) -> Progress:
    return replace(
        p, mode=mode, reason=reason, since_ns=seen.now_ns, met_ns=None, descent_ns=None, rose_ns=None,
        station_ns=None, rate_power_m2ps2=0.0, rate_count=0,
    )  # fmt: skip


def _rise(p: Progress, reason: Reason, seen: Situation) -> Progress:
    """Break a descent off for the height that a quiet moment is waited for at."""
    return replace(p, descent_ns=None, met_ns=None, rose_ns=seen.now_ns, reason=reason)


def _abort(p: Progress, reason: Reason, seen: Situation) -> Progress:
    return replace(_enter(p, Mode.ABORT, reason, seen), attempts=p.attempts + 1, losses=0)


def _lost(p: Progress, seen: Situation) -> Progress:
    """Search for a target that was lost; one that is lost again and again uses up an attempt."""
    if p.losses + 1 >= MOST_LOSSES:
        return _abort(p, Reason.TARGET_LOST, seen)
    return replace(_enter(p, Mode.SEARCH, Reason.TARGET_LOST, seen), losses=p.losses + 1)


def _holding(p: Progress, met: bool, seen: Situation) -> Progress:
    """Remember since when a condition has held without a break."""
    if not met:
        return p if p.met_ns is None else replace(p, met_ns=None)
    return p if p.met_ns is not None else replace(p, met_ns=seen.now_ns)


def _held_s(p: Progress, seen: Situation) -> float:
    return 0.0 if p.met_ns is None else (seen.now_ns - p.met_ns) * 1e-9


def _mode_s(p: Progress, seen: Situation) -> float:
    return (seen.now_ns - p.since_ns) * 1e-9


def _answered(p: Progress, seen: Situation, c: LandingConfig) -> Progress:
    """Carry on to now how fast down the vehicle goes on what it was asked for, between the quickest and the slowest
    answer: a first-order lag of ``response_s``, and one whose acceleration is bounded by ``response_mps2`` besides.
    """
    if p.stepped_ns is None or seen.estimate is None:
        return replace(p, answers_mps=None)
    if p.answers_mps is None:
        own = float(seen.estimate.velocity_mps[2])
        return replace(p, answers_mps=(own, own))
    dt = max((seen.now_ns - p.stepped_ns) * 1e-9, 0.0)
    share = -math.expm1(-dt / c.response_s) if c.response_s > 0.0 else 1.0
    quick, slow = (share * (p.asked_mps - answer) for answer in p.answers_mps)
    slow = max(-c.response_mps2 * dt, min(c.response_mps2 * dt, slow))
    return replace(p, answers_mps=(p.answers_mps[0] + quick, p.answers_mps[1] + slow))


def _followed(before: Progress, after: Progress, seen: Situation, c: LandingConfig) -> Progress:
    """Add velocity by the place's error while the target is in view: the position's gain alone would have to answer
    with a lasting error.
    """
    e = seen.estimate
    if after.mode not in _OVER_THE_DECK or e is None:
        return after if after.stepped_ns is None else replace(after, drift_mps=(0.0, 0.0), stepped_ns=None)
    north, east = after.drift_mps
    off = math.hypot(e.deck[0], e.deck[1])
    if before.stepped_ns is not None and seen.detection_age_s < FRESH_S and off < c.r_track_m:
        dt = min(max((seen.now_ns - before.stepped_ns) * 1e-9, 0.0), 0.2)
        north -= c.drift_gain * float(e.deck[0]) * dt
        east -= c.drift_gain * float(e.deck[1]) * dt
        share = min(1.0, FASTEST_DRIFT_MPS / max(math.hypot(north, east), 1e-9))
        north, east = share * north, share * east
    return replace(after, drift_mps=(north, east), stepped_ns=seen.now_ns)

"""The landing modes (seed chapter 3) as a pure state machine: what is known goes in, what to do comes out.

    SEARCH       over the anchor, high enough to see the platform wherever it may be (3.1 to 3.4)
    TRACKING     over the target, down to the tracking altitude, inside r_track (3.5); heave is ignored
    OBSERVATION  there, until the deck's motion is foreseen with skill, is calm, or time is up (3.6)
    LANDING      down to a height over the deck, wait there for a quiet moment, then down to contact (3.7); back to
                 that height where the place is not good enough while the target is still in view, an abort below that
    ABORT        up and away from the deck; then the search begins anew, or the landing is given up

Nothing is commanded here: a ``Decision`` holds the velocity that the vehicle should fly, and the reason for the mode,
which is one of a closed list. There is no clock: time is ``Situation.now_ns``, on the estimator's clock.

The constraints of the seed are kept as probabilities under the estimate's covariance: (3.5) and (3.7) ask how probable
it is that the vehicle is inside the circle. The descent is relative to the deck: the rate asked for is the deck's own,
forecast by the vehicle's lag, less a descent that never exceeds 0.5 m/s.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING

import numpy as np

from estimation.ahead import DeckForecast
from estimation.config import LandingConfig
from estimation.frames import Array, quat_to_matrix
from estimation.state import PL0

if TYPE_CHECKING:
    from estimation.output import Estimate

FRESH_S = 0.4
"""A target is in view while its last fused fix is younger than this."""
FOUND_S = 0.5
"""How long it must be in view, and how long the other conditions must hold, before the next mode."""
ALIGNED_S = 1.0
ALTITUDE_SHARE = 0.1
"""Tracking altitude counts as reached within this share of it, and half a metre."""
HOLD_TOLERANCE_M = 0.2
CONTACT_SPREAD_S = 0.3
"""A quiet moment lasts from this long before the contact expected until this long after it."""
LONGEST_DESCENT = 4.0
"""A last descent that takes longer than this multiple of what it should take is broken off."""
STATION_M = 3.0
MOST_LOSSES = 6
"""A target that was lost so often, in tracking or observation, is no target."""
FASTEST_DRIFT_MPS = 0.5
"""A platform on its anchor drifts no faster."""
LEFT_PROBABILITY = 0.5
"""The observation ends when being inside r_track is no more probable than this."""


class Mode(IntEnum):
    """What the landing is at. The integer is what the log stores."""

    IDLE = 0
    SEARCH = 1
    TRACKING = 2
    OBSERVATION = 3
    LANDING = 4
    LANDED = 5
    ABORT = 6


_OVER_THE_DECK = (Mode.TRACKING, Mode.OBSERVATION, Mode.LANDING)


class Reason(StrEnum):
    """Why the mode is what it is: what led to the last transition, or to the descent within LANDING."""

    NOT_READY = "not_ready"
    STARTED = "started"
    TARGET_FOUND = "target_found"
    TARGET_LOST = "target_lost"
    TARGET_NOT_FOUND = "target_not_found"
    ALIGNED = "aligned"
    OUTSIDE_R_TRACK = "outside_r_track"
    FORECAST_SKILFUL = "forecast_skilful"
    DECK_CALM = "deck_calm"
    OBSERVED_LONG_ENOUGH = "observed_long_enough"
    DECK_QUIET = "deck_quiet"
    WAITED_LONG_ENOUGH = "waited_long_enough"
    CONTACT = "contact"
    OUTSIDE_R_LAND = "outside_r_land"
    TILTED = "tilted"
    NO_CONTACT = "no_contact"
    NEVER_INSIDE_R_LAND = "never_inside_r_land"
    ESTIMATE_STALE = "estimate_stale"
    ESTIMATE_UNSURE = "estimate_unsure"
    TRY_AGAIN = "try_again"
    GIVEN_UP = "given_up"


EXPLANATIONS: dict[Reason, str] = {
    Reason.NOT_READY: "there is no estimate yet",
    Reason.STARTED: "the landing was started",
    Reason.TARGET_FOUND: "the target is in view",
    Reason.TARGET_LOST: "no fix of the target was fused for too long",
    Reason.TARGET_NOT_FOUND: "the search over the anchor took too long",
    Reason.ALIGNED: "over the target at the tracking altitude, probably inside r_track",
    Reason.OUTSIDE_R_TRACK: "probably no longer inside r_track",
    Reason.FORECAST_SKILFUL: "the forecast of the deck's rate has skill",
    Reason.DECK_CALM: "the deck moves so little that no forecast is needed",
    Reason.OBSERVED_LONG_ENOUGH: "the longest observation is over; the forecast has little skill",
    Reason.DECK_QUIET: "going down: the deck will probably be quiet at contact",
    Reason.WAITED_LONG_ENOUGH: "going down: no quiet moment came in the longest wait",
    Reason.CONTACT: "the vehicle stands on the deck",
    Reason.OUTSIDE_R_LAND: "not probable enough any more to touch down inside r_land",
    Reason.TILTED: "the vehicle is tilted too far",
    Reason.NO_CONTACT: "the descent took much longer than it should",
    Reason.NEVER_INSIDE_R_LAND: "being inside r_land did not get probable enough",
    Reason.ESTIMATE_STALE: "the estimate is too old to be flown on",
    Reason.ESTIMATE_UNSURE: "the estimate is too uncertain, or not finite",
    Reason.TRY_AGAIN: "clear of the deck: the search begins anew",
    Reason.GIVEN_UP: "too many attempts: waiting over the anchor for other orders",
}


@dataclass(frozen=True, slots=True)
class Situation:
    """What is known at ``now_ns`` (the estimator's clock).

    ``estimate`` the newest one; ``detection_age_s`` the time since the content of the last fused fix (infinite:
    none); ``forecast`` of the deck; ``on_deck`` what the autopilot's own landing detector says.
    """

    now_ns: int
    estimate: Estimate | None
    detection_age_s: float = math.inf
    forecast: DeckForecast | None = None
    on_deck: bool = False


@dataclass(frozen=True, slots=True)
class Progress:
    """What the state machine remembers: everything that the next step depends on beside its arguments.

    ``since_ns`` is the begin of the mode, ``met_ns`` since when the condition for going on has held, ``descent_ns``
    the begin of the last descent (None: not yet), ``station_ns`` the arrival over the anchor, ``attempts`` the aborts.
    ``rate_power_m2ps2`` is the mean square of the deck's rate over the ``rate_count`` steps of the observation.
    ``losses`` counts how often the target was lost again before a landing.
    ``drift_mps`` north and east is how fast the place drifts that is to be kept, ``stepped_ns`` when that was last
    corrected.
    """

    mode: Mode = Mode.IDLE
    reason: Reason = Reason.NOT_READY
    since_ns: int = 0
    met_ns: int | None = None
    descent_ns: int | None = None
    station_ns: int | None = None
    attempts: int = 0
    yaw_rad: float = 0.0
    rate_power_m2ps2: float = 0.0
    rate_count: int = 0
    losses: int = 0
    drift_mps: tuple[float, float] = (0.0, 0.0)
    stepped_ns: int | None = None


@dataclass(frozen=True, slots=True)
class Decision:
    """What to do now.

    ``velocity_mps`` (3,) NED is to be flown, heading ``yaw_rad``, with roll and pitch within ``max_tilt_rad``.
    ``relative_m`` (3,) is the place aimed at, relative to the platform (to the anchor where that is unknown), NED.
    ``inside_probability`` is of being inside the circle that counts in this mode, ``quiet_probability`` of a quiet deck
    at contact; NaN where there is none.
    """

    mode: Mode
    reason: Reason
    velocity_mps: Array
    yaw_rad: float
    max_tilt_rad: float
    relative_m: Array
    inside_probability: float
    quiet_probability: float


def search_altitude_m(c: LandingConfig) -> float:
    """Return the altitude that the platform is searched from: the configured one, or seed (3.4).

    ceil((r_anchor + H_error) / tan(FOV / 2) + V_error). The seed's example (15 m, 2 m, 50 deg, 5 m) gives 42 m, not
    the 34 m printed there.
    """
    if c.search_altitude_m is not None:
        return c.search_altitude_m
    reach = c.anchor_radius_m + c.gps_horizontal_error_m
    return float(math.ceil(reach / math.tan(0.5 * c.field_of_view_rad) + c.gps_vertical_error_m))


_NODES, _WEIGHTS = np.polynomial.legendre.leggauss(24)


def inside_probability(mean: Array, covariance: Array, radius: float) -> float:
    """Return the probability that a Gaussian (2,), (2, 2) lies inside the circle about the origin.

    Exact along one principal axis of the covariance, by quadrature along the other; good to 1e-6 for sigmas above a
    hundredth of the radius, and right in the limit of a point.
    """
    from scipy.special import ndtr

    if not (np.all(np.isfinite(mean)) and np.all(np.isfinite(covariance))):
        return 0.0
    # Certain where the circle's edge is seven sigmas away, which is most of the time.
    a, b, c = float(covariance[0, 0]), float(covariance[1, 1]), float(covariance[0, 1])
    largest = 0.5 * (a + b) + math.hypot(0.5 * (a - b), c)
    if radius - math.hypot(mean[0], mean[1]) > 7.0 * math.sqrt(max(largest, 0.0)):
        return 1.0
    values, axes = np.linalg.eigh(covariance)
    m = axes.T @ mean
    sigma = np.sqrt(np.maximum(values, (1e-6 * radius) ** 2))
    # Across the larger sigma the integrand is a difference of error functions, along it a Gaussian cut at 8 sigma.
    low, high = max(-radius, m[1] - 8.0 * sigma[1]), min(radius, m[1] + 8.0 * sigma[1])
    if not high > low:
        return 0.0
    # Four pieces of 24 nodes each.
    ends = np.linspace(low, high, 5)
    middle, half = 0.5 * (ends[1:] + ends[:-1]), 0.5 * (ends[1:] - ends[:-1])
    y = (middle[:, None] + half[:, None] * _NODES).ravel()
    weights = (half[:, None] * _WEIGHTS).ravel()
    reach = np.sqrt(np.maximum(radius**2 - y**2, 0.0))
    density = np.exp(-0.5 * ((y - m[1]) / sigma[1]) ** 2) / (sigma[1] * math.sqrt(2.0 * math.pi))
    inner = ndtr((reach - m[0]) / sigma[0]) - ndtr((-reach - m[0]) / sigma[0])
    return min(1.0, max(0.0, float(weights @ (density * inner))))


def step(before: Progress, seen: Situation, c: LandingConfig) -> tuple[Progress, Decision]:
    """Return the next state of the landing and what to do. Same arguments, same result."""
    after = _followed(before, _transition(before, seen, c), seen, c)
    return after, _decide(after, seen, c)


# -- transitions ---------------------------------------------------------------------------------------------------


def _transition(p: Progress, seen: Situation, c: LandingConfig) -> Progress:
    if p.mode is Mode.LANDED:
        return p
    trouble = _trouble(seen, c)
    if p.mode is Mode.IDLE:
        if trouble is not None:
            return p
        assert seen.estimate is not None
        yaw = _yaw(seen.estimate)
        return replace(_enter(p, Mode.SEARCH, Reason.STARTED, seen), yaw_rad=yaw)
    if seen.on_deck and p.mode is Mode.LANDING and p.descent_ns is not None:
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
        and _tilt(e) < c.track_tilt_rad
        and _inside(e, c.r_track_m) >= c.track_probability
    )
    p = _holding(p, aligned, seen)
    return _enter(p, Mode.OBSERVATION, Reason.ALIGNED, seen) if _held_s(p, seen) >= ALIGNED_S else p


def _observation(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> Progress:
    if seen.detection_age_s > c.lost_s:
        return _lost(p, seen)
    if _inside(e, c.r_track_m) < LEFT_PROBABILITY:
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
    if seen.detection_age_s > c.lost_s and height > c.blind_height_m:
        return _abort(p, Reason.TARGET_LOST, seen)
    if _tilt(e) > c.abort_tilt_rad:
        return _abort(p, Reason.TILTED, seen)
    inside = _inside(e, c.r_land_m)
    fall_s = time_to_contact(c.hold_height_m, c)
    if p.descent_ns is not None:
        # So near that the vehicle could not answer before it stands, it is not led up again for its place.
        committed = height - c.gear_m < c.touchdown_rate_mps * c.response_s
        if inside < c.abort_probability and not committed:
            if height <= c.blind_height_m:
                return _abort(p, Reason.OUTSIDE_R_LAND, seen)
            return replace(p, descent_ns=None, met_ns=None, reason=Reason.OUTSIDE_R_LAND)
        if (seen.now_ns - p.descent_ns) * 1e-9 > LONGEST_DESCENT * fall_s:
            return _abort(p, Reason.NO_CONTACT, seen)
        return p
    low = height < c.hold_height_m + HOLD_TOLERANCE_M
    p = _holding(p, low, seen)
    waited = _held_s(p, seen)
    if low and inside >= c.land_probability and _tilt(e) < c.track_tilt_rad:
        asked = c.quiet_probability * max(0.0, 1.0 - waited / c.wait_s)
        if waited >= c.wait_s:
            return replace(p, descent_ns=seen.now_ns, reason=Reason.WAITED_LONG_ENOUGH)
        if _quiet(e, seen.forecast, c) >= asked:
            return replace(p, descent_ns=seen.now_ns, reason=Reason.DECK_QUIET)
    if waited > 2.0 * c.wait_s or _mode_s(p, seen) > 60.0 + 2.0 * c.wait_s:
        return _abort(p, Reason.NEVER_INSIDE_R_LAND, seen)
    return p


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
        p, mode=mode, reason=reason, since_ns=seen.now_ns, met_ns=None, descent_ns=None, station_ns=None,
        rate_power_m2ps2=0.0, rate_count=0,
    )  # fmt: skip


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


def _followed(before: Progress, after: Progress, seen: Situation, c: LandingConfig) -> Progress:
    """Correct the drift by the place's error while the target is in view: what the position's gain alone would have to
    answer with a lasting error.
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


# -- what is judged ------------------------------------------------------------------------------------------------


def _trouble(seen: Situation, c: LandingConfig) -> Reason | None:
    """Return why the estimate cannot be flown on, or None."""
    e = seen.estimate
    if e is None or (seen.now_ns - e.t_ns) * 1e-9 > c.stale_s:
        return Reason.ESTIMATE_STALE
    known = (e.position_m, e.velocity_mps, e.quaternion, e.covariance, e.deck, e.deck_covariance)
    if not all(bool(np.all(np.isfinite(part))) for part in known):
        return Reason.ESTIMATE_UNSURE
    if max(e.covariance[0, 0], e.covariance[1, 1]) > c.sigma_limit_m**2:
        return Reason.ESTIMATE_UNSURE
    return None


def _inside(e: Estimate, radius: float) -> float:
    return inside_probability(e.deck[:2], e.deck_covariance[:2, :2], radius)


def _tilt(e: Estimate) -> float:
    return math.acos(max(-1.0, min(1.0, float(quat_to_matrix(e.quaternion)[2, 2]))))


def _yaw(e: Estimate) -> float:
    R = quat_to_matrix(e.quaternion)
    return math.atan2(float(R[1, 0]), float(R[0, 0]))


def _quiet(e: Estimate, forecast: DeckForecast | None, c: LandingConfig) -> float:
    """Return the probability of a quiet deck at the contact that a descent begun now would lead to."""
    if forecast is None:
        return 0.0
    contact = time_to_contact(-float(e.deck[2]), c)
    return forecast.quiet_probability(
        contact - CONTACT_SPREAD_S, contact + CONTACT_SPREAD_S, c.quiet_rate_mps
    )


# -- guidance ------------------------------------------------------------------------------------------------------


def _decide(p: Progress, seen: Situation, c: LandingConfig) -> Decision:
    e = seen.estimate
    nan = math.nan
    climb = np.array([0.0, 0.0, -c.climb_mps])
    if p.mode in (Mode.IDLE, Mode.LANDED):
        return Decision(p.mode, p.reason, np.zeros(3), p.yaw_rad, c.land_tilt_rad, np.zeros(3), nan, nan)
    if e is None or _trouble(seen, c) is not None:
        # Nothing relative to the deck can be trusted: straight up, on the autopilot's own estimate.
        return Decision(p.mode, p.reason, climb, p.yaw_rad, c.track_tilt_rad, np.full(3, nan), nan, nan)
    if p.mode in (Mode.SEARCH, Mode.ABORT):
        high = search_altitude_m(c)
        aim = np.array([0.0, 0.0, -high])
        velocity = np.empty(3)
        velocity[:2] = _towards(-e.position_m[:2], c.speed_mps, c.position_gain)
        velocity[2] = _vertical(-high - float(e.position_m[2]), c)
        if p.mode is Mode.ABORT and p.reason is not Reason.GIVEN_UP:
            velocity = climb
        return Decision(p.mode, p.reason, velocity, p.yaw_rad, c.track_tilt_rad, aim, nan, nan)
    velocity = np.empty(3)
    velocity[:2] = sway_ahead(e, seen.forecast, c.response_level_s)
    velocity[:2] += p.drift_mps
    velocity[:2] += _towards(-e.deck[:2], c.speed_mps, c.position_gain)
    if p.mode is not Mode.LANDING:
        altitude = c.track_share * search_altitude_m(c)
        aim = np.array([0.0, 0.0, -altitude])
        velocity[2] = _vertical(-altitude - float(e.nominal[PL0]) - float(e.position_m[2]), c)
        inside = _inside(e, c.r_track_m)
        return Decision(p.mode, p.reason, velocity, p.yaw_rad, c.track_tilt_rad, aim, inside, nan)
    height = -float(e.deck[2])
    if p.descent_ns is None:
        aim = np.array([0.0, 0.0, -c.hold_height_m])
        wanted = c.position_gain * (height - c.hold_height_m)
        descent = min(c.approach_rate_mps, max(-c.climb_mps, wanted))
    else:
        aim = np.array([0.0, 0.0, -c.gear_m])
        descent = descent_rate(height, c)
    velocity[2] = descent - deck_rate_ahead(e, seen.forecast, c.response_s)
    inside, quiet = _inside(e, c.r_land_m), _quiet(e, seen.forecast, c)
    return Decision(p.mode, p.reason, velocity, p.yaw_rad, c.land_tilt_rad, aim, inside, quiet)


def descent_rate(height_m: float, c: LandingConfig) -> float:
    """Return the rate [m/s] relative to the deck of the last descent: that of the approach, slowing down to that of the
    touchdown until the target need not be in view any more.
    """
    slowing = c.touchdown_rate_mps + c.position_gain * (height_m - c.blind_height_m)
    return min(c.approach_rate_mps, max(c.touchdown_rate_mps, slowing))


def time_to_contact(height_m: float, c: LandingConfig) -> float:
    """Return how long [s] the last descent takes from a height over the deck."""
    slow, fast, gain = c.touchdown_rate_mps, c.approach_rate_mps, c.position_gain
    end = max(c.blind_height_m, c.gear_m)
    begin = end + (fast - slow) / gain
    time = max(0.0, min(height_m, end) - c.gear_m) / slow
    if height_m > end:
        time += math.log1p(gain * (min(height_m, begin) - end) / slow) / gain
    return time + max(0.0, height_m - begin) / fast


def deck_rate_ahead(e: Estimate, forecast: DeckForecast | None, ahead_s: float) -> float:
    """Return the deck's rate [m/s], up, as it will be when the vehicle has followed the set-point."""
    return float(e.deck[7]) if forecast is None else forecast.rate_at(ahead_s)[0]


def sway_ahead(e: Estimate, forecast: DeckForecast | None, ahead_s: float) -> Array:
    """Return the deck's horizontal velocity (2,) [m/s] as it will be when the vehicle has followed the set-point."""
    now: Array = e.velocity_mps[:2] - e.deck[3:5]
    return now.copy() if forecast is None else forecast.sway_at(ahead_s)


def _towards(offset: Array, limit: float, gain: float) -> Array:
    """Return the velocity (2,) that closes an offset (2,), of limited length."""
    wanted = gain * offset
    length = float(np.hypot(wanted[0], wanted[1]))
    return wanted if length <= limit else np.asarray(wanted * (limit / length))


def _vertical(down_m: float, c: LandingConfig) -> float:
    """Return the vertical velocity, down, that closes a height error (positive: too high)."""
    return min(c.climb_mps, max(-c.climb_mps, c.position_gain * down_m))

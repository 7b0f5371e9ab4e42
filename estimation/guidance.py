"""What a landing mode flies, and what it judges by: velocities relative to the deck, probabilities of the circles.

The constraints of the seed are kept as probabilities under the estimate's covariance: (3.5) and (3.7) ask how probable
it is that the vehicle is inside the circle. The descent is relative to the deck: the rate asked for is the deck's own,
forecast by the vehicle's lag, less a descent that never exceeds 0.5 m/s.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from estimation.ahead import DeckForecast
from estimation.frames import Array, quat_to_matrix
from estimation.landing_config import LandingConfig
from estimation.modes import Decision, Mode, Progress, Reason, Situation
from estimation.state import PL0

if TYPE_CHECKING:
    from estimation.output import Estimate

FOLLOW_MPS2 = 2.0
"""Over the deck the vehicle comes to rest at the target with no more than this."""
LEAST_ROOM_M = 0.1
"""Over less than this the climb to the holding height is not slowed down further."""
LEGS_M = 0.1
"""A leg may touch so much before the vehicle stands: the deck and the vehicle are tilted, and legs give."""
PRESS_MPS = 1.0
"""What the deck holds up is asked to go down so much faster than it goes: more than a deck's rate changes by within the
vehicle's answer, so that it stays on a deck that begins to fall, and its falling short of it can be told."""
FRESH_S = 0.4
"""A target is in view while its last fused fix is younger than this."""
PART_SEEN = 0.2
"""Share of the height over the deck by which the target's middle may lie outside of the picture."""
CONTACT_SPREAD_S = 0.3
"""A quiet moment lasts from this long before the contact expected until this long after it."""


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


# -- what is judged ------------------------------------------------------------------------------------------------


def unfit(seen: Situation, c: LandingConfig) -> Reason | None:
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


def probably_inside(e: Estimate, radius: float, ahead_s: float = 0.0) -> float:
    """Return the probability of being within a radius [m] of the target, horizontally, now or ``ahead_s`` from now,
    when the relative velocity has carried the vehicle there.
    """
    P = e.deck_covariance
    cross = ahead_s * P[:2, 3:5]
    covariance = P[:2, :2] + cross + cross.T + ahead_s**2 * P[3:5, 3:5]
    return inside_probability(e.deck[:2] + ahead_s * e.deck[3:5], covariance, radius)


def probably_inside_at_contact(e: Estimate, forecast: DeckForecast | None, c: LandingConfig) -> float:
    """Return the probability of standing inside r_land when the descent goes on to the deck and nothing more is seen:
    at the approach's rate, as it is flown without sight.

    The relative velocity carries the vehicle on until it answers; from then on it closes what it knows to be off.
    What it does not know grows meanwhile (``DeckForecast.apart_at``), and it does not follow without error.
    """
    ahead = max(0.0, -float(e.deck[2]) - c.gear_m) / c.approach_rate_mps
    if forecast is None:
        return probably_inside(e, c.r_land_m, ahead)
    carried = min(ahead, c.response_level_s)
    left = (e.deck[:2] + carried * e.deck[3:5]) * math.exp(-c.follow_gain * (ahead - carried))
    covariance = forecast.apart_at(ahead) + c.follow_sigma_m**2 * np.eye(2)
    return inside_probability(left, covariance, c.r_land_m)


def keeps_sight(e: Estimate, forecast: DeckForecast | None, c: LandingConfig) -> bool:
    """Tell whether a vehicle that goes on down will have the target in view when it has answered, or has met the deck
    by then. Of a target beside the picture some of the rings are enough (docs/concepts.md, landing modes).
    """
    height = -float(e.deck[2])
    rate = rate_in_sight(height, forecast, c)
    if height - c.gear_m <= c.response_s * rate:
        return True
    then = e.deck[:2] + c.response_s * e.deck[3:5]
    lower = height - c.response_s * rate
    return math.hypot(then[0], then[1]) < (math.tan(0.5 * c.field_of_view_rad) + PART_SEEN) * lower


def probably_met(e: Estimate, forecast: DeckForecast | None, c: LandingConfig) -> float:
    """Return the probability that the vehicle stands on the deck before it can answer to a set-point: that it goes on
    as it does while the deck moves as it is foreseen, or, without a forecast, goes on as well, for ``response_s``.
    """
    P, t = e.deck_covariance, c.response_s
    closing = t * float(e.deck[5])
    if forecast is not None:
        closing = t * float(e.velocity_mps[2]) + forecast.rise_m(t)
    left = -float(e.deck[2]) - c.gear_m - closing
    variance = float(P[2, 2] + 2.0 * t * P[2, 5] + t**2 * P[5, 5])
    if variance <= 0.0:
        return float(left < 0.0)
    return 0.5 * math.erfc(left / math.sqrt(2.0 * variance))


def held_up(p: Progress, e: Estimate, c: LandingConfig) -> bool:
    """Tell whether something holds the vehicle up where the deck may be: its descent falls short of the slowest answer
    to what was asked for by more than ``stopped_mps`` [m/s], no further from the deck than its height is known to three
    sigma (docs/concepts.md, landing modes).
    """
    if p.answers_mps is None:
        return False
    above = -float(e.deck[2]) - c.gear_m
    near = above < LEGS_M + 3.0 * math.sqrt(max(float(e.deck_covariance[2, 2]), 0.0))
    return near and min(p.answers_mps) - float(e.velocity_mps[2]) > c.stopped_mps


def tilt_rad(e: Estimate) -> float:
    """Return the angle [rad] between the vehicle's vertical and the world's."""
    return math.acos(max(-1.0, min(1.0, float(quat_to_matrix(e.quaternion)[2, 2]))))


def heading_rad(e: Estimate) -> float:
    """Return the heading [rad] from north, clockwise."""
    R = quat_to_matrix(e.quaternion)
    return math.atan2(float(R[1, 0]), float(R[0, 0]))


def probably_quiet(e: Estimate, forecast: DeckForecast | None, c: LandingConfig) -> float:
    """Return the probability of a quiet deck at the contact that a descent begun now would lead to."""
    if forecast is None:
        return 0.0
    contact = time_to_contact(-float(e.deck[2]), c)
    return forecast.quiet_probability(
        contact - CONTACT_SPREAD_S, contact + CONTACT_SPREAD_S, c.quiet_rate_mps
    )


# -- guidance ------------------------------------------------------------------------------------------------------


def decide(p: Progress, seen: Situation, c: LandingConfig) -> Decision:
    """Return what a landing that is at ``p`` flies now."""
    e = seen.estimate
    nan = math.nan
    climb = np.array([0.0, 0.0, -c.climb_mps])
    if p.mode in (Mode.IDLE, Mode.LANDED):
        return Decision(p.mode, p.reason, np.zeros(3), p.yaw_rad, c.land_tilt_rad, np.zeros(3), nan, nan)
    if e is None or unfit(seen, c) is not None:
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
            if len(e.deck):
                # Away from the deck, also from one that comes up.
                velocity[2] -= max(0.0, deck_rate_ahead(e, seen.forecast, c.response_s))
        return Decision(p.mode, p.reason, velocity, p.yaw_rad, c.track_tilt_rad, aim, nan, nan)
    velocity = np.empty(3)
    velocity[:2] = deck_velocity_ahead(e, seen.forecast, c.response_level_s)
    velocity[:2] += p.drift_mps
    velocity[:2] += _towards(-e.deck[:2], c.speed_mps, c.follow_gain, FOLLOW_MPS2)
    if p.mode is not Mode.LANDING:
        altitude = c.track_share * search_altitude_m(c)
        aim = np.array([0.0, 0.0, -altitude])
        velocity[2] = _vertical(-altitude - float(e.nominal[PL0]) - float(e.position_m[2]), c)
        inside = probably_inside(e, c.r_track_m)
        return Decision(p.mode, p.reason, velocity, p.yaw_rad, c.track_tilt_rad, aim, inside, nan)
    height = -float(e.deck[2])
    if p.descent_ns is None:
        aim = np.array([0.0, 0.0, -c.hold_height_m])
        # From the deck up at the rate of an abort.
        room = max(c.hold_height_m - c.gear_m, LEAST_ROOM_M)
        gain = c.position_gain if height > c.hold_height_m else c.climb_mps / room
        descent = min(c.approach_rate_mps, max(-c.climb_mps, gain * (height - c.hold_height_m)))
    else:
        aim = np.array([0.0, 0.0, -c.gear_m])
        descent = _going_down(seen, e, c)
    velocity[2] = descent - deck_rate_ahead(e, seen.forecast, c.response_s)
    if p.descent_ns is not None:
        velocity[2] = max(float(velocity[2]), _pressing(p, seen, e, c))
    inside, quiet = probably_inside(e, c.r_land_m), probably_quiet(e, seen.forecast, c)
    return Decision(p.mode, p.reason, velocity, p.yaw_rad, c.land_tilt_rad, aim, inside, quiet)


def _going_down(seen: Situation, e: Estimate, c: LandingConfig) -> float:
    """Return the rate [m/s] relative to the deck of the last descent now.

    Where going on would lose sight of the target the deck's height is kept. Without sight the doubt grows with time,
    and the rest is gone as fast as may be, after a deck that falls as it must when it has not been met
    (``falls_faster``). In sight it is ``rate_in_sight``: slower, a deck that falls faster than foreseen would keep the
    vehicle hanging over it.
    """
    if seen.detection_age_s >= FRESH_S:
        return c.approach_rate_mps + falls_faster(e, c)
    if not keeps_sight(e, seen.forecast, c):
        return 0.0
    return rate_in_sight(-float(e.deck[2]), seen.forecast, c)


def rate_in_sight(height_m: float, forecast: DeckForecast | None, c: LandingConfig) -> float:
    """Return the rate [m/s] relative to the deck of the last descent in sight of the target: ``descent_rate``, but no
    slower than the touchdown's with the 1-sigma of the deck's rate.
    """
    unknown = 0.0 if forecast is None else forecast.rate_at(c.response_s)[1]
    return min(c.approach_rate_mps, max(c.touchdown_rate_mps + unknown, descent_rate(height_m, c)))


def falls_faster(e: Estimate, c: LandingConfig) -> float:
    """Return how much faster [m/s] the deck is to be expected to fall than it is estimated to, for the vehicle is above
    it still: of a Gaussian gap only the positive part is left, and its mean takes that of the closing rate with it
    (derived in docs/concepts.md, landing modes). No more than the approach's rate.
    """
    from scipy.special import erfcx

    variance = float(e.deck_covariance[2, 2])
    if variance <= 0.0:
        return 0.0
    sigma = math.sqrt(variance)
    gap = (-float(e.deck[2]) - c.gear_m) / sigma
    # phi(z) / Phi(z), without the quotient of two small numbers.
    hazard = math.sqrt(2.0 / math.pi) / float(erfcx(-gap / math.sqrt(2.0)))
    return min(c.approach_rate_mps, max(0.0, float(e.deck_covariance[2, 5]) / sigma * hazard))


def _pressing(p: Progress, seen: Situation, e: Estimate, c: LandingConfig) -> float:
    """Return the least velocity, down, that is asked for: a vehicle that may stand wants to go down, which its landing
    detector asks for, and one that the deck holds up is pressed onto it, or a deck that falls would leave it.
    """
    if held_up(p, e, c):
        return max(c.touchdown_rate_mps, float(e.velocity_mps[2]) + PRESS_MPS)
    expected = p.met_ns is not None and (seen.now_ns - p.met_ns) * 1e-9 >= c.response_s
    return c.touchdown_rate_mps if expected else -math.inf


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


def deck_velocity_ahead(e: Estimate, forecast: DeckForecast | None, ahead_s: float) -> Array:
    """Return the deck's horizontal velocity (2,) [m/s] as it will be when the vehicle has followed the set-point."""
    now: Array = e.velocity_mps[:2] - e.deck[3:5]
    return now.copy() if forecast is None else forecast.velocity_at(ahead_s)


def _towards(offset: Array, limit: float, gain: float, slowing_mps2: float = math.inf) -> Array:
    """Return the velocity (2,) that closes an offset (2,), of limited length, and from which a vehicle that slows down
    by ``slowing_mps2`` comes to rest there.
    """
    wanted = gain * offset
    length = float(np.hypot(wanted[0], wanted[1]))
    limit = min(limit, math.sqrt(2.0 * slowing_mps2 * length / gain))
    return wanted if length <= limit else np.asarray(wanted * (limit / length))


def _vertical(down_m: float, c: LandingConfig) -> float:
    """Return the vertical velocity, down, that closes a height error (positive: too high)."""
    return min(c.climb_mps, max(-c.climb_mps, c.position_gain * down_m))

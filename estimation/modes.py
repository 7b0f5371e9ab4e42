"""The landing modes' words: the modes themselves, the reasons, what is seen, remembered and decided."""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import IntEnum, StrEnum
from typing import TYPE_CHECKING

from estimation.ahead import DeckForecast
from estimation.frames import Array

if TYPE_CHECKING:
    from estimation.output import Estimate


class Mode(IntEnum):
    """What the landing is at. The integer is what the log stores."""

    IDLE = 0
    SEARCH = 1
    TRACKING = 2
    OBSERVATION = 3
    LANDING = 4
    LANDED = 5
    ABORT = 6


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
    Reason.NO_CONTACT: "contact did not come when it should have",
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
    the begin of the last descent (None: not yet), ``rose_ns`` when one was last broken off for the holding height,
    ``station_ns`` the arrival over the anchor, ``attempts`` the aborts.
    ``rate_power_m2ps2`` is the mean square of the deck's rate over the ``rate_count`` steps of the observation.
    ``losses`` counts how often the target was lost again before a landing.
    ``drift_mps`` north and east is added against an error that lasts, ``stepped_ns`` when that was last
    corrected. ``asked_mps`` is the vertical velocity asked for last, ``answers_mps`` the quickest and the
    slowest that a vehicle goes on it by now (None: unknown), down.
    """

    mode: Mode = Mode.IDLE
    reason: Reason = Reason.NOT_READY
    since_ns: int = 0
    met_ns: int | None = None
    descent_ns: int | None = None
    rose_ns: int | None = None
    station_ns: int | None = None
    attempts: int = 0
    yaw_rad: float = 0.0
    rate_power_m2ps2: float = 0.0
    rate_count: int = 0
    losses: int = 0
    drift_mps: tuple[float, float] = (0.0, 0.0)
    stepped_ns: int | None = None
    asked_mps: float = 0.0
    answers_mps: tuple[float, float] | None = None


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

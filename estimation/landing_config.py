"""Configuration of the landing modes (``estimation.landing``)."""

from __future__ import annotations

from typing import Annotated

from msgspec import Meta

from estimation.config_fields import Table, not_negative, number, positive, share


class LandingConfig(Table, frozen=True):
    """The landing modes: search, tracking, observation, landing, abort (``estimation.landing``)."""

    search_altitude_m: Annotated[
        float | None,
        number(
            "height above the mean level that is searched from; None: seed (3.4) from the values below", "m"
        ),
    ] = None
    anchor_radius_m: Annotated[
        float, positive("r_anchor: the platform is found within this distance of the anchor", "m")
    ] = 2.0
    gps_horizontal_error_m: Annotated[
        float, not_negative("H_error: largest horizontal GPS error that the search allows for", "m")
    ] = 2.0
    gps_vertical_error_m: Annotated[
        float, not_negative("V_error: largest vertical GPS error that the search allows for", "m")
    ] = 5.0
    field_of_view_rad: Annotated[
        float,
        Meta(
            gt=0.05,
            lt=3.0,
            description="the smaller of the camera's angles of view; the default is 48.8 deg",
            extra={"unit": "rad"},
        ),
    ] = 0.852
    track_share: Annotated[
        float,
        Meta(
            gt=0.0,
            lt=1.0,
            description="alpha_track: tracking altitude over search altitude (seed 3.2.2)",
            extra={"unit": "-"},
        ),
    ] = 0.5
    r_track_m: Annotated[
        float, positive("r_track: circle about the target in tracking and observation (seed 3.5)", "m")
    ] = 1.0
    r_land_m: Annotated[
        float, positive("r_land: circle about the target to touch down in, at most r_track (seed 3.7)", "m")
    ] = 0.5
    track_probability: Annotated[
        float, share("being inside r_track must be this probable before the deck is observed")
    ] = 0.95
    land_probability: Annotated[
        float,
        share(
            "being inside r_land must be this probable before the vehicle goes down, and at contact while it goes down "
            "low without sight of the target"
        ),
    ] = 0.998
    abort_probability: Annotated[
        float,
        share("in sight of it, the descent is broken off below this probability of being inside r_land"),
    ] = 0.95
    track_tilt_rad: Annotated[
        float,
        positive(
            "bound of roll and pitch while the target is in view: they spoil a fix (seed 5.6.3); 15 deg",
            "rad",
        ),
    ] = 0.26
    land_tilt_rad: Annotated[
        float,
        positive(
            "bound of roll and pitch on the way down; level would let the wind carry the vehicle away; 11 deg",
            "rad",
        ),
    ] = 0.2
    abort_tilt_rad: Annotated[float, positive("a tilt beyond this breaks the descent off; 20 deg", "rad")] = (
        0.35
    )
    observe_s: Annotated[float, positive("shortest observation of the deck, t_0 to t_N", "s")] = 12.0
    observe_max_s: Annotated[
        float,
        positive(
            "longest observation: then the landing goes on without a forecast that has skill; not below observe_s",
            "s",
        ),
    ] = 45.0
    skill: Annotated[
        float, share("skill that the forecast of the deck's rate must have at skill_horizon_s")
    ] = 0.4
    skill_horizon_s: Annotated[float, positive("horizon at which the skill is judged", "s")] = 0.5
    hold_height_m: Annotated[
        float,
        positive(
            "height above the deck at which a quiet moment is waited for: the target stays in view inside r_land",
            "m",
        ),
    ] = 1.2
    gear_m: Annotated[
        float,
        not_negative("height of the inertial sensor above the deck when the vehicle stands on it", "m"),
    ] = 0.1
    blind_height_m: Annotated[
        float, not_negative("height above the deck below which the target need not be in view any more", "m")
    ] = 0.5
    approach_rate_mps: Annotated[
        float,
        Meta(
            gt=0.0,
            le=0.5,
            description="largest descent rate relative to the deck (seed 3.2.4 bounds it by 0.5)",
            extra={"unit": "m/s"},
        ),
    ] = 0.5
    touchdown_rate_mps: Annotated[
        float,
        positive(
            "descent rate relative to the deck down to contact, and the 1-sigma of the deck's rate more; not above "
            "approach_rate_mps",
            "m/s",
        ),
    ] = 0.25
    quiet_rate_mps: Annotated[float, positive("the deck is quiet while its rate is below this", "m/s")] = 0.3
    quiet_probability: Annotated[
        float, share("probability of a quiet deck at contact that the descent waits for")
    ] = 0.8
    wait_s: Annotated[
        float,
        positive(
            "longest wait for it: the probability asked for falls to zero over this time, since batteries do not wait",
            "s",
        ),
    ] = 20.0
    response_s: Annotated[
        float,
        not_negative(
            "lag of the vehicle's vertical velocity behind its set-point: how far ahead the deck's rate is commanded",
            "s",
        ),
    ] = 0.3
    response_level_s: Annotated[
        float, not_negative("the same of the horizontal velocity, for the deck's sway", "s")
    ] = 0.35
    contact_s: Annotated[
        float,
        not_negative(
            "longest time that the autopilot's landing detector takes to tell that the vehicle stands", "s"
        ),
    ] = 1.0
    stopped_mps: Annotated[
        float,
        positive(
            "a descent that falls so much short of the one asked for is held up by the deck; more than the vehicle's "
            "own errors in following",
            "m/s",
        ),
    ] = 0.2
    response_mps2: Annotated[
        float,
        positive(
            "vertical acceleration that the vehicle answers with at least where its velocity is off; ArduPilot's "
            "WPNAV_ACCEL_Z",
            "m/s^2",
        ),
    ] = 1.0
    lost_s: Annotated[float, positive("the target is lost after this time without a fused fix", "s")] = 1.0
    stale_s: Annotated[float, positive("an estimate older than this is not flown on", "s")] = 0.3
    sigma_limit_m: Annotated[
        float, positive("a position whose horizontal 1-sigma exceeds this is not flown on", "m")
    ] = 5.0
    speed_mps: Annotated[float, positive("largest horizontal speed relative to the target", "m/s")] = 4.0
    climb_mps: Annotated[float, positive("largest climb rate, and that of an abort", "m/s")] = 2.0
    position_gain: Annotated[float, positive("velocity asked for over the position's error", "1/s")] = 0.8
    follow_gain: Annotated[
        float,
        positive(
            "the same over the deck, horizontally; above 1 / (2 response_level_s) it overshoots a little",
            "1/s",
        ),
    ] = 1.2
    follow_sigma_m: Annotated[
        float,
        not_negative(
            "1-sigma of the place that the vehicle's own error in following adds until contact, north and east each",
            "m",
        ),
    ] = 0.06
    drift_gain: Annotated[
        float,
        not_negative(
            "change of the velocity that is added over the position's error: a quarter of the following gain's square "
            "does not overshoot",
            "1/s^2",
        ),
    ] = 0.16
    search_s: Annotated[float, positive("longest search over the anchor before it is given up", "s")] = 60.0
    attempts: Annotated[
        int,
        Meta(ge=1, description="descents that are tried before the landing is given up", extra={"unit": "-"}),
    ] = 4

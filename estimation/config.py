"""Configuration: every parameter with its unit, its meaning and the reason for its default.

Files are TOML and strict: an unknown key is refused with the nearest valid name, a value outside its bounds with
the bound. Process noise is always a rate (per root second or per root hertz), so that it does not depend on the
rate of the sensor; the descriptions say which 1-sigma it means after 1 s and 10 s.
"""

from __future__ import annotations

import difflib
import math
import tomllib
from pathlib import Path
from typing import Annotated, Any, Literal, get_args, get_origin, get_type_hints

import msgspec
from msgspec import Meta


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key, what is wrong and what to do."""


def _positive(description: str, unit: str) -> Meta:
    return Meta(gt=0.0, description=description, extra={"unit": unit})


def _number(description: str, unit: str) -> Meta:
    return Meta(description=description, extra={"unit": unit})


def _not_negative(description: str, unit: str) -> Meta:
    return Meta(ge=0.0, description=description, extra={"unit": unit})


def _share(description: str) -> Meta:
    return Meta(gt=0.0, lt=1.0, description=description, extra={"unit": "-"})


def _choice(description: str) -> Meta:
    return Meta(description=description, extra={"unit": "-"})


Vector3 = tuple[float, float, float]


class _Table(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A table of the file."""


class Origin(_Table, frozen=True):
    """Origin of the filter's NED frame; without one it is the first good GPS fix."""

    latitude_deg: Annotated[
        float | None, _number("WGS-84 latitude of the anchor; None: first good GPS fix", "deg")
    ] = None
    longitude_deg: Annotated[float | None, _number("WGS-84 longitude of the anchor", "deg")] = None
    altitude_m: Annotated[
        float | None, _number("altitude of the mean deck or sea level, in the datum of the GPS", "m")
    ] = None


class ImuConfig(_Table, frozen=True):
    """Inertial sensor. Also what the simulator draws its IMU from."""

    accel_noise: Annotated[
        float,
        _positive(
            "white noise of specific force; 0.01 means 0.01 m/s after 1 s, 0.03 m/s after 10 s", "m/s^2/rtHz"
        ),
    ] = 0.01
    gyro_noise: Annotated[
        float,
        _positive(
            "white noise of angular velocity; 5e-4 means 0.03 deg after 1 s, 0.09 deg after 10 s",
            "rad/s/rtHz",
        ),
    ] = 5e-4
    accel_bias_walk: Annotated[
        float,
        _not_negative("random walk of the accelerometer bias; 5e-4: 1.6 mm/s^2 after 10 s", "m/s^2/rts"),
    ] = 5e-4
    gyro_bias_walk: Annotated[
        float, _not_negative("random walk of the gyro bias; 9e-5: 0.016 deg/s after 10 s", "rad/s/rts")
    ] = 9e-5
    accel_bias_sigma: Annotated[
        float,
        _positive(
            "1-sigma of the accelerometer bias at start; it cannot be told from tilt in hover", "m/s^2"
        ),
    ] = 0.03
    gyro_bias_sigma: Annotated[
        float, _positive("1-sigma of the gyro bias at start when it was not averaged at rest", "rad/s")
    ] = 5e-3
    vibration_gain: Annotated[
        float,
        _not_negative(
            "share of the measured sample-to-sample scatter that is added to the white noise (0: off). A vibrating "
            "airframe aliases into the specific force; 1 would take all of it as white",
            "-",
        ),
    ] = 0.02
    latency_s: Annotated[
        float | None,
        _number("age of a sample at its stamp (filter delay); None: as the log says, else 0", "s"),
    ] = None
    gap_s: Annotated[
        float, _positive("longest gap that is bridged; a longer one starts a new alignment", "s")
    ] = 3.0


class GpsConfig(_Table, frozen=True):
    """GPS position and velocity."""

    latency_s: Annotated[float, _not_negative("age of a fix at its stamp", "s")] = 0.105
    lever_arm_m: Annotated[Vector3, _number("antenna relative to the IMU, body FRD", "m")] = (0.0, 0.0, 0.0)
    position_sigma_m: Annotated[
        float, _positive("white horizontal noise where the receiver states none, and its floor", "m")
    ] = 0.1
    height_sigma_m: Annotated[
        float, _positive("white vertical noise where the receiver states none, and its floor", "m")
    ] = 1.0
    velocity_sigma_mps: Annotated[
        float, _positive("white horizontal velocity noise where none is stated, and its floor", "m/s")
    ] = 0.2
    climb_sigma_mps: Annotated[
        float, _positive("white vertical velocity noise where none is stated, and its floor", "m/s")
    ] = 0.3
    white_fraction: Annotated[
        float,
        Meta(
            ge=0.0,
            le=1.0,
            description="share of the receiver's stated position accuracy that is white; the rest is slow and is "
            "what the bias states carry",
            extra={"unit": "-"},
        ),
    ] = 0.1
    bias: Annotated[bool, _choice("carry a slowly wandering position error as a state")] = True
    bias_sigma_m: Annotated[float, _positive("stationary 1-sigma of the horizontal position error", "m")] = (
        0.7
    )
    height_bias_sigma_m: Annotated[
        float, _positive("1-sigma of the vertical position error at start", "m")
    ] = 4.0
    bias_time_s: Annotated[float, _positive("correlation time of the horizontal error", "s")] = 120.0
    height_bias_walk: Annotated[
        float,
        _not_negative("random walk of the vertical error; 0.1: 0.1 m after 1 s, 0.3 m after 10 s", "m/rts"),
    ] = 0.1
    max_accuracy_m: Annotated[
        float, _positive("a fix that states a worse horizontal accuracy is not used", "m")
    ] = 50.0
    rtk_accuracy_m: Annotated[
        float,
        _not_negative(
            "an RTK fix that states a better accuracy than this is taken at its word (not below 0.3, in height 0.5 of "
            "this) and carries no wander; 0: never",
            "m",
        ),
    ] = 0.1
    reset_after_s: Annotated[
        float,
        _positive(
            "fixes that agree with each other, but not with the filter, for this long move its position (never its "
            "attitude); a note says so",
            "s",
        ),
    ] = 5.0


class BarometerConfig(_Table, frozen=True):
    """Barometric height; its offset is a state."""

    use: Annotated[bool, _choice("fuse the barometer")] = True
    latency_s: Annotated[float, _not_negative("age of a reading at its stamp", "s")] = 0.0
    sigma_m: Annotated[float, _positive("white noise of the height", "m")] = 0.15
    bias_walk: Annotated[
        float, _not_negative("random walk of the offset (weather); 0.01: 0.03 m after 10 s", "m/rts")
    ] = 0.01
    bias_sigma_m: Annotated[float, _positive("1-sigma of the offset at start, once aligned", "m")] = 3.0


class MagnetometerConfig(_Table, frozen=True):
    """Heading from the magnetic field."""

    use: Annotated[bool, _choice("fuse the magnetometer's heading")] = True
    latency_s: Annotated[float, _not_negative("age of a reading at its stamp", "s")] = 0.0
    heading_sigma_rad: Annotated[float, _positive("1-sigma of the heading", "rad")] = 0.052
    declination_deg: Annotated[
        float | None,
        _number("east positive; None: as the log says, else the World Magnetic Model", "deg"),
    ] = None


class AttitudeConfig(_Table, frozen=True):
    """Attitude from the autopilot's own estimator."""

    use: Annotated[
        Literal["off", "initialise", "fuse"],
        _choice("'initialise' only starts from it when the flight begins in the air"),
    ] = "initialise"
    latency_s: Annotated[float, _not_negative("age of an attitude at its stamp", "s")] = 0.0
    tilt_sigma_rad: Annotated[float, _positive("1-sigma of roll and pitch", "rad")] = 0.02
    yaw_sigma_rad: Annotated[float, _positive("1-sigma of yaw", "rad")] = 0.1


class RangefinderConfig(_Table, frozen=True):
    """Downward rangefinder over a surface of known height."""

    use: Annotated[bool, _choice("fuse the rangefinder; needs a level surface below")] = False
    latency_s: Annotated[float, _not_negative("age of a range at its stamp", "s")] = 0.0
    sigma_m: Annotated[float, _positive("1-sigma at zero range", "m")] = 0.05
    sigma_per_m: Annotated[float, _not_negative("growth of the 1-sigma with range", "-")] = 0.01
    lever_arm_m: Annotated[Vector3, _number("sensor relative to the IMU, body FRD", "m")] = (0.0, 0.0, 0.0)
    surface_height_m: Annotated[float, _number("height of the surface above the origin", "m")] = 0.0


class VisionConfig(_Table, frozen=True):
    """Vision fixes of the target (P^c); used where the platform is."""

    latency_s: Annotated[
        float,
        Meta(ge=0.0, le=0.15, description="age of a fix at its stamp, as calibrated", extra={"unit": "s"}),
    ] = 0.0
    latency_sigma_s: Annotated[
        float, _positive("1-sigma of that age; the state that learns it stays within 0 to 0.15 s", "s")
    ] = 0.02
    arrival_latency_s: Annotated[
        float,
        Meta(
            ge=0.0,
            le=0.15,
            description="the same where the log says that fixes are stamped with their arrival: age at arrival",
            extra={"unit": "s"},
        ),
    ] = 0.06
    arrival_latency_sigma_s: Annotated[float, _positive("1-sigma of that", "s")] = 0.05
    latency_walk: Annotated[
        float, _not_negative("random walk of the age; 3e-5: 0.1 ms after 10 s", "s/rts")
    ] = 3e-5
    latency_rate_radps: Annotated[
        float,
        _positive(
            "rotation (rms over 5 s) below which the age is not learned, only its doubt carried", "rad/s"
        ),
    ] = 0.035
    angle_sigma_rad: Annotated[
        float, _positive("1-sigma across the line of sight, where a fix states no covariance", "rad")
    ] = 0.0035
    range_sigma: Annotated[
        float, _positive("1-sigma along the line of sight as a share of the range, where none is stated", "-")
    ] = 0.01
    floor_m: Annotated[float, _positive("1-sigma added to every fix, stated or not", "m")] = 0.01
    scale_sigma: Annotated[
        float, _positive("1-sigma of the range scale (focal length, size of the target)", "-")
    ] = 0.005
    mount_sigma_rad: Annotated[
        float, _positive("1-sigma of the camera's mounting; considered, never learned", "rad")
    ] = 0.005
    mount_rpy_rad: Annotated[
        Vector3, _number("roll, pitch, yaw of the camera against looking straight down, top forward", "rad")
    ] = (0.0, 0.0, 0.0)
    lever_arm_m: Annotated[Vector3, _number("camera relative to the IMU, body FRD", "m")] = (0.0, 0.0, 0.0)


class PlatformConfig(_Table, frozen=True):
    """The floating platform: an anchored place, sway about it, a level, and heave."""

    use: Annotated[
        bool | Literal["auto"],
        _choice(
            "carry the platform's states; 'auto': where the log holds vision fixes, or a camera is flown"
        ),
    ] = "auto"
    offset_walk: Annotated[
        float, _not_negative("random walk of the mean place; 0.01: 0.03 m after 10 s", "m/rts")
    ] = 0.01
    drift_sigma_mps: Annotated[
        float,
        _not_negative(
            "1-sigma of the velocity, per axis, at which the mean place drifts on its mooring, before it is learned",
            "m/s",
        ),
    ] = 0.075
    anchor_radius_m: Annotated[
        float | None,
        _number(
            "r_plat: 1-sigma of the place about the configured origin; None: known from vision only", "m"
        ),
    ] = None
    sway_sigma_m: Annotated[
        float, _positive("stationary 1-sigma of the sway before it is learned, per axis", "m")
    ] = 0.15
    sway_period_s: Annotated[float, _positive("middle period of the sway before it is learned", "s")] = 4.0
    sway_damping: Annotated[float, _positive("damping ratio of the sway's sections", "-")] = 0.5
    level_walk: Annotated[
        float,
        _not_negative(
            "random walk of the mean height (tide, load); 0.002: 2 mm after 1 s, 6 mm after 10 s", "m/rts"
        ),
    ] = 0.002
    heave_sigma_m: Annotated[
        float, _positive("stationary 1-sigma of the heave before it is learned", "m")
    ] = 0.3
    heave_period_s: Annotated[
        float,
        _positive(
            "middle period of the heave before it is learned; seas from half to twice it are expected", "s"
        ),
    ] = 6.0
    heave_damping: Annotated[float, _positive("damping of the heave before it is learned", "-")] = 0.5
    learn_s: Annotated[
        float, _not_negative("interval at which the heave's spectrum is learned anew; 0: never", "s")
    ] = 2.0
    learn_window_s: Annotated[float, _positive("how much of the past it is learned from", "s")] = 60.0


class LandingConfig(_Table, frozen=True):
    """The landing modes: search, tracking, observation, landing, abort (``estimation.landing``)."""

    search_altitude_m: Annotated[
        float | None,
        _number(
            "height above the mean level that is searched from; None: seed (3.4) from the values below", "m"
        ),
    ] = None
    anchor_radius_m: Annotated[
        float, _positive("r_anchor: the platform is found within this distance of the anchor", "m")
    ] = 2.0
    gps_horizontal_error_m: Annotated[
        float, _not_negative("H_error: largest horizontal GPS error that the search allows for", "m")
    ] = 2.0
    gps_vertical_error_m: Annotated[
        float, _not_negative("V_error: largest vertical GPS error that the search allows for", "m")
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
        float, _positive("r_track: circle about the target in tracking and observation (seed 3.5)", "m")
    ] = 1.0
    r_land_m: Annotated[
        float, _positive("r_land: circle about the target to touch down in, at most r_track (seed 3.7)", "m")
    ] = 0.5
    track_probability: Annotated[
        float, _share("being inside r_track must be this probable before the deck is observed")
    ] = 0.95
    land_probability: Annotated[
        float, _share("being inside r_land must be this probable before the vehicle goes down")
    ] = 0.99
    abort_probability: Annotated[
        float,
        _share("below this probability of being inside r_land the descent is broken off"),
    ] = 0.95
    track_tilt_rad: Annotated[
        float,
        _positive(
            "bound of roll and pitch while the target is in view: they spoil a fix (seed 5.6.3); 15 deg",
            "rad",
        ),
    ] = 0.26
    land_tilt_rad: Annotated[
        float,
        _positive(
            "bound of roll and pitch on the way down; level would let the wind carry the vehicle away; 11 deg",
            "rad",
        ),
    ] = 0.2
    abort_tilt_rad: Annotated[
        float, _positive("a tilt beyond this breaks the descent off; 20 deg", "rad")
    ] = 0.35
    observe_s: Annotated[float, _positive("shortest observation of the deck, t_0 to t_N", "s")] = 12.0
    observe_max_s: Annotated[
        float,
        _positive(
            "longest observation: then the landing goes on without a forecast that has skill; not below observe_s",
            "s",
        ),
    ] = 45.0
    skill: Annotated[
        float, _share("skill that the forecast of the deck's rate must have at skill_horizon_s")
    ] = 0.4
    skill_horizon_s: Annotated[float, _positive("horizon at which the skill is judged", "s")] = 0.5
    hold_height_m: Annotated[
        float,
        _positive(
            "height above the deck at which a quiet moment is waited for: the target stays in view inside r_land",
            "m",
        ),
    ] = 1.2
    gear_m: Annotated[
        float,
        _not_negative("height of the inertial sensor above the deck when the vehicle stands on it", "m"),
    ] = 0.1
    blind_height_m: Annotated[
        float, _not_negative("height above the deck below which the target need not be in view any more", "m")
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
        _positive("descent rate relative to the deck down to contact; not above approach_rate_mps", "m/s"),
    ] = 0.25
    quiet_rate_mps: Annotated[float, _positive("the deck is quiet while its rate is below this", "m/s")] = 0.3
    quiet_probability: Annotated[
        float, _share("probability of a quiet deck at contact that the descent waits for")
    ] = 0.8
    wait_s: Annotated[
        float,
        _positive(
            "longest wait for it: the probability asked for falls to zero over this time, since batteries do not wait",
            "s",
        ),
    ] = 20.0
    response_s: Annotated[
        float,
        _not_negative(
            "lag of the vehicle's vertical velocity behind its set-point: how far ahead the deck's rate is commanded",
            "s",
        ),
    ] = 0.3
    response_level_s: Annotated[
        float, _not_negative("the same of the horizontal velocity, for the deck's sway", "s")
    ] = 0.5
    lost_s: Annotated[float, _positive("the target is lost after this time without a fused fix", "s")] = 1.0
    stale_s: Annotated[float, _positive("an estimate older than this is not flown on", "s")] = 0.3
    sigma_limit_m: Annotated[
        float, _positive("a position whose horizontal 1-sigma exceeds this is not flown on", "m")
    ] = 5.0
    speed_mps: Annotated[float, _positive("largest horizontal speed relative to the target", "m/s")] = 4.0
    climb_mps: Annotated[float, _positive("largest climb rate, and that of an abort", "m/s")] = 2.0
    position_gain: Annotated[float, _positive("velocity asked for over the position's error", "1/s")] = 0.8
    follow_gain: Annotated[
        float,
        _positive(
            "the same over the deck, horizontally; above 1 / (2 response_level_s) it overshoots a little",
            "1/s",
        ),
    ] = 1.2
    drift_gain: Annotated[
        float,
        _not_negative(
            "change of the velocity that is added over the position's error: a quarter of the following gain's square "
            "does not overshoot",
            "1/s^2",
        ),
    ] = 0.16
    search_s: Annotated[float, _positive("longest search over the anchor before it is given up", "s")] = 60.0
    attempts: Annotated[
        int,
        Meta(ge=1, description="descents that are tried before the landing is given up", extra={"unit": "-"}),
    ] = 4


class FilterConfig(_Table, frozen=True):
    """The filter itself."""

    window_s: Annotated[
        float,
        Meta(
            ge=0.1,
            le=5.0,
            description="how late an event may be and still be fused at its own time",
            extra={"unit": "s"},
        ),
    ] = 0.5
    huber_sigma: Annotated[
        float,
        _positive(
            "innovations beyond this many sigma (of equal probability in one dimension) weigh less", "-"
        ),
    ] = 3.0
    gate_sigma: Annotated[
        float,
        Meta(
            gt=0.0,
            le=8.0,
            description="innovations beyond this many sigma (of equal probability in one dimension) are rejected",
            extra={"unit": "-"},
        ),
    ] = 6.0
    output_rate_hz: Annotated[
        float, _not_negative("rate of the estimates that come out; 0: one for each inertial sample", "Hz")
    ] = 50.0
    gravity_mps2: Annotated[
        float | None, _number("magnitude of gravity; None: WGS-84 at the origin", "m/s^2")
    ] = None


class InitialisationConfig(_Table, frozen=True):
    """How the filter starts."""

    rest_s: Annotated[float, _positive("time over which rest is judged and the start averaged", "s")] = 1.0
    tilt_sigma_rad: Annotated[float, _positive("1-sigma of roll and pitch levelled at rest", "rad")] = 0.01
    flight_tilt_sigma_rad: Annotated[
        float, _positive("1-sigma of roll and pitch levelled in flight", "rad")
    ] = 0.05
    yaw_sigma_rad: Annotated[
        float, _positive("1-sigma of the first yaw from a magnetometer or another estimator", "rad")
    ] = 0.09
    motion_yaw_sigma_rad: Annotated[
        float,
        _positive("how well a yaw from accelerations, where there is no magnetometer, must be known", "rad"),
    ] = 0.2


class Config(_Table, frozen=True):
    """Everything the estimator needs to know that is not in a measurement."""

    origin: Origin = Origin()
    imu: ImuConfig = ImuConfig()
    gps: GpsConfig = GpsConfig()
    barometer: BarometerConfig = BarometerConfig()
    magnetometer: MagnetometerConfig = MagnetometerConfig()
    attitude: AttitudeConfig = AttitudeConfig()
    rangefinder: RangefinderConfig = RangefinderConfig()
    vision: VisionConfig = VisionConfig()
    platform: PlatformConfig = PlatformConfig()
    landing: LandingConfig = LandingConfig()
    filter: FilterConfig = FilterConfig()
    initialisation: InitialisationConfig = InitialisationConfig()

    def __post_init__(self) -> None:
        """Check what a single field cannot: raises ``ConfigError``."""
        given = [self.origin.latitude_deg, self.origin.longitude_deg, self.origin.altitude_m]
        if any(v is None for v in given) and any(v is not None for v in given):
            raise ConfigError("origin: give latitude_deg, longitude_deg and altitude_m, or none of them")
        if self.filter.huber_sigma > self.filter.gate_sigma:
            raise ConfigError("filter.huber_sigma is above filter.gate_sigma; make it smaller")
        if self.landing.search_altitude_m is not None and not self.landing.search_altitude_m > 0.0:
            raise ConfigError("landing.search_altitude_m is not above the sea; give a positive height")
        for small, large in (
            ("r_land_m", "r_track_m"),
            ("touchdown_rate_mps", "approach_rate_mps"),
            ("observe_s", "observe_max_s"),
            ("abort_probability", "land_probability"),
            ("gear_m", "blind_height_m"),
            ("blind_height_m", "hold_height_m"),
        ):
            if getattr(self.landing, small) > getattr(self.landing, large):
                raise ConfigError(f"landing.{small} is above landing.{large}; make it smaller")
        for table in self.__struct_fields__:
            for name in getattr(self, table).__struct_fields__:
                value = getattr(getattr(self, table), name)
                for number in value if isinstance(value, tuple) else (value,):
                    if isinstance(number, float) and not math.isfinite(number):
                        raise ConfigError(f"{table}.{name} is {number}; give a finite number")


def parse_config(text: str, source: str = "configuration") -> Config:
    """Return the configuration that a TOML text describes.

    Raises ``ConfigError`` with the source's name, the key and the remedy.
    """
    try:
        data = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not valid TOML ({error}); correct that line") from None
    _refuse_unknown(data, Config, source, ())
    try:
        return msgspec.convert(data, Config, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{source}: {error}; correct that value") from None
    except ConfigError as error:
        raise ConfigError(f"{source}: {error}") from None


def load_config(path: str | Path) -> Config:
    """Return the configuration in a TOML file; raises ``ConfigError``."""
    try:
        text = Path(path).read_text(encoding="utf-8")
    except FileNotFoundError:
        raise ConfigError(f"{path}: no such file; give the path of a TOML configuration") from None
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}); give a UTF-8 TOML file") from None
    return parse_config(text, str(path))


def dump_config(config: Config) -> str:
    """Return the configuration as TOML, each parameter with its unit and meaning as a comment.

    Law: ``parse_config(dump_config(c)) == c``.
    """
    lines: list[str] = []
    for table, kind in _fields(Config):
        struct = getattr(config, table)
        lines.append(f"[{table}]")
        for name, annotation in _fields(kind):
            value = getattr(struct, name)
            meta = next((m for m in get_args(annotation) if isinstance(m, Meta)), None)
            if meta is not None:
                unit = (meta.extra or {}).get("unit", "-")
                lines.append(f"# {meta.description} [{unit}]")
            lines.append(f"# {name} =" if value is None else f"{name} = {_toml(value)}")
        lines.append("")
    return "\n".join(lines)


def _toml(value: object) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, tuple):
        return "[" + ", ".join(_toml(v) for v in value) + "]"
    return repr(value)


def _fields(kind: Any) -> list[tuple[str, Any]]:
    hints = get_type_hints(kind, include_extras=True)
    return [(name, hints[name]) for name in kind.__struct_fields__]


def _refuse_unknown(data: dict[str, Any], kind: Any, source: str, path: tuple[str, ...]) -> None:
    fields = dict(_fields(kind))
    for key, value in data.items():
        name = ".".join((*path, key))
        if key not in fields:
            near = difflib.get_close_matches(key, list(fields), n=1, cutoff=0.5)
            hint = f"did you mean {'.'.join((*path, near[0]))!r}?" if near else f"valid: {', '.join(fields)}"
            raise ConfigError(f"{source}: unknown key {name!r}; {hint}")
        inner = fields[key]
        inner = get_args(inner)[0] if get_origin(inner) is Annotated else inner
        if isinstance(inner, type) and issubclass(inner, msgspec.Struct):
            if not isinstance(value, dict):
                raise ConfigError(f"{source}: {name!r} is a table; write [{name}]")
            _refuse_unknown(value, inner, source, (*path, key))

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

from estimation.config_fields import Table, choice, not_negative, number, positive
from estimation.landing_config import LandingConfig
from estimation.sensor_config import (
    AttitudeConfig,
    BarometerConfig,
    GpsConfig,
    ImuConfig,
    MagnetometerConfig,
    RangefinderConfig,
    VisionConfig,
)


class ConfigError(ValueError):
    """A configuration that cannot be used; the message names the key, what is wrong and what to do."""


class Origin(Table, frozen=True):
    """Origin of the filter's NED frame; without one it is the first good GPS fix."""

    latitude_deg: Annotated[
        float | None, number("WGS-84 latitude of the anchor; None: first good GPS fix", "deg")
    ] = None
    longitude_deg: Annotated[float | None, number("WGS-84 longitude of the anchor", "deg")] = None
    altitude_m: Annotated[
        float | None, number("altitude of the mean deck or sea level, in the datum of the GPS", "m")
    ] = None


Motion = Annotated[tuple[Annotated[float, Meta(gt=0.0)], ...], Meta(min_length=22, max_length=22)]
"""Parameters of the platform's motion (``estimation.deck``)."""


class PlatformConfig(Table, frozen=True):
    """The floating platform: an anchored place, sway about it, a level, and heave."""

    use: Annotated[
        bool | Literal["auto"],
        choice("carry the platform's states; 'auto': where the log holds vision fixes, or a camera is flown"),
    ] = "auto"
    offset_walk: Annotated[
        float, not_negative("random walk of the mean place; 0.01: 0.03 m after 10 s", "m/rts")
    ] = 0.01
    drift_sigma_mps: Annotated[
        float,
        not_negative(
            "1-sigma of the velocity, per axis, at which the mean place drifts on its mooring, before it is learned",
            "m/s",
        ),
    ] = 0.075
    anchor_radius_m: Annotated[
        float | None,
        number("r_plat: 1-sigma of the place about the configured origin; None: known from vision only", "m"),
    ] = None
    sway_sigma_m: Annotated[
        float, positive("stationary 1-sigma of the sway before it is learned, per axis", "m")
    ] = 0.15
    sway_period_s: Annotated[float, positive("middle period of the sway before it is learned", "s")] = 4.0
    sway_damping: Annotated[float, positive("damping ratio of the sway's sections", "-")] = 0.5
    level_walk: Annotated[
        float,
        not_negative(
            "random walk of the mean height (tide, load); 0.002: 2 mm after 1 s, 6 mm after 10 s", "m/rts"
        ),
    ] = 0.002
    heave_sigma_m: Annotated[float, positive("stationary 1-sigma of the heave before it is learned", "m")] = (
        0.3
    )
    heave_period_s: Annotated[
        float,
        positive(
            "middle period of the heave before it is learned; seas from half to twice it are expected", "s"
        ),
    ] = 6.0
    heave_damping: Annotated[float, positive("damping of the heave before it is learned", "-")] = 0.5
    learn_s: Annotated[
        float, not_negative("interval at which the heave's spectrum is learned anew; 0: never", "s")
    ] = 2.0
    learn_window_s: Annotated[float, positive("how much of the past it is learned from", "s")] = 60.0
    motion: Annotated[
        Motion | None,
        number(
            "the motion as an earlier run learned it (LandingEstimator.motion), used until it is learned anew; None: "
            "any sea of the sizes and periods above",
            "mixed",
        ),
    ] = None


class FilterConfig(Table, frozen=True):
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
        positive(
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
        float, not_negative("rate of the estimates that come out; 0: one for each inertial sample", "Hz")
    ] = 50.0
    gravity_mps2: Annotated[
        float | None, number("magnitude of gravity; None: WGS-84 at the origin", "m/s^2")
    ] = None


class InitialisationConfig(Table, frozen=True):
    """How the filter starts."""

    rest_s: Annotated[float, positive("time over which rest is judged and the start averaged", "s")] = 1.0
    tilt_sigma_rad: Annotated[float, positive("1-sigma of roll and pitch levelled at rest", "rad")] = 0.01
    flight_tilt_sigma_rad: Annotated[
        float, positive("1-sigma of roll and pitch levelled in flight", "rad")
    ] = 0.05
    yaw_sigma_rad: Annotated[
        float, positive("1-sigma of the first yaw from a magnetometer or another estimator", "rad")
    ] = 0.09
    motion_yaw_sigma_rad: Annotated[
        float,
        positive("how well a yaw from accelerations, where there is no magnetometer, must be known", "rad"),
    ] = 0.2


class Config(Table, frozen=True):
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
                for part in value if isinstance(value, tuple) else (value,):
                    if isinstance(part, float) and not math.isfinite(part):
                        raise ConfigError(f"{table}.{name} is {part}; give a finite number")


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

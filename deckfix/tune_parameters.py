"""Parameters that can be tuned: which, between what bounds, and how a change of them is said in words.

They are positive numbers of the configuration and are tuned by their logarithm, so that a step is a factor. What is
tuned unless ``--parameters`` says otherwise are the noises of the sensors that a flight has; what can only be known
beforehand (lever arms, gates, initial sigmas, latencies) is not among them.
"""

from __future__ import annotations

import fnmatch
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, get_args, get_type_hints

from msgspec import Meta
from msgspec.structs import replace

from deckfix.files import InputError
from estimation.config import Config
from estimation.events import Kind

REACH = 100.0
"""Bounds without a word of the user: so many times smaller and larger than the value started from."""

DEFAULTS: dict[str, Kind | None] = {
    "imu.accel_noise": None,
    "imu.gyro_noise": None,
    "imu.accel_bias_walk": None,
    "imu.gyro_bias_walk": None,
    "gps.position_sigma_m": Kind.GPS_POSITION,
    "gps.height_sigma_m": Kind.GPS_POSITION,
    "gps.bias_sigma_m": Kind.GPS_POSITION,
    "gps.height_bias_sigma_m": Kind.GPS_POSITION,
    "gps.velocity_sigma_mps": Kind.GPS_VELOCITY,
    "gps.climb_sigma_mps": Kind.GPS_VELOCITY,
    "barometer.sigma_m": Kind.BAROMETER,
    "barometer.bias_walk": Kind.BAROMETER,
    "magnetometer.heading_sigma_rad": Kind.MAGNETOMETER,
    "attitude.tilt_sigma_rad": Kind.ATTITUDE,
    "attitude.yaw_sigma_rad": Kind.ATTITUDE,
    "rangefinder.sigma_m": Kind.RANGEFINDER,
    "vision.angle_sigma_rad": Kind.VISION,
    "vision.range_sigma": Kind.VISION,
    "vision.floor_m": Kind.VISION,
    "platform.drift_sigma_mps": Kind.VISION,
    "platform.level_walk": Kind.VISION,
    "platform.sway_sigma_m": Kind.VISION,
    "platform.heave_sigma_m": Kind.VISION,
}
"""Parameters that are tuned without ``--parameters``, each with the measurements that it needs."""


@dataclass(frozen=True, slots=True)
class Parameter:
    """A number of the configuration, ``table.key``: what it is started from, its bounds, unit and meaning."""

    name: str
    start: float
    lower: float
    upper: float
    unit: str
    meaning: str


def choose(
    config: Config, measured: Iterable[Kind], patterns: Sequence[str] = (), bounds: Sequence[str] = ()
) -> tuple[list[Parameter], list[str]]:
    """Return the parameters to tune, and a line for each that was asked for and cannot be.

    ``patterns`` are names in which ``*`` stands for anything, none of them for the default list; ``bounds`` read
    ``table.key=LOW:HIGH``. Raises ``InputError`` for a pattern that fits nothing and for bounds that cannot be read.
    """
    known = {p.name: p for p in _numbers(config)}
    given = dict(_bound(text, known) for text in bounds)
    there = set(measured)
    if patterns:
        names = [name for pattern in patterns for name in _matching(pattern, known)]
    else:
        names = [n for n, kind in DEFAULTS.items() if (kind is None or kind in there) and _in_use(n, config)]
    chosen, remarks = [], list[str]()
    for name in dict.fromkeys(names):
        p = known[name]
        low, high = given.get(name, (p.lower, p.upper))
        if not p.start > 0.0:
            remarks.append(f"{name} is {p.start:g} and is left out: give it a positive value to start from")
        elif not low < high:
            remarks.append(
                f"{name} is left out: its bounds contradict each other ({low:g} is not below {high:g})"
            )
        elif not low <= p.start <= high:
            remarks.append(
                f"{name} is left out: it starts from {p.start:g}, outside its bounds {low:g} to {high:g}"
            )
        elif low < p.lower and name in given and not _allowed(config, name, low):
            remarks.append(f"{name} is left out: the configuration does not allow {low:g}")
        elif high > p.upper and name in given and not _allowed(config, name, high):
            remarks.append(f"{name} is left out: the configuration does not allow {high:g}")
        else:
            chosen.append(Parameter(name, p.start, low, high, p.unit, p.meaning))
    idle = [name for name in given if name not in names]
    remarks += [f"the bounds of {name} are not used: it is not tuned" for name in idle]
    return chosen, remarks


def with_values(config: Config, values: Iterable[tuple[str, float]]) -> Config:
    """Return the configuration with other values, by ``table.key``."""
    tables: dict[str, dict[str, float]] = {}
    for name, value in values:
        table, key = name.split(".")
        tables.setdefault(table, {})[key] = value
    return replace(config, **{t: replace(getattr(config, t), **keys) for t, keys in tables.items()})


def factor_in_words(factor: float) -> str:
    """Return a change by a factor in words."""
    if 0.995 < factor < 1.005:
        return "unchanged"
    return f"{factor:.3g} times larger" if factor > 1.0 else f"{1.0 / factor:.3g} times smaller"


def _numbers(config: Config) -> Iterable[Parameter]:
    """Yield every number of the configuration that is a length, a rate, a noise: one that may be scaled."""
    for table in config.__struct_fields__:
        struct = getattr(config, table)
        hints: dict[str, Any] = get_type_hints(type(struct), include_extras=True)
        for key in struct.__struct_fields__:
            value = getattr(struct, key)
            meta = next((m for m in get_args(hints[key]) if isinstance(m, Meta)), None)
            if not isinstance(value, float) or meta is None or (meta.gt is None and meta.ge is None):
                continue
            low, high = value / REACH, value * REACH
            if meta.le is not None:
                high = min(high, float(meta.le))
            if meta.lt is not None:
                high = min(high, math.nextafter(float(meta.lt), -math.inf))
            if (least := max(meta.gt or 0.0, meta.ge or 0.0)) > 0.0:
                low = max(low, math.nextafter(float(least), math.inf))
            unit = (meta.extra or {}).get("unit", "-")
            meaning = (meta.description or "").split(";")[0]
            yield Parameter(f"{table}.{key}", value, low, high, unit, meaning)


def _in_use(name: str, config: Config) -> bool:
    """Whether a parameter of the default list can be seen at all with this configuration."""
    table = name.split(".", maxsplit=1)[0]
    if table in ("platform", "vision"):
        return config.platform.use is not False  # compared fixes say that 'auto' has switched it on
    if table in ("barometer", "magnetometer", "rangefinder"):
        return bool(getattr(config, table).use)
    if table == "attitude":
        return config.attitude.use == "fuse"
    return config.gps.bias if name in ("gps.bias_sigma_m", "gps.height_bias_sigma_m") else True


def _matching(pattern: str, known: dict[str, Parameter]) -> list[str]:
    found = fnmatch.filter(known, pattern)
    if not found:
        raise InputError(
            f"--parameters {pattern}: no number of the configuration has this name; write table.key, such as "
            "gps.velocity_sigma_mps, or gps.*"
        )
    return found


def _bound(text: str, known: dict[str, Parameter]) -> tuple[str, tuple[float, float]]:
    name, _, span = text.partition("=")
    low, _, high = span.partition(":")
    try:
        values = float(low), float(high)
    except ValueError:
        values = (math.nan, math.nan)
    if name not in known or not all(math.isfinite(v) and v > 0.0 for v in values):
        raise InputError(
            f"--bounds {text}: cannot be read; write table.key=LOW:HIGH with positive numbers, such as "
            "imu.gyro_noise=1e-5:1e-2"
        )
    return name, values


def _allowed(config: Config, name: str, value: float) -> bool:
    """Whether a configuration with this value could be written and read again."""
    from estimation.config import ConfigError, dump_config, parse_config

    try:
        parse_config(dump_config(with_values(config, [(name, value)])))
    except ConfigError:
        return False
    return True

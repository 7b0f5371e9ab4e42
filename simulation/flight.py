"""Scenarios, and the flights that are made from them: events, truth and a recording that can be written as
a log.

A scenario is a TOML file in ``simulation/scenarios``, with a date in its name, that is never changed
afterwards. It and a seed give the same flight, to the last bit.
"""

from __future__ import annotations

import json
import math
import tomllib
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib import resources
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from estimation.alignment import world_magnetic_declination
from estimation.config import Config, ConfigError, dump_config, parse_config
from estimation.events import AUTOPILOT, EventBatch
from estimation.frames import normal_gravity
from estimation.output import Facts
from logs.events import series_of_batch
from logs.recording import Recording, Series
from logs.sensors import Times, odometry_series
from simulation.jets import Array
from simulation.platform import Platform, Raft
from simulation.sea import BEAUFORT_WIND_MPS, Sea, Wave, beaufort
from simulation.sensors import CLOCKS, Clock, Place, Sensors, SlowError, Streams
from simulation.trajectory import Plan, Rock, Trajectory, Wind, quaternions

TRUTH_RATE_HZ = 50.0


class SiteTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Anchor and date: the NED origin is the anchor at the mean sea level."""

    latitude_deg: float = 63.4394
    longitude_deg: float = 10.3986
    altitude_m: float = 0.0
    utc: datetime = datetime(2026, 6, 1, 10, 0, 0, tzinfo=UTC)
    dip_deg: float = 74.0
    field_t: float = 52e-6


class WavesTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The sea: a Beaufort force, and systems of waves beside it."""

    beaufort: int | None = None
    direction_deg: float = 40.0
    waves: tuple[Wave, ...] = ()


class WindTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """The wind: speed (None: that of the Beaufort force), where it blows to, and the sway that it causes."""

    speed_mps: float | None = None
    direction_deg: float = 40.0
    sway_m: float = 0.3


class Scenario(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A flight to be simulated.

    ``filter`` is what the estimator is told, and what the sensors are drawn from; the entries of
    ``mismatch``, tables of the same configuration, replace it for the drawing alone.
    """

    description: str
    seed: int = 1
    site: SiteTable = SiteTable()
    plan: Plan = Plan()
    sea: WavesTable = WavesTable(beaufort=2)
    raft: Raft = Raft()
    wind: WindTable = WindTable()
    rock: Rock | None = None
    streams: Streams = Streams()
    clocks: dict[str, Clock] = {}
    vibration_mps2: float = 0.0
    filter: dict[str, Any] = {}
    mismatch: dict[str, Any] = {}

    @property
    def config(self) -> Config:
        """What the estimator is told."""
        return config_of(self.filter, "filter")

    @property
    def drawn(self) -> Config:
        """What the sensors are drawn from."""
        return config_of(merged(self.filter, self.mismatch), "mismatch")


@dataclass(frozen=True, slots=True)
class SimulatedFlight:
    """A flight: what arrived, and what is true; ``slow`` are the sensors' slow errors by the state's block."""

    scenario: Scenario
    seed: int
    trajectory: Trajectory
    place: Place
    batch: EventBatch
    slow: dict[str, SlowError]

    @property
    def clock(self) -> Clock:
        """The autopilot's clock."""
        return self.scenario.clocks.get(AUTOPILOT, Clock())

    @property
    def facts(self) -> Facts:
        """What the log of this flight says about its sensors."""
        return Facts(
            imu_latency_s=self.scenario.drawn.imu.latency_s or 0.0,
            vision=self.scenario.streams.vision is not None,
        )

    def recording(self) -> Recording:
        """Return the flight as a recording: sensors, truth, the filter's configuration and how it was made."""
        offsets = {name: self._offset_ns(name) for name in CLOCKS}
        series = series_of_batch(self.batch)
        used = {s.clock for s in series}
        for one in series:
            if one.topic == "/imu":
                one.metadata["latency_s"] = repr(self.facts.imu_latency_s)
        plan = self.trajectory.plan
        bounds = {f"{name}_s": f"{a:.3f} {b:.3f}" for name, (a, b) in plan.bounds_s.items()}
        return Recording(
            series=[*series, *self._truth()],
            clock_offsets_ns={
                name: offset for name, offset in offsets.items() if name in used or name == AUTOPILOT
            },
            metadata={
                "deckfix.simulation": {
                    "description": self.scenario.description,
                    "seed": str(self.seed),
                    "significant_wave_height_m": f"{self.trajectory.platform.sea.significant_height_m:.3f}",
                    **bounds,
                }
            },
            attachments={"config.toml": ("application/toml", dump_config(self.scenario.config).encode())},
        )

    def _offset_ns(self, name: str) -> int:
        return self.place.utc_ns - round(self.scenario.clocks.get(name, Clock()).offset_s * 1e9)

    def _truth(self) -> list[Series]:
        t = np.arange(0.0, self.trajectory.plan.duration_s, 1.0 / TRUTH_RATE_HZ)
        m = self.trajectory.motion(t)
        deck = self.trajectory.platform.motion(t)
        stamp = self.clock.stamp_ns(t)
        arrival = self.place.utc_ns + np.round(t * 1e9).astype(np.int64)
        times = Times(stamp, arrival)
        source = {"sensor": "simulation"}
        attitude = quaternions(deck_axes(deck.normal[0]))
        return [
            odometry_series("/truth/odometry", times, m.position_m, m.velocity_mps, m.quaternion, source),
            odometry_series("/truth/platform", times, deck.position[0], deck.position[1], attitude, source),
        ]


def scenario_names() -> list[str]:
    """Return the names of the scenarios that come with the package."""
    folder = resources.files("simulation") / "scenarios"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))


def load_scenario(name: str | Path) -> Scenario:
    """Return a scenario by its name, or from the path of a TOML file.

    Raises ``ConfigError`` for an unknown name, and for a file that is no scenario, with the key and the
    remedy.
    """
    given = str(name)
    if not given.endswith(".toml") and given in scenario_names():
        text = (resources.files("simulation") / "scenarios" / f"{given}.toml").read_text(encoding="utf-8")
    elif given.endswith(".toml"):
        try:
            text = Path(given).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{given}: cannot be read ({error}); give the path of a scenario") from None
    else:
        known = ", ".join(scenario_names())
        raise ConfigError(f"scenario {given!r} is unknown; use one of {known}, or the path of a .toml file")
    return parse_scenario(text, given)


def parse_scenario(text: str, source: str = "scenario") -> Scenario:
    """Return the scenario that a TOML text describes; raises ``ConfigError``."""
    try:
        scenario = msgspec.convert(tomllib.loads(text), Scenario, strict=False)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not valid TOML ({error}); correct that line") from None
    except (msgspec.ValidationError, ValueError) as error:
        raise ConfigError(f"{source}: {error}; correct that entry") from None
    try:
        _ = scenario.config, scenario.drawn
        waves_of(scenario.sea)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from None
    return scenario


def simulate(scenario: Scenario, seed: int | None = None) -> SimulatedFlight:
    """Return a flight: the same for the same scenario and seed (None: the scenario's own)."""
    chosen = scenario.seed if seed is None else seed
    world, air, sensing = np.random.default_rng(chosen).spawn(3)
    place = place_of(scenario.site, scenario.drawn)
    platform = Platform.draw(scenario.raft, Sea.draw(waves_of(scenario.sea), world), world)
    wind = scenario.wind
    speed = wind_speed_mps(wind, scenario.sea)
    blow = Wind.draw(speed, math.radians(wind.direction_deg), wind.sway_m, air)
    gravity = normal_gravity(float(place.origin[0]), float(place.origin[2]))
    trajectory = Trajectory(scenario.plan, blow, platform, gravity, rock=scenario.rock)
    sensors = Sensors(scenario.drawn, scenario.streams, scenario.clocks, place, scenario.vibration_mps2)
    drawn = sensors.draw(trajectory, sensing)
    return SimulatedFlight(scenario, chosen, trajectory, place, drawn.batch, drawn.slow)


def place_of(site: SiteTable, drawn: Config) -> Place:
    """Return the place of a flight; its declination is the compass's, else the World Magnetic Model's."""
    origin = np.array([math.radians(site.latitude_deg), math.radians(site.longitude_deg), site.altitude_m])
    utc_s = site.utc.replace(tzinfo=site.utc.tzinfo or UTC).timestamp()
    declination = drawn.magnetometer.declination_deg
    if declination is None:
        radians = world_magnetic_declination(float(origin[0]), float(origin[1]), float(origin[2]), utc_s)
    else:
        radians = math.radians(declination)
    return Place(origin, radians, math.radians(site.dip_deg), site.field_t, round(utc_s) * 1_000_000_000)


def waves_of(sea: WavesTable) -> list[Wave]:
    """Return the systems of waves of a sea; raises ``ValueError`` for a force that is not flown in."""
    waves = list(sea.waves)
    if sea.beaufort is not None:
        waves = [*beaufort(sea.beaufort, math.radians(sea.direction_deg)), *waves]
    return waves


def wind_speed_mps(wind: WindTable, sea: WavesTable) -> float:
    """Return the mean speed of the wind: the one given, or that of the sea's Beaufort force."""
    return BEAUFORT_WIND_MPS.get(sea.beaufort or 0, 0.0) if wind.speed_mps is None else wind.speed_mps


def config_of(tables: dict[str, Any], source: str) -> Config:
    """Return a configuration from a scenario's tables, as strictly as from a file."""
    lines = []
    for name, table in tables.items():
        if not isinstance(table, dict):
            raise ConfigError(f"{source}.{name} is no table; write [{source}.{name}]")
        # JSON's numbers, strings, booleans and lists are TOML's.
        lines += [f"[{name}]", *(f"{key} = {json.dumps(value)}" for key, value in table.items())]
    return parse_config("\n".join(lines), source)


def merged(below: dict[str, Any], above: dict[str, Any]) -> dict[str, Any]:
    """Return nested tables in which the entries of ``above`` replace those of ``below``."""
    out = dict(below)
    for key, value in above.items():
        out[key] = merged(out.get(key, {}), value) if isinstance(value, dict) else value
    return out


def deck_axes(downward: Array) -> Array:
    """Return rotations to NED (n, 3, 3) whose third axis is along downward normals (n, 3), the first
    northwards.
    """
    down = downward / np.linalg.norm(downward, axis=1, keepdims=True)
    east = np.cross(down, [1.0, 0.0, 0.0])
    east /= np.linalg.norm(east, axis=1, keepdims=True)
    return np.stack([np.cross(east, down), east, down], axis=2)

"""Missions: scenarios that are flown in a closed loop, from take-off to the deck.

A mission is a TOML file in ``simulation/missions``, with a date in its name, that is never changed afterwards.
"""

from __future__ import annotations

import tomllib
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec

from estimation.config import Config, ConfigError
from simulation.flight import SiteTable, WavesTable, WindTable, config_of, merged, waves_of
from simulation.mishaps import Mishap
from simulation.platform import Raft
from simulation.sensors import Clock, Streams, VisionStream
from simulation.vehicle import Airframe

_Positive = Annotated[float, msgspec.Meta(gt=0.0)]


class Mission(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """A mission to be flown.

    The vehicle stands at ``start_m`` (NED from the anchor) for ``rest_s``, climbs for ``take_off_s``, and is then led
    by the landing modes until it has landed, gives up, or ``longest_s`` are over. ``deck_m`` is the deck's side,
    ``target_m`` the outer diameter of the ring target on it. ``filter`` is what the estimator is told, and what the
    sensors are drawn from; the tables of ``mismatch`` replace it for the drawing alone. ``mishaps`` go wrong.
    ``closed_loop`` marks the file as a mission.
    """

    description: str
    closed_loop: Literal[True]
    seed: int = 1
    site: SiteTable = SiteTable()
    sea: WavesTable = WavesTable(beaufort=2)
    raft: Raft = Raft()
    wind: WindTable = WindTable()
    airframe: Airframe = Airframe()
    streams: Streams = Streams(vision=VisionStream(rate_hz=20.0))
    clocks: dict[str, Clock] = {}
    start_m: tuple[float, float, float] = (-16.0, -10.0, -2.0)
    start_yaw_rad: float = 0.6
    rest_s: _Positive = 4.0
    take_off_s: _Positive = 2.0
    longest_s: _Positive = 240.0
    deck_m: _Positive = 2.4
    target_m: _Positive = 1.0
    filter: dict[str, Any] = {}
    mismatch: dict[str, Any] = {}
    mishaps: tuple[Mishap, ...] = ()

    @property
    def config(self) -> Config:
        """What the estimator is told."""
        return config_of(self.filter, "filter")

    @property
    def drawn(self) -> Config:
        """What the sensors are drawn from."""
        return config_of(merged(self.filter, self.mismatch), "mismatch")


def mission_names() -> list[str]:
    """Return the names of the missions that come with the package."""
    folder = resources.files("simulation") / "missions"
    return sorted(f.name.removesuffix(".toml") for f in folder.iterdir() if f.name.endswith(".toml"))


def is_mission(name: str) -> bool:
    """Tell whether a name, or the TOML file at a path, is a mission's: it says ``closed_loop``."""
    if not name.endswith(".toml"):
        return name in mission_names()
    try:
        return "closed_loop" in tomllib.loads(Path(name).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return False


def load_mission(name: str | Path) -> Mission:
    """Return a mission by its name, or from the path of a TOML file; raises ``ConfigError``."""
    given = str(name)
    if not given.endswith(".toml") and given in mission_names():
        text = (resources.files("simulation") / "missions" / f"{given}.toml").read_text(encoding="utf-8")
    elif given.endswith(".toml"):
        try:
            text = Path(given).read_text(encoding="utf-8")
        except (OSError, UnicodeDecodeError) as error:
            raise ConfigError(f"{given}: cannot be read ({error}); give the path of a mission") from None
    else:
        known = ", ".join(mission_names())
        raise ConfigError(f"mission {given!r} is unknown; use one of {known}, or the path of a .toml file")
    return parse_mission(text, given)


def parse_mission(text: str, source: str = "mission") -> Mission:
    """Return the mission that a TOML text describes; raises ``ConfigError``."""
    try:
        mission = msgspec.convert(tomllib.loads(text), Mission, strict=False)
    except tomllib.TOMLDecodeError as error:
        raise ConfigError(f"{source}: not valid TOML ({error}); correct that line") from None
    except (msgspec.ValidationError, ValueError) as error:
        raise ConfigError(f"{source}: {error}; correct that entry") from None
    try:
        config, _ = mission.config, mission.drawn
        waves_of(mission.sea)
    except ValueError as error:
        raise ConfigError(f"{source}: {error}") from None
    if mission.streams.vision is None or config.platform.use is False:
        raise ConfigError(
            f"{source}: a landing needs vision; give [streams.vision] and no filter.platform.use = false"
        )
    return mission

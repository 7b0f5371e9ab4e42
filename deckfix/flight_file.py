"""The configuration of a flight on board: the estimator's tables, and ``[onboard]`` with what stands around it.

    [onboard]
    camera = "camera.toml"          # intrinsics, as deckfix calibrate writes them; relative to this file
    target = "target.toml"          # rings, as deckfix target writes them
    imu_rate_hz = 100.0

An option of the command line takes the place of an entry; a target that is not the configuration's own is refused,
since a wrong size is a wrong height.
"""

from __future__ import annotations

import tomllib
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import msgspec

from deckfix.files import InputError, loaded
from deckfix.pipeline import DetectorSettings
from deckfix.video_import import CAMERA_NAME, TARGET_NAME
from estimation.config import Config, ConfigError, dump_config, load_config
from simulation.flight import config_of
from vision.camera import Camera
from vision.target import RingTarget

_Rate = Annotated[float, msgspec.Meta(ge=10.0, le=1000.0)]
_Quality = Annotated[int, msgspec.Meta(ge=1, le=100)]


class OnboardTable(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """``[onboard]``: files relative to the configuration's; ``detector`` as in ``DetectorSettings``.

    ``imu_rate_hz`` is what the autopilot is asked for; ``rangefinder`` asks for DISTANCE_SENSOR, ``attitude`` for the
    autopilot's own attitude. ``jpeg_quality`` is of the recorded images (those that come as JPEG stay as they are).
    """

    camera: str | None = None
    target: str | None = None
    imu_rate_hz: _Rate = 100.0
    rangefinder: bool = False
    jpeg_quality: _Quality = 80
    detector: DetectorSettings = DetectorSettings()


@dataclass(frozen=True, slots=True)
class FlightFile:
    """All that a flight on board is set up with."""

    config: Config = field(default_factory=Config)
    table: OnboardTable = field(default_factory=OnboardTable)
    camera: Camera | None = None
    target: RingTarget | None = None

    def attachments(self) -> dict[str, tuple[str, bytes]]:
        """Return what a log of the flight carries along: configuration, camera and target as TOML."""
        texts = {"config.toml": dump_config(self.config)}
        if self.camera is not None:
            texts[CAMERA_NAME] = self.camera.to_toml()
        if self.target is not None:
            texts[TARGET_NAME] = self.target.to_toml()
        return {name: ("application/toml", text.encode()) for name, text in texts.items()}


def load_flight_file(
    path: str | Path | None, *, camera: str | Path | None = None, target: str | Path | None = None
) -> FlightFile:
    """Return the set-up in a TOML file, with the files that the command line names instead.

    Raises ``ConfigError`` for the configuration and ``InputError`` for a camera or a target that cannot be used.
    """
    if path is None:
        config, table, folder = Config(), OnboardTable(), Path()
    else:
        config, table = _parsed(Path(path))
        folder = Path(path).parent
    cameras = camera if camera is not None else _beside(folder, table.camera)
    own = _beside(folder, table.target)
    rings = None if own is None else loaded(RingTarget, own)
    if target is not None:
        given = loaded(RingTarget, target)
        if rings is not None and (given.edges_m, given.board_m) != (rings.edges_m, rings.board_m):
            raise InputError(
                f"{path}: is for the target {own} ({rings.diameter_m:g} m), not for {target} "
                f"({given.diameter_m:g} m); give the configuration of this target, or no --target"
            )
        rings = given
    return FlightFile(config, table, None if cameras is None else loaded(Camera, cameras), rings)


def _parsed(path: Path) -> tuple[Config, OnboardTable]:
    try:
        data: dict[str, Any] = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError):
        load_config(path)  # says what is wrong
        raise
    table = data.pop("onboard", {})
    try:
        made = msgspec.convert(table, OnboardTable, strict=False)
    except msgspec.ValidationError as error:
        raise ConfigError(f"{path}: onboard: {error}; correct that entry") from None
    return config_of(data, str(path)), made


def _beside(folder: Path, name: str | None) -> Path | None:
    return None if name is None else folder / name

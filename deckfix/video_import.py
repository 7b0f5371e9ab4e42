"""What ``deckfix import`` adds to a flight: the camera's recording, the camera, the target."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from deckfix.files import InputError, existing, loaded

if TYPE_CHECKING:
    from logs.video import Frame, FrameTimes
    from logs.writer import FlightWriter
    from vision.camera import Camera
    from vision.target import RingTarget

CAMERA_NAME, TARGET_NAME = "camera.toml", "target.toml"
"""Attachments in which a log carries the camera and the target."""
_TOML = "application/toml"
_SEEN = "deckfix.video"


@dataclass(frozen=True, slots=True)
class Extras:
    """What is added to a flight's log; ``offset_ns`` is the frames' clock less the autopilot's (None: not told)."""

    video: Path | None = None
    stamps: Path | None = None
    offset_ns: int | None = None
    camera: Camera | None = None
    target: RingTarget | None = None

    @classmethod
    def of(
        cls,
        video: str | None,
        stamps: str | None,
        offset_s: str | None,
        camera: str | None,
        target: str | None,
    ) -> Extras | None:
        """Return what the command line names, or None; raises ``InputError`` for what cannot be used."""
        if not any(v is not None for v in (video, stamps, offset_s, camera, target)):
            return None
        if video is None and (stamps is not None or offset_s is not None):
            raise InputError(f"{stamps or '--offset'}: tells of frames that are not there; give --video too")
        from vision.camera import Camera
        from vision.target import RingTarget

        return cls(
            None if video is None else _recording(video),
            None if stamps is None else existing(stamps),
            None if offset_s is None else _nanoseconds(offset_s),
            None if camera is None else loaded(Camera, camera),
            None if target is None else loaded(RingTarget, target),
        )

    @property
    def inputs(self) -> list[Path]:
        """The files that are read."""
        return [p for p in (self.video, self.stamps) if p is not None and p.is_file()]

    @property
    def attachments(self) -> dict[str, str]:
        """The texts that the log carries along, by name."""
        named = ((CAMERA_NAME, self.camera), (TARGET_NAME, self.target))
        return {name: one.to_toml() for name, one in named if one is not None}

    def times(self) -> FrameTimes:
        """Return when the frames were taken; raises ``InputError`` where nothing ties them to the flight."""
        from estimation.events import CAMERA
        from logs.video import FrameTimes, read_stamps

        assert self.video is not None
        times = FrameTimes(self.offset_ns or 0)
        if self.stamps is not None:
            times = read_stamps(self.stamps, self.offset_ns)
        elif self.video.is_dir():
            raise InputError(f"{self.video}: pictures have no times; give them with --stamps S.csv")
        if times.clock == CAMERA and self.offset_ns is None:
            raise InputError(
                f"{self.stamps or self.video}: nothing ties its times to the flight's clock; give --offset, which is "
                "what the frames' clock shows less what the autopilot's shows at the same moment, in seconds"
            )
        return times

    def write(self, writer: FlightWriter, span_ns: tuple[int, int]) -> tuple[list[str], list[str]]:
        """Add all of it to a log whose other messages are written; return what there is to say, and problems."""
        for name, text in self.attachments.items():
            writer.add_attachment(name, _TOML, text.encode())
        if self.video is None:
            return [], []
        from logs.images import INFO_TOPIC
        from logs.video import frames, write_frames

        times = self.times()
        if times.written_clock not in writer.clock_offsets_ns:
            raise InputError(
                f"{self.stamps}: the flight has no {times.written_clock} clock; give the frames' times by the "
                "autopilot's clock, or by the camera's own with --offset"
            )
        done = write_frames(writer, _checked(frames(self.video), self.camera, self.video), times, span_ns)
        if done.first_ns is None:
            raise InputError(
                f"{self.video}: none of its frames can be used ({'; '.join(done.problems) or 'it has none'}); check "
                "the recording, --stamps, and --offset with its sign: t_flight = t_frame - offset"
            )
        if self.camera is not None:
            arrival = done.first_ns + writer.clock_offsets_ns[done.clock]
            message = self.camera.to_camera_info()
            writer.write_message(
                INFO_TOPIC, message, arrival_ns=arrival, stamp_ns=done.first_ns, clock=done.clock
            )
        told = {"frames": done.frames, "undecodable": done.undecodable, "outside": done.outside}
        told |= {"untimed": done.untimed}
        entries = {"file": self.video.name, "clock": times.clock, "offset_ns": str(times.offset_ns)}
        writer.add_metadata(_SEEN, entries | {k: str(v) for k, v in told.items()})
        return [f"{done.frames} images of {self.video.name}"], done.problems


def _checked(source: Iterator[Frame], camera: Camera | None, path: Path) -> Iterator[Frame]:
    """Return the frames, of which the first that can be decoded is of the camera's size."""
    from logs.images import size_of

    before = []
    for frame in source:
        before.append(frame)
        if frame.data is None:
            continue
        size = size_of(frame.data)
        if camera is not None and size is not None and size != (camera.width, camera.height):
            raise InputError(
                f"{path}: has {size[0]} x {size[1]} pixels, the camera file is for {camera.width} x {camera.height}; "
                "give the calibration of this camera and mode"
            )
        break
    return chain(before, source)


def _recording(path: str) -> Path:
    place = Path(path)
    return place if place.is_dir() else existing(place)


def _nanoseconds(text: str) -> int:
    try:
        return int(Decimal(text) * 1_000_000_000)
    except (InvalidOperation, ValueError, OverflowError):
        raise InputError(f"--offset: {text!r} is no number of seconds; give one, for example -52.3") from None

"""A camera's recording beside a flight: a video or a folder of pictures, and when each frame was taken.

A video's frames have the times that its file gives them (from its beginning); a table of stamps takes their place, and
is what pictures in a folder need. Whatever clock the frames are stamped by, one number ties it to the flight's:

    t_flight = t_frame - offset,    offset = what the frames' clock shows - what the autopilot's clock shows

JPEG is kept as it is, in a folder and in a Motion-JPEG video; frames of other videos are encoded anew, hardly
compressed and with full colour. PyAV reads videos where it is installed, else OpenCV does.
"""

from __future__ import annotations

import csv
import importlib.util
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from decimal import Decimal, InvalidOperation
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from estimation.events import AUTOPILOT, CAMERA, COMPANION
from logs.errors import LogError
from logs.images import TOPIC, size_of
from logs.writer import UTC, FlightWriter

PICTURES = (".jpg", ".jpeg", ".png")
CLOCKS = (CAMERA, AUTOPILOT, COMPANION, UTC)
"""Clocks that a table of stamps may name; ``camera`` is one that nothing else in the flight knows."""
JPEG_QUALITY = 95
MARGIN_NS = 2_000_000_000
"""Frames further than this before or after the flight are left out."""
_UNITS = {"s": 1_000_000_000, "ms": 1_000_000, "us": 1_000, "ns": 1}
_TIME = re.compile(r"^(?:t|time|stamp|timestamp)[ _]*[\[(]?(s|ms|us|ns)[\])]?$")
_JPEG, _PNG = b"\xff\xd8", b"\x89PNG"


@dataclass(frozen=True, slots=True)
class Frame:
    """A frame: its number from 0, its name (a picture's), its time from the beginning (a video's), and its file.

    ``data`` is JPEG or PNG, None where the frame cannot be decoded.
    """

    number: int
    name: str
    t_ns: int | None
    data: bytes | None

    @property
    def format(self) -> str:
        """What CompressedImage calls the file's format."""
        return "png" if self.data is not None and self.data.startswith(_PNG) else "jpeg"


@dataclass(frozen=True, slots=True)
class FrameTimes:
    """When frames were taken: by a table (None: by the video itself), in ``clock``, less ``offset_ns``."""

    offset_ns: int = 0
    clock: str = CAMERA
    by_number: Mapping[int, int] | None = None
    by_name: Mapping[str, int] | None = None

    @property
    def written_clock(self) -> str:
        """The flight's clock that the frames are stamped by in the log."""
        return COMPANION if self.clock == COMPANION else AUTOPILOT

    def of(self, frame: Frame) -> int | None:
        """Return a frame's time on the flight's side of the offset [ns], or None where none is known."""
        if self.by_name is not None:
            shown = self.by_name.get(frame.name, self.by_name.get(Path(frame.name).stem))
        elif self.by_number is not None:
            shown = self.by_number.get(frame.number)
        else:
            shown = frame.t_ns
        return None if shown is None else shown - self.offset_ns


@dataclass(slots=True)
class Written:
    """What became of the frames: written, not to be decoded, without a time, outside the flight's time.

    ``first_ns`` is the earliest stamp, in ``clock``.
    """

    frames: int = 0
    undecodable: int = 0
    untimed: int = 0
    outside: int = 0
    first_ns: int | None = None
    clock: str = AUTOPILOT
    problems: list[str] = field(default_factory=list)


def frames(path: str | Path) -> Iterator[Frame]:
    """Yield the frames of a video, or of a folder of JPEG and PNG pictures in the order of their names.

    Raises LogError where there are none, or the video cannot be opened.
    """
    place = Path(path)
    if place.is_dir():
        return _pictures(place)
    return _with_av(place) if importlib.util.find_spec("av") else _with_opencv(place)


def read_stamps(path: str | Path, offset_ns: int | None) -> FrameTimes:
    """Read a table of stamps (CSV): ``t_ns``, ``t_us``, ``t_ms`` or ``t_s``; ``frame`` (its number from 0, or a
    picture's name; without it the rows follow the frames); ``clock`` (one of ``CLOCKS``, the same in all rows).

    Raises LogError, with the line, for a table that cannot be used.
    """
    place = Path(path)
    try:
        with place.open(encoding="utf-8-sig", newline="") as file:
            rows = list(csv.reader(file))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise LogError(
            place, f"cannot be read as a table ({error})", "give a CSV file with a header"
        ) from None
    heads = [h.strip().lower() for h in rows[0]] if rows else []
    timed = [(k, found[1]) for k, h in enumerate(heads) if (found := _TIME.match(h))]
    if len(timed) != 1:
        raise LogError(place, "has no column of times, or several", "head one column t_ns, t_us, t_ms or t_s")
    (column, unit), shown, clocks = timed[0], dict[str, int](), set[str]()
    for line, row in enumerate(rows[1:], start=2):
        if not any(cell.strip() for cell in row):
            continue
        cells = dict(zip(heads, (cell.strip() for cell in row), strict=False))
        frame = cells.get("frame", str(len(shown)))
        try:
            t_ns = int(Decimal(row[column].strip()) * _UNITS[unit])
        except (IndexError, InvalidOperation, ValueError, OverflowError):
            raise LogError(place, f"line {line} has no time", "write a number there") from None
        if frame in shown:
            raise LogError(place, f"line {line} has frame {frame} again", "give each frame one time")
        shown[frame] = t_ns
        clocks.add(cells.get("clock", CAMERA))
    if not shown:
        raise LogError(place, "holds no stamps", "write one row for each frame")
    if len(clocks) > 1 or not clocks <= set(CLOCKS):
        named = ", ".join(sorted(clocks))
        raise LogError(place, f"names the clocks {named}", f"name one of {', '.join(CLOCKS)} in all rows")
    clock = clocks.pop()
    numbers = {int(f): t for f, t in shown.items() if f.isdecimal()}
    if len(numbers) == len(shown):
        return FrameTimes(offset_ns or 0, clock, by_number=numbers)
    return FrameTimes(offset_ns or 0, clock, by_name=shown)


def write_frames(
    writer: FlightWriter, source: Iterator[Frame], times: FrameTimes, span_ns: tuple[int, int]
) -> Written:
    """Write frames as /camera/image/compressed to a log that knows ``times.written_clock``; each arrives at its stamp.

    ``span_ns`` are the first and the last arrival of the flight. Frames of the clock ``camera`` or ``utc`` are stamped
    on the autopilot's, since the offset says what that showed; the channel's metadata tell the offset.
    """
    constants = writer.clock_offsets_ns
    clock = times.written_clock
    shift = -constants[AUTOPILOT] if times.clock == UTC else 0
    metadata = {"frames_clock": times.clock, "frames_offset_ns": str(times.offset_ns - shift)}
    out = Written(clock=clock)
    for frame in source:
        t_ns = times.of(frame)
        if frame.data is None:
            out.undecodable += 1
            continue
        if t_ns is None:
            out.untimed += 1
            continue
        stamp = t_ns + shift
        arrival = stamp + constants[clock]
        if not span_ns[0] - MARGIN_NS <= arrival <= span_ns[1] + MARGIN_NS:
            out.outside += 1
            continue
        out.first_ns = stamp if out.first_ns is None else min(out.first_ns, stamp)
        out.frames += 1
        writer.write_message(
            TOPIC, {"format": frame.format, "data": frame.data},
            arrival_ns=arrival, stamp_ns=stamp, clock=clock, metadata=metadata,
        )  # fmt: skip
    told = (
        (out.undecodable, "cannot be decoded and were left out"),
        (out.untimed, "have no time and were left out"),
        (out.outside, "lie outside the flight's time and were left out"),
    )
    out.problems = [f"{n} frames of the camera {what}" for n, what in told if n]
    return out


def _pictures(folder: Path) -> Iterator[Frame]:
    found = sorted(p for p in folder.iterdir() if p.suffix.lower() in PICTURES)
    if not found:
        raise LogError(folder, "holds no pictures", "give a folder of .jpg or .png files, or a video")
    for number, path in enumerate(found):
        data = path.read_bytes()
        good = data.startswith((_JPEG, _PNG)) and size_of(data) is not None
        yield Frame(number, path.name, None, data if good else None)


def _jpeg(picture: Any) -> bytes | None:
    import cv2

    how = [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY]
    how += [cv2.IMWRITE_JPEG_SAMPLING_FACTOR, cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444]
    done, data = cv2.imencode(".jpg", np.ascontiguousarray(picture), how)
    return bytes(data) if done else None


def _not_opened(path: Path) -> LogError:
    return LogError(path, "cannot be opened as a video", "give a video file, or a folder of pictures")


def _with_opencv(path: Path) -> Iterator[Frame]:
    import cv2

    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG)
    try:
        if not capture.isOpened():
            raise _not_opened(path)
        packed = int(capture.get(cv2.CAP_PROP_FOURCC)).to_bytes(4, "little", signed=True) == b"MJPG"
        if packed:
            packed = bool(capture.set(cv2.CAP_PROP_FORMAT, -1))
        promised, number = round(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 0
        while True:
            done, picture = capture.read()
            if not done:
                break
            t_ns = round(capture.get(cv2.CAP_PROP_POS_MSEC) * 1e6)
            data = picture.tobytes() if packed else _jpeg(picture)
            yield Frame(number, "", t_ns, _whole(data) if packed else data)
            number += 1
        # FFmpeg passes over what it cannot decode. The container says how many frames there should be, some of them
        # (by duration and rate) to within one.
        if number + 1 < promised < 10 * number + 1000:
            yield from (Frame(missing, "", None, None) for missing in range(number, promised))
    finally:
        capture.release()


def _whole(data: bytes | None) -> bytes | None:
    """Return a JPEG file if it can be decoded."""
    return data if data and data.startswith(_JPEG) and size_of(data) is not None else None


def _with_av(path: Path) -> Iterator[Frame]:
    import av

    try:
        container = av.open(str(path))
    except (av.error.FFmpegError, OSError, ValueError):
        raise _not_opened(path) from None
    with container:
        if not container.streams.video:
            raise _not_opened(path)
        stream, number = container.streams.video[0], 0
        begin = stream.start_time or 0
        for packet in container.demux(stream):
            t_ns = _ns(packet.pts, begin, stream.time_base)
            if stream.codec_context.name == "mjpeg":
                if packet.size:
                    yield Frame(number, "", t_ns, _whole(bytes(packet)))
                    number += 1
                continue
            try:
                pictures = packet.decode()
            except av.error.FFmpegError:
                yield Frame(number, "", t_ns, None)
                number += 1
                continue
            for picture in pictures:
                shown = _ns(picture.pts, begin, stream.time_base)
                yield Frame(number, "", shown, _jpeg(picture.to_ndarray(format="bgr24")))
                number += 1


def _ns(pts: int | None, begin: int, time_base: Fraction | None) -> int | None:
    if pts is None or time_base is None:
        return None
    return round((pts - begin) * time_base * 1_000_000_000)

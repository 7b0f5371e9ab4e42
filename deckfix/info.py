"""``deckfix info``: what a log holds."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deckfix.files import existing
from deckfix.streams import stream
from deckfix.terminal import printable, working
from estimation.events import Kind

if TYPE_CHECKING:
    from logs.channels import ChannelInfo
    from logs.reader import Flight
    from vision.camera import Camera
    from vision.target import RingTarget


def describe(path: str | Path) -> str:
    """Return a description of a log for a person; raises ``logs.errors.LogError``."""
    from logs.reader import open_flight

    place = existing(path)
    with working(f"reading {place.name}"):
        flight = open_flight(place)
        topics = flight.topics
        flight.verify()
    spans = [(i.first_ns, i.last_ns) for infos in topics.values() for i in infos]
    first = min((f for f, _ in spans if f is not None), default=None)
    last = max((s for _, s in spans if s is not None), default=None)
    lines = [f"{place}: {place.stat().st_size / 1e6:.1f} MB, MCAP profile {flight.profile or 'none'}"]
    if first is not None and last is not None:
        lines.append(f"{_utc(first)} to {_utc(last)} UTC, {(last - first) * 1e-9:.1f} s")
    lines += ["", f"{'topic':<28} {'messages':>9} {'rate':>9} {'gaps':>5}  type"]
    for topic, infos in sorted(topics.items()):
        for info in infos:
            rate = _rate_hz(info)
            shown = f"{rate:.1f} Hz" if rate else ""
            gaps = _gaps(flight, topic) if len(infos) == 1 else ""
            kind = info.message_type or info.message_encoding
            lines.append(f"{topic:<28} {info.count:>9,} {shown:>9} {gaps:>5}  {kind} ({info.clock})")
    lines += _camera(flight)
    offsets = flight.clock_offsets_ns
    if offsets:
        lines += ["", "clocks (constant that takes their stamps to UTC)"]
        lines += [f"  {clock}: {offset} ns" for clock, offset in sorted(offsets.items())]
    for name, entries in sorted(flight.metadata.items()):
        lines += ["", f"{name}"] + [f"  {k}: {_short(v)}" for k, v in sorted(entries.items())]
    if flight.attachments:
        lines += ["", "attachments"]
        lines += [
            f"  {n} ({kind}, {len(data):,} bytes)" for n, (kind, data) in sorted(flight.attachments.items())
        ]
    lines += [
        "",
        *(["problems", *(f"  {p}" for p in flight.problems)] if flight.problems else ["no problems found"]),
    ]
    return "\n".join(printable(line) for line in lines)


def _camera(flight: Flight) -> list[str]:
    """Return lines on images, camera and target, where the log has any of them."""
    from deckfix.files import InputError
    from deckfix.log_images import camera_of, target_of
    from logs.images import count, first_size

    def told(made: Callable[[Flight], Any], words: Callable[[Any], str], absent: str) -> str:
        try:
            found = made(flight)
        except InputError as error:
            return f"cannot be used ({error})"
        return absent if found is None else words(found)

    frames = count(flight)
    camera = told(camera_of, _camera_words, "none: its images cannot be looked at")
    target = told(target_of, _target_words, "none: its images cannot be looked at")
    lines = []
    if frames:
        size = first_size(flight)
        shown = f"{size[0]} x {size[1]} pixels" if size else "the first cannot be decoded"
        lines.append(f"  images: {frames:,}, {shown}")
    for name, words in (("camera", camera), ("target", target)):
        if frames or not words.startswith("none"):
            lines.append(f"  {name}: {words}")
    return ["", "camera", *lines] if lines else []


def _camera_words(camera: Camera) -> str:
    lens = "with lens distortion" if camera.distortion else "without lens distortion"
    return (
        f"{camera.width} x {camera.height} pixels, {np.degrees(camera.hfov_rad):.1f} deg wide, {lens}, "
        f"read out in {camera.readout_s * 1e3:.1f} ms"
    )


def _target_words(target: RingTarget) -> str:
    return f"{target.name or 'rings'}, {target.diameter_m:g} m across, {len(target.edges_m)} edges"


def _rate_hz(info: ChannelInfo) -> float | None:
    if info.count < 2 or info.first_ns is None or info.last_ns is None or info.last_ns <= info.first_ns:
        return None
    return (info.count - 1) / (info.last_ns - info.first_ns) * 1e9


def _gaps(flight: Flight, topic: str) -> str:
    """Return the number of gaps in a sensor's or reference's stamps; nothing for other topics."""
    from logs.events import EVENT_TOPICS

    if topic not in EVENT_TOPICS and not topic.startswith(("/truth/", "/autopilot/")):
        return ""
    stamps = [s.stamp_ns for s in flight.series(topic)]
    return str(len(stream(topic, Kind.USER, np.concatenate(stamps)).gaps)) if stamps else ""


def _utc(t_ns: int) -> str:
    try:
        return datetime.fromtimestamp(t_ns * 1e-9, UTC).strftime("%Y-%m-%d %H:%M:%S")
    except (OverflowError, ValueError, OSError):
        return f"{t_ns} ns"


def _short(value: str, longest: int = 100) -> str:
    return value if len(value) <= longest else f"{value[:longest]} ... ({len(value):,} characters)"

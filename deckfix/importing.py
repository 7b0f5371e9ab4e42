"""The commands ``import`` and ``recover``: other files in, one sound MCAP log out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from deckfix.files import InputError, existing, output_file
from deckfix.terminal import printable, working

if TYPE_CHECKING:
    from deckfix.video_import import Extras
    from logs.recording import Recording
    from logs.writer import FlightWriter


def import_flight(
    files: Sequence[str | Path],
    output: str | Path,
    *,
    system: int | None = None,
    extras: Extras | None = None,
    force: bool = False,
) -> str:
    """Write the log of one flight from its files, and return what there is to say.

    With ``extras`` one MCAP log will do as the flight: it is copied, without estimates made of it before.
    Raises ``logs.errors.LogError`` for files that cannot be read, ``deckfix.files.InputError`` for the extras,
    ``deckfix.files.OutputError`` for the output.
    """
    from logs.importer import import_files, is_mcap
    from logs.writer import FlightWriter

    paths = [existing(f) for f in files]
    inputs = [*paths, *(extras.inputs if extras else [])]
    if extras is not None and extras.video is not None:
        extras.times()  # says what is wrong with them before anything is read
    with output_file(output, force=force, inputs=inputs) as partial:
        if extras is not None and len(paths) == 1 and is_mcap(paths[0]):
            with working(f"copying {paths[0].name}"):
                lines, problems = _added_to(paths[0], partial, extras)
        else:
            with working(f"importing {', '.join(p.name for p in paths)}"):
                recording = import_files(paths, system)
            with working(f"writing {Path(output).name}"), FlightWriter(partial, force=True) as writer:
                writer.write_recording(recording)
                lines, problems = _imported(recording), list(recording.problems)
                if extras is not None:
                    said, more = extras.write(writer, _span_ns(recording))
                    lines, problems = [*lines, *said], problems + more
                    _add_problems(writer, more)
        size = partial.stat().st_size
    lines[0] = f"wrote {output}: {lines[0]}, {size / 1e6:.1f} MB"
    if problems:
        lines += ["problems", *(f"  {p}" for p in problems)]
    return "\n".join(printable(line) for line in lines)


def _imported(recording: Recording) -> list[str]:
    count = sum(len(s) for s in recording.series)
    topics = sorted({s.topic for s in recording.series})
    return [f"{count:,} messages in {len(topics)} topics", *(f"  {topic}" for topic in topics)]


def _span_ns(recording: Recording) -> tuple[int, int]:
    """Return the first and the last arrival, of the inertial samples where there are any."""
    series = [s for s in recording.find("/imu") if len(s)] or [s for s in recording.series if len(s)]
    return min(int(s.arrival_ns.min()) for s in series), max(int(s.arrival_ns.max()) for s in series)


def _added_to(path: Path, partial: Path, extras: Extras) -> tuple[list[str], list[str]]:
    """Write a copy of a log with the extras; return what there is to say, and the problems."""
    from deckfix.estimate_log import copy_source
    from logs.images import count
    from logs.reader import open_flight
    from logs.writer import FlightWriter

    flight = open_flight(path)
    held = count(flight)
    if held and extras.video is not None:
        raise InputError(f"{path}: holds {held} images already; import the flight's own logs with this video")
    infos = flight.topics.get("/imu") or [i for of in flight.topics.values() for i in of]
    first = [i.first_ns for i in infos if i.first_ns is not None]
    last = [i.last_ns for i in infos if i.last_ns is not None]
    if not first or not last:
        raise InputError(f"{path}: holds no messages; give the log of a flight")
    with FlightWriter(partial, force=True, clock_offsets_ns=flight.clock_offsets_ns) as writer:
        copy_source(flight, writer, attachments=tuple(extras.attachments))
        said, more = extras.write(writer, (min(first), max(last)))
        _add_problems(writer, more)
    kept = sum(i.count for of in flight.topics.values() for i in of)
    names = " and ".join(extras.attachments)
    lines = [f"{kept:,} messages of {path.name}", *(f"  {line}" for line in said)]
    return [*lines, *([f"  {names}"] if names else [])], [*flight.problems, *more]


def _add_problems(writer: FlightWriter, problems: Sequence[str]) -> None:
    from logs.writer import PROBLEMS

    if problems:
        writer.add_metadata(PROBLEMS, {f"video {i:04d}": text for i, text in enumerate(problems)})


def recover_flight(file: str | Path, output: str | Path, *, force: bool = False) -> str:
    """Copy what is readable of a damaged log, and return what was kept and what was lost."""
    from logs.recover import recover

    source = existing(file)
    with output_file(output, force=force, inputs=[source]) as partial, working(f"recovering {source.name}"):
        told = recover(source, partial, force=True)
    lines = [f"wrote {output}: {told.summary()}", *(f"  {p}" for p in told.problems)]
    return "\n".join(printable(line) for line in lines)

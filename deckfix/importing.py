"""The commands ``import`` and ``recover``: other files in, one sound MCAP log out."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from deckfix.files import existing, output_file
from deckfix.terminal import printable, working


def import_flight(
    files: Sequence[str | Path], output: str | Path, *, system: int | None = None, force: bool = False
) -> str:
    """Write the log of one flight from its files, and return what there is to say.

    Raises ``logs.errors.LogError`` for files that cannot be read, ``deckfix.files.OutputError`` for the
    output.
    """
    from logs.importer import import_files
    from logs.writer import FlightWriter

    paths = [existing(f) for f in files]
    with output_file(output, force=force, inputs=paths) as partial:
        with working(f"importing {', '.join(p.name for p in paths)}"):
            recording = import_files(paths, system)
        with working(f"writing {Path(output).name}"), FlightWriter(partial, force=True) as writer:
            writer.write_recording(recording)
        size = partial.stat().st_size
    count = sum(len(s) for s in recording.series)
    topics = sorted({s.topic for s in recording.series})
    lines = [f"wrote {output}: {count:,} messages in {len(topics)} topics, {size / 1e6:.1f} MB"]
    lines += [f"  {topic}" for topic in topics]
    if recording.problems:
        lines += ["problems", *(f"  {p}" for p in recording.problems)]
    return "\n".join(printable(line) for line in lines)


def recover_flight(file: str | Path, output: str | Path, *, force: bool = False) -> str:
    """Copy what is readable of a damaged log, and return what was kept and what was lost."""
    from logs.recover import recover

    source = existing(file)
    with output_file(output, force=force, inputs=[source]) as partial, working(f"recovering {source.name}"):
        told = recover(source, partial, force=True)
    lines = [f"wrote {output}: {told.summary()}", *(f"  {p}" for p in told.problems)]
    return "\n".join(printable(line) for line in lines)

"""The flights below a folder: which files are logs, which of them belong to one flight, and what is neither."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from deckfix.files import InputError

TELEMETRY = ".tlog"
ONBOARD = (".bin", ".log", ".ulg")
AMBIGUOUS = (".bin", ".log")
"""Endings that other programs use too: what is inside decides."""
DIGEST_ENTRY = "deckfix.files"
"""Metadata in which an imported log names the files that it was made from."""


@dataclass(frozen=True, slots=True)
class FlightFiles:
    """The files of one flight. ``name`` is the path of the first below the folder, with slashes."""

    name: str
    paths: tuple[Path, ...]

    @property
    def stamp(self) -> list[list[object]]:
        """Size and time of change of each file, by which a change is noticed."""
        out: list[list[object]] = []
        for path in self.paths:
            try:
                status = path.stat()
            except OSError:
                out.append([path.name, -1, -1])
                continue
            out.append([path.name, status.st_size, status.st_mtime_ns])
        return out


@dataclass(frozen=True, slots=True)
class Sources:
    """What a folder holds: flights in the order of their names, and (file, why) for each that was left out."""

    flights: tuple[FlightFiles, ...]
    skipped: tuple[tuple[str, str], ...]


def find_flights(folder: Path, leave_out: Path | None = None) -> Sources:
    """Return the flights below a folder, but for what lies below ``leave_out``.

    An ``.mcap`` is a flight. A ``.BIN``, ``.log`` or ``.ulg`` is one together with the ``.tlog`` beside it of the same
    name (endings apart); a ``.tlog`` without such a log is one by itself. Files that were imported into an ``.mcap``
    below the same folder are left out, as are estimates that ``replay -o`` wrote beside the log that they are of.
    Raises ``InputError`` where the folder cannot be read.
    """
    if not folder.is_dir():
        problem = (
            "is no folder; give the folder that holds the logs"
            if folder.exists()
            else "no such folder; check the path"
        )
        raise InputError(f"{folder}: {problem}")
    if not os.access(folder, os.R_OK | os.X_OK):
        raise InputError(f"{folder}: cannot be read; check its permissions")
    skipped: list[tuple[str, str]] = []
    logs: list[str] = []
    for name in _files(folder, leave_out):
        kind = PurePosixPath(name).suffix.lower()
        if kind in (".mcap", TELEMETRY, *ONBOARD):
            if kind in AMBIGUOUS and not _is_log(folder / name):
                skipped.append((name, "is no flight log, whatever its name ends in"))
            else:
                logs.append(name)
        else:
            skipped.append((name, "is no flight log"))
    imported = _imported(folder, [n for n in logs if n.lower().endswith(".mcap")], skipped)
    flights: dict[str, FlightFiles] = {}
    for names in _grouped(n for n in logs if not n.lower().endswith(".mcap")):
        paths = tuple(folder / n for n in names)
        by = next((imported[key] for p in paths if (key := _identity(p)) in imported), None)
        if by is None:
            flights[names[0]] = FlightFiles(names[0], paths)
        else:
            skipped += [(n, f"was imported into {by}, which is taken") for n in names]
    left_out = {name for name, _ in skipped}
    for name in logs:
        if name.lower().endswith(".mcap") and name not in left_out:
            flights[name] = FlightFiles(name, (folder / name,))
    return Sources(tuple(flights[n] for n in sorted(flights)), tuple(sorted(skipped)))


def _files(folder: Path, leave_out: Path | None) -> Iterator[str]:
    """Yield the files' paths below a folder, with slashes; hidden ones are none of ours."""
    apart = leave_out.resolve() if leave_out is not None else None
    for base, folders, files in os.walk(folder):
        here = Path(base)
        folders[:] = sorted(
            f for f in folders if not f.startswith(".") and (apart is None or (here / f).resolve() != apart)
        )
        for file in sorted(files):
            if not file.startswith("."):
                yield (here / file).relative_to(folder).as_posix()


def _grouped(names: Iterable[str]) -> list[list[str]]:
    """Return the files of each flight: an autopilot's log with its telemetry log, or one alone."""
    of_stem: dict[str, list[str]] = {}
    for name in names:
        of_stem.setdefault(str(PurePosixPath(name).with_suffix("")).lower(), []).append(name)
    out: list[list[str]] = []
    for group in of_stem.values():
        telemetry = [n for n in group if n.lower().endswith(TELEMETRY)]
        onboard = [n for n in group if not n.lower().endswith(TELEMETRY)]
        if len(telemetry) == len(onboard) == 1:
            out.append([*onboard, *telemetry])
        else:
            out.extend([n] for n in group)
    return out


def _is_log(path: Path) -> bool:
    from logs.errors import LogError
    from logs.importer import recognise

    try:
        if path.stat().st_size == 0:
            return True
        recognise(path)
    except LogError as error:
        # What cannot be read is not known to be foreign: it becomes a row with that error.
        return "cannot be read" in error.problem
    except OSError:
        return True
    return True


def _identity(path: Path) -> tuple[str, int]:
    try:
        return path.name, path.stat().st_size
    except OSError:
        return path.name, -1


def _imported(folder: Path, names: list[str], skipped: list[tuple[str, str]]) -> dict[tuple[str, int], str]:
    """Return which MCAP log each source file (name, size) went into, noting logs that are the estimates of another.

    The estimates of a log hold the same metadata and inertial samples as the log itself.
    """
    from deckfix.estimate_log import SOFTWARE
    from logs.errors import LogError
    from logs.reader import open_flight

    originals: dict[object, str] = {}
    estimates: list[tuple[object, str]] = []
    out: dict[tuple[str, int], str] = {}
    for name in names:
        try:
            flight = open_flight(folder / name)
            imu = tuple((c.count, c.first_ns, c.last_ns) for c in flight.topics.get("/imu", []))
        except (LogError, OSError):
            continue
        others = sorted((k, sorted(v.items())) for k, v in flight.metadata.items() if k != SOFTWARE)
        identity = repr((others, imu))
        if SOFTWARE in flight.metadata:
            estimates.append((identity, name))
        else:
            originals.setdefault(identity, name)
        for text in flight.metadata.get(DIGEST_ENTRY, {}).values():
            out.setdefault(_source_file(text), name)
    for key, name in estimates:
        if key in originals:
            skipped.append((name, f"holds the estimates of {originals[key]}, which is taken"))
    gone = {name for name, _ in skipped}
    return {key: name for key, name in out.items() if name not in gone}


def _source_file(text: str) -> tuple[str, int]:
    """Return name and size from an entry ``NAME (KIND, SIZE bytes, sha256 ...)``."""
    name, _, rest = text.rpartition(" (")
    size = next((p.split()[0] for p in rest.split(", ") if p.endswith(" bytes")), "")
    return name, int(size) if size.isdigit() else -1

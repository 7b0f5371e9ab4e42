"""Logs of autopilots to one recording: what each file is, is told by its content."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path

from logs.ardupilot import import_dataflash
from logs.dataflash import is_dataflash
from logs.dataflash_text import is_dataflash_text
from logs.errors import LogError
from logs.mavlink import import_telemetry
from logs.merge import merge
from logs.px4 import MAGIC, import_ulog
from logs.recording import Recording
from logs.review import drop_unstorable, review
from logs.tlog import is_telemetry

DATAFLASH = "ArduPilot dataflash log"
TELEMETRY = "MAVLink telemetry log"
ULOG = "PX4 log"

_MCAP = b"\x89MCAP0\r\n"
_HEAD = 1 << 20


def import_files(paths: Sequence[str | Path], system: int | None = None) -> Recording:
    """Read one flight: an autopilot's log (.BIN, .log, .ulg), its telemetry log (.tlog), or both.

    ``system`` chooses the vehicle in a telemetry log that holds several. Sentences about what was damaged,
    left out or is missing are in the recording's ``problems``; the files, with their sizes and SHA-256, in
    its metadata ``deckfix.files``.

    Raises LogError when a file cannot be read or is no such log, when there are two of a kind, or when the
    files are not of one flight.
    """
    files = [Path(p) for p in paths]
    if not files:
        raise LogError("import", "no file was given", "name at least one log")
    kinds = [recognise(p) for p in files]
    onboard = [p for p, k in zip(files, kinds, strict=True) if k != TELEMETRY]
    telemetry = [p for p, k in zip(files, kinds, strict=True) if k == TELEMETRY]
    for several in (onboard, telemetry):
        if len(several) > 1:
            names = " and ".join(p.name for p in several)
            raise LogError(
                names,
                "these are logs of the same kind, which are not joined",
                "import them one by one, or give one autopilot's log and one telemetry log of a flight",
            )
    parts = [
        _read(p, k, system)
        for p, k in sorted(zip(files, kinds, strict=True), key=lambda f: f[1] == TELEMETRY)
    ]
    out = parts[0]
    if len(parts) == 2:
        out = merge(parts[0], parts[1], (onboard[0].name, telemetry[0].name))
    drop_unstorable(out)
    if not any(len(s) for s in out.series):
        raise LogError(files[0], "the log holds no message that can be used", "check that it is of a flight")
    out.series = [s for s in out.series if len(s)]
    out.problems += review(out)
    out.metadata["deckfix.files"] = {
        f"file{k}": f"{path.name} ({kind}, {path.stat().st_size} bytes, sha256 {_digest(path)})"
        for k, (path, kind) in enumerate(zip(files, kinds, strict=True), start=1)
    }
    return out


def is_mcap(path: Path) -> bool:
    """Tell whether a file is a log as deckfix writes it, or another MCAP file."""
    with path.open("rb") as file:
        return file.read(len(_MCAP)) == _MCAP


def recognise(path: Path) -> str:
    """Return what kind of log a file is, by its content.

    Raises LogError when it cannot be read, is empty or is nothing that can be imported.
    """
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD)
    except FileNotFoundError:
        raise LogError(path, "there is no such file", "check the name") from None
    except IsADirectoryError:
        raise LogError(path, "this is a folder", "name the log in it") from None
    except OSError as error:
        raise LogError(
            path, f"it cannot be read ({error.strerror})", "check the file's permissions"
        ) from None
    if not head:
        raise LogError(path, "the file is empty", "copy the log again")
    if head.startswith(_MCAP):
        raise LogError(path, "this is an MCAP file already", "use it as it is: deckfix replay FILE")
    if head.startswith(MAGIC):
        return ULOG
    if is_dataflash(head):
        return DATAFLASH
    if is_telemetry(head):
        return TELEMETRY
    if is_dataflash_text(head):
        return DATAFLASH
    raise LogError(
        path,
        "this is no log that can be imported",
        "give an ArduPilot .BIN or .log, a MAVLink .tlog or a PX4 .ulg",
    )


def _read(path: Path, kind: str, system: int | None) -> Recording:
    try:
        if kind == DATAFLASH:
            return import_dataflash(path)
        if kind == ULOG:
            return import_ulog(path)
        return import_telemetry(path, system)
    except OSError as error:
        raise LogError(path, f"it cannot be read ({error.strerror})", "check the file") from None


def _digest(path: Path) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()

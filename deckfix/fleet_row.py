"""One flight of a fleet to one row: replayed, judged, and its report written."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deckfix.fleet_sources import FlightFiles
from deckfix.result import Result

if TYPE_CHECKING:
    from estimation.estimator import EngineName
    from logs.reader import Flight

Row = dict[str, Any]

AXES = {"attitude_rmse_deg": ("roll", "pitch", "yaw")}
NED = ("north", "east", "down")
CONTACT_NS = 100_000_000
"""Closing speed and place are those so long before contact, when the legs do not yet carry."""


@dataclass(frozen=True, slots=True)
class RowTask:
    """What a worker is told: the files, the configuration's TOML (None: the log's own), the report's place."""

    files: FlightFiles
    config: str | None
    engine: EngineName
    report: Path | None


def make_row(task: RowTask) -> Row:
    """Return a flight's row. A log that cannot be used gives a row with the reason; nothing is raised."""
    from estimation.config import ConfigError
    from logs.errors import LogError

    row: Row = {"flight": task.files.name, "files": " ".join(p.name for p in task.files.paths)}
    try:
        return row | _replayed(task)
    except (LogError, ConfigError) as error:
        reason = str(error)
    except OSError as error:
        reason = f"{error.filename or task.files.name}: {error.strerror or type(error).__name__}"
    except MemoryError:
        reason = "out of memory; use fewer jobs, or a machine with more"
    except Exception as error:
        # One log must not end the others' run; the report of such an error is the row.
        reason = f"internal error ({type(error).__name__}: {error})"
    return row | {"status": "error", "error": " ".join(reason.split())}


def _replayed(task: RowTask) -> Row:
    from deckfix.commands import write_text
    from deckfix.replaying import replay
    from estimation.config import parse_config

    config = None if task.config is None else parse_config(task.config)
    with tempfile.TemporaryDirectory(prefix="deckfix-") as scratch:
        flight, remarks = _opened(task.files, Path(scratch))
        result = replay(flight, config, task.engine, jobs=1)
        row = row_of(result, remarks)
        if task.report is not None:
            task.report.parent.mkdir(parents=True, exist_ok=True)
            write_text(task.report, result.report(), force=True)
    return row


def _opened(files: FlightFiles, scratch: Path) -> tuple[Flight, list[str]]:
    """Return the log of a flight, imported where it must be, and what was odd about that."""
    from logs.errors import LogError
    from logs.importer import import_files
    from logs.reader import open_flight
    from logs.writer import FlightWriter

    lead = files.paths[0]
    if lead.suffix.lower() == ".mcap":
        return open_flight(lead), []
    remarks: list[str] = []
    try:
        recording = import_files(files.paths)
    except LogError as error:
        if len(files.paths) == 1:
            raise
        # Equal names do not make one flight, and a broken telemetry log does not break the other.
        recording = import_files(files.paths[:1])
        remarks.append(f"{files.paths[1].name} was left out: {error.problem}")
    target = scratch / f"{lead.stem}.mcap"
    with FlightWriter(target) as writer:
        writer.write_recording(recording)
    return open_flight(target), remarks


def row_of(result: Result, remarks: list[str] | None = None) -> Row:
    """Return the row of a result: all of ``Result.summary`` that is a number or a word, by dotted names, and beside it
    the longest gaps, the landing, and what there is to warn of. Wall times are left out: equal runs give equal rows.
    """
    from deckfix.finding import Severity
    from deckfix.findings import findings, verdict

    found = findings(result)
    warnings = [*(remarks or []), *(f.symptom for f in found if f.severity > Severity.NOTE)]
    summary = {k: v for k, v in result.summary().items() if k not in ("flight", "wall_s", "duration_s")}
    row: Row = {
        "status": "ok" if len(result.run.t_ns) else "no estimate",
        "verdict": verdict(result, found),
        "serious": sum(f.severity is Severity.SERIOUS for f in found),
        "warnings": len(warnings),
        "warning_texts": "; ".join(warnings),
        "log_problems": "; ".join(result.problems[:20]),
        "duration_s": result.duration_s,
        "estimates": len(result.run.t_ns),
    }
    row |= dict(_flat(summary, ""))
    row |= {f"events.{s.name}.longest_gap_s": s.longest_gap_s for s in result.streams}
    row |= landing(result)
    return {k: float(f"{v:.9g}") if isinstance(v, float) else v for k, v in row.items()}


def landing(result: Result) -> Row:
    """Return how the landing went: from the truth where there is one, and the log's own last landing mode."""
    row: Row = {}
    if result.source is not None and "/landing/mode" in result.source.topics:
        row["landing.last_mode"] = _last_mode(result.source)
    truth = result.truth
    if truth is None:
        return row
    contact = result.judged.contact_ns
    row["landing.contact"] = contact is not None
    if contact is None:
        return row
    row["landing.contact_s"] = result.seconds(contact)
    at = np.array([contact - CONTACT_NS])
    deck = result.platform
    speed = truth.velocity_mps.at(at)[0] if truth.velocity_mps else np.full(3, np.nan)
    if deck is None:
        row["landing.down_mps"] = float(speed[2])
        return row
    if deck.velocity_mps:
        row["landing.closing_mps"] = float(speed[2] - deck.velocity_mps.at(at)[0, 2])
    if deck.position_m and truth.position_m:
        miss = truth.position_m.at(at)[0, :2] - deck.position_m.at(at)[0, :2]
        row["landing.miss_m"] = float(np.hypot(*miss))
    return row


def _last_mode(flight: Flight) -> str:
    from estimation.modes import Mode
    from logs.errors import LogError

    last = ""
    for message in flight.messages(["/landing/mode"]):
        try:
            last = Mode(int(message.decoded.mode)).name.lower()
        except (LogError, ValueError):
            continue
    return last


def _flat(value: Mapping[str, Any], prefix: str) -> Iterator[tuple[str, Any]]:
    for key, inner in value.items():
        name = prefix + str(key)
        if isinstance(inner, Mapping):
            yield from _flat(inner, f"{name}.")
        elif isinstance(inner, list | tuple):
            if "_rmse_" in str(key) and len(inner) == 3:
                yield from ((f"{name}.{a}", v) for a, v in zip(AXES.get(str(key), NED), inner, strict=True))
        elif isinstance(inner, np.generic):
            yield name, inner.item()
        elif isinstance(inner, bool | int | float | str):
            yield name, inner

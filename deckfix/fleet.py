"""The command ``fleet``: every flight below a folder replayed, one row each, and a page that links the reports.

The folder of the results holds ``index.html``, ``flights.csv``, ``flights.parquet`` (where pyarrow is installed),
``reports/`` and ``rows/``, in which each row is kept as soon as its flight is done. A flight whose files, configuration
and version of deckfix are those of its row is not replayed again.
"""

from __future__ import annotations

import csv
import hashlib
import importlib.util
import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from deckfix._version import __version__
from deckfix.commands import finite, write_text
from deckfix.files import OutputError, existing, output_file, output_folder
from deckfix.fleet_page import render
from deckfix.fleet_row import Row, RowTask, make_row
from deckfix.fleet_sources import FlightFiles, find_flights
from deckfix.parallel import WorkerLost, Workers
from deckfix.terminal import printable, tracked

if TYPE_CHECKING:
    from estimation.estimator import EngineName

LEADING = (
    "flight",
    "files",
    "status",
    "error",
    "verdict",
    "serious",
    "warnings",
    "warning_texts",
    "log_problems",
    "duration_s",
)
LEADING_SECTIONS = ("estimates", "engine", "landing", "truth", "ratio", "heave", "nis", "fusion", "events")
ROWS = "rows"


@dataclass(frozen=True, slots=True)
class FleetOptions:
    """How a fleet is replayed: ``config`` is a path (None: each log's own, or else the default)."""

    config: str | None = None
    engine: EngineName = "auto"
    reports: bool = True
    jobs: int | None = None
    scheduler: str | None = None
    force: bool = False


def run_fleet(folder: str | Path, output: str | Path, options: FleetOptions) -> str:
    """Replay every flight below a folder, write the tables, the page and the reports, and return what to show.

    Raises ``InputError`` for a folder without flights or a scheduler that does not answer, ``OutputError`` where the
    results may not be written, ``estimation.config.ConfigError`` for the configuration.
    """
    from deckfix.files import InputError

    config = _config_text(options.config)
    sources = find_flights(Path(folder), Path(output))
    if not sources.flights:
        raise InputError(
            f"{folder}: holds no flight log; give a folder with .mcap, .BIN, .log, .tlog or .ulg files"
        )
    target = _results_folder(Path(output), options.force)
    engine = _engine(options.engine)
    keys = {f.name: _key(f, config, engine, options.reports) for f in sources.flights}
    rows: dict[str, Row] = {}
    todo: list[FlightFiles] = []
    for flight in sources.flights:
        kept = None if options.force else _kept(target, flight, keys[flight.name], options.reports)
        if kept is None:
            todo.append(flight)
        else:
            rows[flight.name] = kept
    tasks = [
        RowTask(f, config, engine, _report_path(target, f.name).resolve() if options.reports else None)
        for f in todo
    ]
    if tasks:
        with Workers(options.jobs, options.scheduler) as workers:
            done = workers.each(make_row, tasks)
            for index, answer in tracked(done, "replaying", len(tasks)):
                flight = todo[index]
                if isinstance(answer, WorkerLost):
                    rows[flight.name] = _lost(flight, answer)
                    continue
                rows[flight.name] = finite(answer)
                _keep(target, flight, keys[flight.name], rows[flight.name])
    ordered = [rows[f.name] for f in sources.flights]
    written = write_tables(ordered, target)
    links = {
        f.name: quote(_report_path(target, f.name).relative_to(target).as_posix())
        for f in sources.flights
        if _report_path(target, f.name).is_file() and rows[f.name].get("status") != "error"
    }
    write_text(
        target / "index.html",
        render(Path(folder).resolve().name, ordered, links, sources.skipped),
        force=True,
    )
    return _told(ordered, sources.skipped, len(todo), [*written, target / "index.html"])


def _config_text(path: str | None) -> str | None:
    if path is None:
        return None
    from estimation.config import dump_config, load_config

    return dump_config(load_config(existing(path)))


def _engine(name: EngineName) -> EngineName:
    """Return the engine by its own name, since rows of another engine are not the same run."""
    if name != "auto":
        return name
    return "compiled" if importlib.util.find_spec("numba") else "filterpy"


def _results_folder(path: Path, force: bool) -> Path:
    target = output_folder(path)
    own = (target / ROWS).is_dir()
    for name in ("index.html", "flights.csv", "flights.parquet"):
        if (target / name).exists() and not own and not force:
            raise OutputError(
                f"{target / name}: exists already and is of no fleet; use --force to overwrite it"
            )
    output_folder(target / ROWS)
    return target


def _key(flight: FlightFiles, config: str | None, engine: str, reports: bool) -> str:
    told = json.dumps([__version__, engine, config, flight.name, flight.stamp, reports])
    return hashlib.sha256(told.encode()).hexdigest()


def _file_name(name: str) -> str:
    """Return a name for a flight's row and report, under which no other flight's lies, on any file system."""
    plain = "".join(c if c.isalnum() or c in "-_." else "_" for c in name.replace("/", "__"))
    return (
        f"{plain[:80].lstrip('.')}-{hashlib.sha256(name.encode('utf-8', 'surrogateescape')).hexdigest()[:8]}"
    )


def _report_path(target: Path, name: str) -> Path:
    return target / "reports" / f"{_file_name(name)}.html"


def _row_path(target: Path, name: str) -> Path:
    return target / ROWS / f"{_file_name(name)}.json"


def _kept(target: Path, flight: FlightFiles, key: str, reports: bool) -> Row | None:
    """Return the row of an earlier run, or None where there is none or anything has changed since."""
    try:
        kept = json.loads(_row_path(target, flight.name).read_text(encoding="utf-8"))
        row: Row = kept["row"]
        usable = kept["key"] == key and isinstance(row, dict)
    except (OSError, ValueError, KeyError, TypeError):
        return None
    if usable and reports and row.get("status") != "error":
        usable = _report_path(target, flight.name).is_file()
    return row if usable else None


def _keep(target: Path, flight: FlightFiles, key: str, row: Row) -> None:
    text = json.dumps({"key": key, "row": row}, indent=1, sort_keys=True)
    write_text(_row_path(target, flight.name), text + "\n", force=True)


def _lost(flight: FlightFiles, why: WorkerLost) -> Row:
    """Return the row of a flight that no worker survived; it is not kept, since it may be memory that was short."""
    files = " ".join(p.name for p in flight.paths)
    return {"flight": flight.name, "files": files, "status": "error", "error": f"{flight.name}: {why}"}


def columns_of(rows: list[Row]) -> list[str]:
    """Return the columns of a table: what leads, then by section and name; the same in whatever order rows came."""
    names = {name for row in rows for name in row}

    def place(name: str) -> tuple[int, int, str]:
        if name in LEADING:
            return 0, LEADING.index(name), name
        section = name.split(".", 1)[0]
        known = section in LEADING_SECTIONS
        return 1, LEADING_SECTIONS.index(section) if known else len(LEADING_SECTIONS), name

    return sorted(names | set(LEADING), key=place)


def write_tables(rows: list[Row], target: Path) -> list[Path]:
    """Write ``flights.csv``, and ``flights.parquet`` where pyarrow is installed; return their paths."""
    columns = columns_of(rows)
    table = target / "flights.csv"
    with (
        output_file(table, force=True) as partial,
        partial.open("w", encoding="utf-8", errors="replace", newline="") as file,
    ):
        writer = csv.writer(file)
        writer.writerow(columns)
        writer.writerows(["" if row.get(c) is None else row[c] for c in columns] for row in rows)
    written = [table]
    if importlib.util.find_spec("pyarrow"):
        import pyarrow
        import pyarrow.parquet

        data = {c: _typed([row.get(c) for row in rows]) for c in columns}
        with output_file(target / "flights.parquet", force=True) as partial:
            pyarrow.parquet.write_table(pyarrow.table(data), partial)
        written.append(target / "flights.parquet")
    return written


def _typed(values: list[Any]) -> list[Any]:
    """Return a column of one type: words where any value is one, else decimals where any is one."""
    present = [v for v in values if v is not None]
    if any(isinstance(v, str) for v in present):
        return [None if v is None else str(v).encode("utf-8", "replace").decode() for v in values]
    if any(isinstance(v, float) for v in present):
        return [None if v is None else float(v) for v in values]
    return values


def _told(rows: list[Row], skipped: tuple[tuple[str, str], ...], new: int, written: list[Path]) -> str:
    failed = [r for r in rows if r["status"] == "error"]
    waiting = sum(r["status"] == "no estimate" for r in rows)
    look = sum(r["status"] == "ok" and bool(r["warnings"]) for r in rows)
    lines = [
        f"{_count(len(rows), 'flight')}: {len(rows) - len(failed) - waiting - look} without warnings, {look} with "
        f"warnings, {waiting} without an estimate, {len(failed)} that cannot be used; {new} replayed, "
        f"{len(rows) - new} unchanged"
    ]
    lines += [f"  {r['error']}" for r in failed]
    lines += [f"  left out {name}: {why}" for name, why in skipped[:20]]
    if len(skipped) > 20:
        lines.append(f"  left out {len(skipped) - 20} further files; the page lists all of them")
    lines += [f"wrote {p}" for p in written]
    return "\n".join(printable(line) for line in lines)


def _count(n: int, noun: str) -> str:
    return f"{n} {noun}" + ("" if n == 1 else "s")

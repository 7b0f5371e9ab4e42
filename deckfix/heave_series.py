"""A heave series from a text file: time, heave and, where given, its sigma, in columns that are found by name.

Delimiters are commas, semicolons, tabs or blanks; lines that begin with # or % are comments; ``.gz`` is read as it is.
A unit stands in brackets behind a name or as its suffix: ``Heave [cm]``, ``time_ms``. What is no number is a gap.
"""

from __future__ import annotations

import gzip
import math
import re
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from deckfix.files import InputError, existing

Array = NDArray[np.float64]

TIMES = (
    "time",
    "t",
    "seconds",
    "sec",
    "boot_time",
    "elapsed",
    "timestamp",
    "stamp",
    "date",
    "datetime",
    "utc",
)
HEAVES = ("heave", "deck_up", "z", "elevation", "surface_elevation", "displacement", "height", "up")
SIGMAS = ("sigma", "heave_sigma", "std", "sd", "stddev", "uncertainty", "error")
LENGTHS = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "ft": 0.3048}
DURATIONS = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
SHARE_OF_SD = 0.02
SMALLEST_SIGMA_M = 1e-4
"""Sigma where none is given: 2 % of the scatter, at least 0.1 mm. The fit finds the real noise above it."""
MOST_BYTES = 1 << 29
_MISSING = {"", "nan", "na", "n/a", "null", "none", "-", "inf", "-inf"}


@dataclass(frozen=True, slots=True)
class HeaveSeries:
    """A series, oldest first: ``t_s`` (n,), ``heave_m`` (n,) up with NaN as gaps, ``sigma_m`` (n,).

    ``given_sigma`` is False where the sigma was assumed; ``columns`` says in words what was read as what.
    """

    name: str
    t_s: Array
    heave_m: Array
    sigma_m: Array
    given_sigma: bool
    columns: str

    @property
    def span_s(self) -> float:
        """Time from the first to the last sample [s]."""
        return float(self.t_s[-1] - self.t_s[0])

    @property
    def interval_s(self) -> float:
        """Median interval of the samples [s]; 0 where there is but one time."""
        steps = np.diff(self.t_s)
        steps = steps[steps > 0]
        return float(np.median(steps)) if len(steps) else 0.0

    @property
    def gaps(self) -> list[float]:
        """Lengths [s] of the stretches without a finite sample, of more than five intervals."""
        t = self.t_s[np.isfinite(self.heave_m)]
        steps = np.diff(t)
        return [float(s) for s in steps[steps > 5.0 * self.interval_s]] if self.interval_s > 0 else []


@dataclass(frozen=True, slots=True)
class Choice:
    """What the user says of a file: columns by name or number (from 1), rate where there is no time, units, sigma."""

    time: str | None = None
    heave: str | None = None
    sigma: str | None = None
    rate_hz: float | None = None
    unit: str | None = None


def read_series(path: str | Path, choice: Choice | None = None) -> HeaveSeries:
    """Return the series in a text file; raises ``InputError`` with the file, the problem and the remedy."""
    choice = choice or Choice()
    place = existing(path)
    lines = _lines(place)
    if not lines:
        raise InputError(f"{path}: holds no line of numbers; give a CSV file with time and heave")
    delimiter = _delimiter(lines[0])
    rows = [_split(line, delimiter) for line in lines]
    header = rows[0] if any(not _is_number(cell) for cell in rows[0]) and not _is_data(rows[0]) else None
    body = rows[1:] if header is not None else rows
    if not body:
        raise InputError(f"{path}: holds a header, but no sample; give a CSV file with time and heave")
    width = max(len(r) for r in body)
    names = header if header is not None else []
    heave_at = _column(path, choice.heave, names, width, HEAVES, "heave")
    time_at = None if choice.rate_hz else _column(path, choice.time, names, width, TIMES, "time")
    if heave_at is None or (time_at is None and not choice.rate_hz):
        heave_at, time_at = _by_place(path, names, width, heave_at, time_at, choice)
    sigma_at, sigma = _sigma(path, choice, names, width, {heave_at, time_at})
    scale = _unit(path, choice.unit, names, heave_at)
    decimal_comma = delimiter == ";" and any("," in cell for cell in body[0])
    heave = scale * _numbers(body, heave_at, decimal_comma)
    if choice.rate_hz:
        t = np.arange(len(body)) / choice.rate_hz
    else:
        assert time_at is not None
        t = _times(body, time_at, decimal_comma) * _duration(names, time_at)
    if sigma_at is not None:
        own = _numbers(body, sigma_at, decimal_comma) * _unit(path, choice.unit, names, sigma_at)
        own = np.where(own > 0, own, np.nan)
    else:
        own = np.full(len(t), np.nan if sigma is None else sigma)
    return _checked(
        place, t, heave, own, sigma_at is not None or sigma is not None, _told(names, heave_at, time_at)
    )


def _checked(place: Path, t: Array, heave: Array, sigma: Array, given: bool, columns: str) -> HeaveSeries:
    """Return the series in order of time; raises ``InputError`` where it cannot be used."""
    known = np.isfinite(t)
    if not known.any() or not np.isfinite(heave[known]).any():
        raise InputError(
            f"{place}: no row has a finite time and heave ({columns}); name the columns with --time and --heave"
        )
    t, heave, sigma = t[known], heave[known], sigma[known]
    if np.any(np.diff(t) < 0):
        back = int(np.argmax(np.diff(t) < 0))
        raise InputError(
            f"{place}: time goes back from {t[back]:g} s to {t[back + 1]:g} s ({columns}); sort the rows by time, or "
            "name the column of the time with --time"
        )
    if not given:
        scatter = float(np.nanstd(heave))
        sigma = np.full(len(t), max(SHARE_OF_SD * scatter, SMALLEST_SIGMA_M))
    return HeaveSeries(place.name, t - t[0], heave, sigma, given, columns)


def _lines(place: Path) -> list[str]:
    try:
        data = place.read_bytes()
        if data[:2] == b"\x1f\x8b":
            with gzip.open(place) as file:
                data = file.read(MOST_BYTES + 1)
    except (OSError, EOFError) as error:
        raise InputError(f"{place}: cannot be read ({error}); check the file") from None
    if len(data) > MOST_BYTES:
        raise InputError(f"{place}: is larger than {MOST_BYTES >> 20} MiB; cut it")
    if b"\x00" in data[:4096]:
        raise InputError(f"{place}: is neither an MCAP log nor text; give a flight or a CSV series")
    text = data.decode("utf-8-sig", errors="replace")
    return [line for line in text.splitlines() if line.strip() and line.lstrip()[0] not in "#%"]


def _delimiter(line: str) -> str:
    counts = {d: line.count(d) for d in (";", "\t", ",")}
    best = max(counts, key=lambda d: counts[d])
    if counts[";"]:
        return ";"
    return best if counts[best] else " "


def _split(line: str, delimiter: str) -> list[str]:
    cells = line.split() if delimiter == " " else line.split(delimiter)
    return [cell.strip().strip('"').strip() for cell in cells]


def _is_number(cell: str) -> bool:
    try:
        float(cell.replace(",", "."))
    except ValueError:
        return cell.lower() in _MISSING
    return True


def _is_data(cells: list[str]) -> bool:
    """Return whether a row with text in it is data all the same: a date, and numbers."""
    return any(_instant(c) is not None for c in cells) and sum(_is_number(c) for c in cells) >= 1


def _instant(cell: str) -> float | None:
    """Return seconds of an ISO 8601 date and time, or None."""
    if not re.match(r"\d{4}-\d\d-\d\d[T ]\d\d:\d\d", cell):
        return None
    try:
        return datetime.fromisoformat(cell).timestamp()
    except ValueError:
        return None


def _plain(name: str) -> tuple[str, str | None]:
    """Return a column's name without its unit, in lower case with underscores, and the unit."""
    match = re.match(r"^(.*?)\s*[\[(]\s*([^\])]*?)\s*[\])]\s*$", name)
    bare, unit = (match[1], match[2]) if match else (name, None)
    bare = re.sub(r"[^a-z0-9]+", "_", bare.lower()).strip("_")
    if unit is None:
        for known in (*LENGTHS, *DURATIONS):
            if bare.endswith(f"_{known}"):
                return bare[: -len(known) - 1], known
    return bare, unit


def _column(
    path: str | Path, wanted: str | None, names: list[str], width: int, known: tuple[str, ...], what: str
) -> int | None:
    """Return the index of a column: the one that is wanted, else the first known name; None where there is none."""
    bare = [_plain(name)[0] for name in names]
    if wanted is None:
        return next((bare.index(name) for name in known if name in bare), None)
    if wanted in names:
        return names.index(wanted)
    if _plain(wanted)[0] in bare:
        return bare.index(_plain(wanted)[0])
    if wanted.isdigit() and 1 <= int(wanted) <= width:
        return int(wanted) - 1
    have = ", ".join(names) if names else f"1 to {width}"
    raise InputError(f"{path}: no column {wanted!r} for the {what}; it has: {have}")


def _by_place(
    path: str | Path, names: list[str], width: int, heave_at: int | None, time_at: int | None, choice: Choice
) -> tuple[int, int | None]:
    """Return columns for what no name told: time is the first, heave the second, of two or three."""
    if choice.rate_hz:
        if width == 1:
            return 0, None
    elif not names and width in (2, 3):
        return 1 if heave_at is None else heave_at, 0 if time_at is None else time_at
    missing = "heave" if heave_at is None else "time"
    have = ", ".join(names) if names else f"columns 1 to {width}, no header"
    remedy = f"name it with --{missing}" + (" or give --rate" if missing == "time" else "")
    raise InputError(f"{path}: cannot tell which column is the {missing} ({have}); {remedy}")


def _sigma(
    path: str | Path, choice: Choice, names: list[str], width: int, taken: set[int | None]
) -> tuple[int | None, float | None]:
    """Return the column of the sigma, or its value [m]."""
    if choice.sigma is not None and choice.sigma not in names and "." in choice.sigma:
        try:
            value = float(choice.sigma)
        except ValueError:
            value = math.nan
        if not (math.isfinite(value) and value > 0):
            raise InputError(f"{path}: sigma {choice.sigma!r} is no positive number; give metres")
        return None, value
    at = _column(path, choice.sigma, names, width, SIGMAS, "sigma")
    if at is None and not names and choice.heave is None and not choice.rate_hz and width == 3:
        at = next(i for i in range(3) if i not in taken)
    return at, None


def _unit(path: str | Path, unit: str | None, names: list[str], at: int) -> float:
    """Return the metres of a column's unit."""
    if unit is None and at < len(names):
        unit = _plain(names[at])[1]
    if unit is None or unit == "":
        return 1.0
    if unit not in LENGTHS:
        raise InputError(
            f"{path}: unit {unit!r} of column {names[at]!r} is unknown; give --unit {'|'.join(LENGTHS)}"
        )
    return LENGTHS[unit]


def _duration(names: list[str], at: int) -> float:
    unit = _plain(names[at])[1] if at < len(names) else None
    return DURATIONS.get(unit or "s", 1.0)


def _numbers(rows: list[list[str]], at: int, decimal_comma: bool) -> Array:
    out = np.full(len(rows), np.nan)
    for i, row in enumerate(rows):
        if at < len(row):
            cell = row[at].replace(",", ".") if decimal_comma else row[at]
            try:
                out[i] = float(cell)
            except ValueError:
                continue
    out[~np.isfinite(out)] = np.nan
    return out


def _times(rows: list[list[str]], at: int, decimal_comma: bool) -> Array:
    """Return times as numbers, or the seconds of dates."""
    first = rows[0][at] if at < len(rows[0]) else ""
    if _instant(first) is None:
        return _numbers(rows, at, decimal_comma)
    told = [_instant(row[at]) if at < len(row) else None for row in rows]
    return np.array([math.nan if v is None else v for v in told])


def _told(names: list[str], heave_at: int, time_at: int | None) -> str:
    def name(at: int) -> str:
        return repr(names[at]) if at < len(names) else f"column {at + 1}"

    time = "no time column" if time_at is None else f"time from {name(time_at)}"
    return f"{time}, heave from {name(heave_at)}"

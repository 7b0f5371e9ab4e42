"""ArduPilot's dataflash log as text (.log), which ground stations make of the binary one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.dataflash_format import CHARACTERS, DataflashLog, Format, make_format, no_formats, read_units
from logs.errors import LogError


def is_dataflash_text(head: bytes) -> bool:
    """Say whether the first kilobytes of a file look like a text dataflash log."""
    return any(line.startswith(b"FMT, ") for line in head.splitlines())


def read_dataflash_text(path: Path) -> DataflashLog:
    """Decode a text (.log) log, whose values are scaled already.

    Lines of unknown types and lines that do not convert are counted in ``problems``. Raises LogError when
    there is no format definition or no message.
    """
    formats: dict[str, Format] = {}
    lines: dict[str, list[list[str]]] = {}
    bad = 0
    with path.open(encoding="utf-8", errors="replace") as file:
        for line in file:
            name, _, rest = line.rstrip("\r\n").partition(", ")
            if name == "FMT":
                made = _parse_format_text(rest)
                bad += made is None
                if made is not None:
                    formats[made.name] = made
            elif name in formats:
                values = rest.split(", ", len(formats[name].columns) - 1)
                if len(values) == len(formats[name].columns):
                    lines.setdefault(name, []).append(values)
                else:
                    bad += 1
            elif line.strip():
                bad += 1
    if not formats:
        raise no_formats(path)
    log = DataflashLog()
    for name, rows in lines.items():
        table, lost = _convert_text(rows, formats[name])
        bad += lost
        if len(table):
            log.tables[name], log.formats[name] = table, formats[name]
    if not log.tables:
        raise LogError(path, "no intact message found", "copy the log again")
    if bad:
        log.problems.append(f"{bad} lines of the text log could not be read and were left out")
    read_units(log)
    return log


def _parse_format_text(rest: str) -> Format | None:
    values = rest.split(", ", 4)
    if len(values) != 5 or not (values[0].strip().isdecimal() and values[1].strip().isdecimal()):
        return None
    columns = values[4].replace(" ", "")
    return make_format(int(values[0]), int(values[1]), values[2].strip(), values[3].strip(), columns)


def _convert_text(rows: list[list[str]], layout: Format) -> tuple[NDArray[np.void], int]:
    """Return the columns of text rows, and how many rows were left out because a number in them is none."""
    lost = 0
    made: list[tuple[object, ...]] = []
    for row in rows:
        try:
            made.append(tuple(_convert_value(v, c) for v, c in zip(row, layout.characters, strict=True)))
        except (ValueError, OverflowError):
            lost += 1
    dtype = layout.decoded_dtype()
    try:
        return np.array(made, dtype=dtype), lost
    except (ValueError, OverflowError):
        sound = []
        for values in made:
            try:
                sound.append(np.array([values], dtype=dtype))
            except (ValueError, OverflowError):
                lost += 1
        return (np.concatenate(sound) if sound else np.empty(0, dtype=dtype)), lost


def _convert_value(text: str, character: str) -> object:
    kind, divisor = CHARACTERS[character]
    if kind.startswith("S"):
        return text.encode("utf-8")
    if character == "a":
        values = [int(v) for v in text.strip("[] ").split()]
        return (values + [0] * 32)[:32]
    if divisor != 1.0 or kind in ("<f2", "<f4", "<f8"):
        return float(text)
    if character == "M" and not text.strip().lstrip("-").isdecimal():
        return 255  # a mode by name: the number stands in ModeNum
    return int(text)

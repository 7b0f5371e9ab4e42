"""What a dataflash log consists of: message formats, decoded tables, units.

Both forms of the log, binary and text, are described by the same FMT messages.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.errors import LogError

CHARACTERS: dict[str, tuple[str, float]] = {
    "a": ("(32,)<i2", 1.0),
    "b": ("i1", 1.0),
    "B": ("u1", 1.0),
    "c": ("<i2", 100.0),
    "C": ("<u2", 100.0),
    "d": ("<f8", 1.0),
    "e": ("<i4", 100.0),
    "E": ("<u4", 100.0),
    "f": ("<f4", 1.0),
    "g": ("<f2", 1.0),
    "h": ("<i2", 1.0),
    "H": ("<u2", 1.0),
    "i": ("<i4", 1.0),
    "I": ("<u4", 1.0),
    "L": ("<i4", 1e7),
    "M": ("u1", 1.0),
    "n": ("S4", 1.0),
    "N": ("S16", 1.0),
    "q": ("<i8", 1.0),
    "Q": ("<u8", 1.0),
    "Z": ("S64", 1.0),
}
"""A format character's stored type and the number by which its stored value is divided."""


@dataclass(frozen=True, slots=True)
class Format:
    """A message type as its FMT describes it; ``length`` [bytes] with the header, one character a column."""

    type: int
    length: int
    name: str
    characters: str
    columns: tuple[str, ...]

    def stored_dtype(self) -> np.dtype[np.void]:
        """Return the layout of the whole message, header included (which has no field)."""
        formats = [np.dtype(CHARACTERS[c][0]) for c in self.characters]
        offsets = np.cumsum([3, *(f.itemsize for f in formats)])[:-1]
        return np.dtype(
            {
                "names": list(self.columns),
                "formats": formats,
                "offsets": offsets.tolist(),
                "itemsize": self.length,
            }
        )

    def decoded_dtype(self) -> np.dtype[np.void]:
        """Return the layout of the decoded columns: scaled characters become float64."""
        pairs = [(n, CHARACTERS[c]) for n, c in zip(self.columns, self.characters, strict=True)]
        return np.dtype([(n, "<f8" if divisor != 1.0 else kind) for n, (kind, divisor) in pairs])


@dataclass(slots=True)
class DataflashLog:
    """A decoded log.

    ``tables`` maps a message's name to a structured array of its columns, in the order of the file, in the
    units of the log (degrees, metres, mGauss ...); a type that was redefined in mid-log has its other layouts
    under ``NAME#2`` and so on. ``units`` gives a name's units by column, where the log states them.
    ``problems`` says what could not be read.
    """

    tables: dict[str, NDArray[np.void]] = field(default_factory=dict)
    formats: dict[str, Format] = field(default_factory=dict)
    units: dict[str, dict[str, str]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def count(self) -> int:
        """Return the number of decoded messages."""
        return sum(len(t) for t in self.tables.values())


def make_format(kind: int, length: int, name: str, characters: str, columns: str) -> Format | None:
    """Return the format that the parts of an FMT define, or None where they contradict each other."""
    if not name.isalnum() and not name.replace("_", "").isalnum():
        return None
    if not characters or any(c not in CHARACTERS for c in characters):
        return None
    if 3 + sum(np.dtype(CHARACTERS[c][0]).itemsize for c in characters) != length:
        return None
    given = columns.split(",") if columns else []
    names: list[str] = []
    for k in range(len(characters)):
        wanted = given[k] if k < len(given) and given[k] else f"column{k}"
        names.append(wanted if wanted not in names else f"{wanted}#{k}")
    return Format(kind, length, name, characters, tuple(names))


def no_formats(path: str | Path) -> LogError:
    """Return the error for a log without any format definition."""
    return LogError(
        path,
        "no format definition (FMT) found, so nothing in it can be decoded",
        "check that it is a dataflash log and that its beginning is there",
    )


def read_units(log: DataflashLog) -> None:
    """Fill ``units`` from the UNIT, MULT and FMTU messages."""
    needed = ("UNIT", "FMTU")
    if any(n not in log.tables for n in needed):
        return
    unit_table, link = log.tables["UNIT"], log.tables["FMTU"]
    for table, column, kinds in (
        (unit_table, "Id", "iu"),
        (unit_table, "Label", "S"),
        (link, "FmtType", "iu"),
        (link, "UnitIds", "S"),
    ):
        if column not in (table.dtype.names or ()) or table.dtype[column].kind not in kinds:
            return
    labels = {
        chr(int(i) & 0x7F): text_of(t) for i, t in zip(unit_table["Id"], unit_table["Label"], strict=True)
    }
    by_type = {layout.type: name for name, layout in log.formats.items() if "#" not in name}
    for kind, ids in zip(link["FmtType"].tolist(), link["UnitIds"].tolist(), strict=True):
        name = by_type.get(kind)
        if name is not None:
            columns = log.formats[name].columns
            log.units[name] = {c: labels.get(u, "") for c, u in zip(columns, text_of(ids), strict=False)}


def text_of(value: bytes) -> str:
    """Return the text of a fixed-length field."""
    return bytes(value).split(b"\0")[0].decode("utf-8", errors="replace")

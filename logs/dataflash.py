"""ArduPilot's dataflash log as columns: every message type decoded at once into one structured array.

A binary log is a chain of messages, each ``A3 95 type`` and a payload whose layout an FMT message in the same
log has described. The chain is found in bulk: all places that look like a header are listed by NumPy, their
successors are looked up together, and Python only runs where the chain breaks (a payload that happens to hold
``A3 95``, garbage, a damaged message). Then each type is gathered as rows by one indexing operation.

The walk keeps a message when another message, or the end of the file, follows where it ends. A message that
garbage follows is kept too, unless an intact message begins inside it: then its own bytes were lost.
"""

from __future__ import annotations

import struct
from collections import Counter
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.chain import chain, gaps
from logs.dataflash_format import CHARACTERS, DataflashLog, Format, make_format, no_formats, read_units
from logs.errors import LogError

_HEADER = b"\xa3\x95"
_FMT_TYPE = 0x80
_FMT_LENGTH = 89
_BLOCK = 1 << 22


def is_dataflash(head: bytes) -> bool:
    """Say whether the first kilobytes of a file look like a binary dataflash log."""
    at = head.find(_HEADER + bytes([_FMT_TYPE]))
    return head.startswith(_HEADER) or (at >= 0 and _parse_format(head[at : at + _FMT_LENGTH]) is not None)


def read_dataflash(path: Path) -> DataflashLog:
    """Decode a binary (.BIN) log.

    Raises LogError when the file is empty or holds no format definition or no message.
    """
    if path.stat().st_size == 0:
        raise LogError(path, "the file is empty", "copy the log again")
    return decode_dataflash(np.asarray(np.memmap(path, dtype=np.uint8, mode="r")), path)


def decode_dataflash(data: NDArray[np.uint8], path: str | Path = "log") -> DataflashLog:
    """Decode the bytes (n,) of a binary log; ``path`` is named in the errors (see ``read_dataflash``)."""
    headers = _find_headers(data)
    log = DataflashLog()
    definitions = _find_definitions(data, headers)
    if not definitions:
        raise no_formats(path)
    offsets, which, layouts = _walk(data, headers, definitions, log)
    if len(offsets) == 0:
        raise LogError(path, "no intact message found", "copy the log again")
    order = np.argsort(which, kind="stable")
    bounds = np.searchsorted(which[order], np.arange(len(layouts) + 1))
    found: dict[str, list[tuple[Format, NDArray[np.void]]]] = {}
    for k, layout in enumerate(layouts):
        rows = offsets[order[bounds[k] : bounds[k + 1]]]
        if len(rows):
            found.setdefault(layout.name, []).append((layout, _decode(_gather(data, rows, layout), layout)))
    for message, parts in found.items():
        _store(log, message, parts)
    read_units(log)
    return log


def _find_headers(data: NDArray[np.uint8]) -> NDArray[np.int64]:
    """Return the positions of ``A3 95`` that have a type byte after them."""
    parts = []
    for start in range(0, len(data) - 2, _BLOCK):
        block = data[start : start + _BLOCK + 2]
        at = np.flatnonzero(block[:-2] == _HEADER[0])
        parts.append(at[block[at + 1] == _HEADER[1]] + start)
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)


def _parse_format(message: bytes) -> Format | None:
    """Return the format that an FMT message defines, or None where it is not a sound one."""
    if len(message) < _FMT_LENGTH:
        return None
    kind, length, name, characters, columns = struct.unpack("<BB4s16s64s", message[3:_FMT_LENGTH])
    try:
        texts = [t.split(b"\0")[0].decode("ascii") for t in (name, characters, columns)]
    except UnicodeDecodeError:
        return None
    return make_format(kind, length, *texts)


def _find_definitions(
    data: NDArray[np.uint8], headers: NDArray[np.int64]
) -> dict[int, list[tuple[int, Format]]]:
    """Return, for each type, where in the file each of its (different) definitions stands."""
    definitions: dict[int, list[tuple[int, Format]]] = {}
    for at in headers[data[headers + 2] == _FMT_TYPE].tolist():
        made = _parse_format(data[at : at + _FMT_LENGTH].tobytes())
        if made is None:
            continue
        known = definitions.setdefault(made.type, [])
        if not known or known[-1][1] != made:
            known.append((at, made))
    if definitions and _FMT_TYPE not in definitions:
        own = Format(_FMT_TYPE, _FMT_LENGTH, "FMT", "BBnNZ", ("Type", "Length", "Name", "Format", "Columns"))
        definitions[_FMT_TYPE] = [(0, own)]
    return definitions


def _walk(
    data: NDArray[np.uint8],
    headers: NDArray[np.int64],
    definitions: dict[int, list[tuple[int, Format]]],
    log: DataflashLog,
) -> tuple[NDArray[np.int64], NDArray[np.uint16], list[Format]]:
    """Return the offset and the layout's index of every message of the chain, and the layouts."""
    layouts = [layout for known in definitions.values() for _, layout in known]
    first = np.full(256, -1, dtype=np.int64)
    index = 0
    redefined: list[tuple[int, int]] = []
    for kind, known in definitions.items():
        first[kind] = index
        redefined += [(kind, index)] if len(known) > 1 else []
        index += len(known)
    kinds = data[headers + 2]
    which = first[kinds]
    for kind, index in redefined:
        of_kind = np.flatnonzero(kinds == kind)
        starts = [at for at, _ in definitions[kind]]
        which[of_kind] = index + np.maximum(np.searchsorted(starts, headers[of_kind], side="right") - 1, 0)
    known_type = which >= 0
    at, which = headers[known_type], which[known_type]
    if len(at) == 0:
        return at, which.astype(np.uint16), layouts
    ends = at + np.array([layout.length for layout in layouts], dtype=np.int64)[which]
    keep = chain(at, ends, len(data))
    _tell_losses(data, at[keep], ends[keep], set(definitions), log)
    own = at[keep & (data[at + 2] == _FMT_TYPE)].tolist()
    damaged = sum(_parse_format(data[k : k + _FMT_LENGTH].tobytes()) is None for k in own)
    if damaged:
        log.problems.append(
            f"{damaged} format definitions (FMT) are damaged; messages of those types are not read"
        )
    return at[keep], which[keep].astype(np.uint16), layouts


def _tell_losses(
    data: NDArray[np.uint8],
    at: NDArray[np.int64],
    ends: NDArray[np.int64],
    known: set[int],
    log: DataflashLog,
) -> None:
    """Add to the problems what lies between the messages."""
    starts, stops = gaps(at, ends, len(data))
    if len(starts) == 0:
        return
    unknown: Counter[int] = Counter()
    for start in starts[:10000].tolist():
        head = data[start : start + 3].tobytes()
        if head.startswith(_HEADER) and len(head) == 3 and head[2] not in known:
            unknown[head[2]] += 1
    lost = int((stops - starts).sum())
    if len(starts) == 1 and stops[0] == len(data):
        log.problems.append(f"the log ends within a message, whose {lost} bytes are lost")
    else:
        log.problems.append(
            f"{lost} bytes in {len(starts)} places are not readable messages and were passed over"
        )
    if unknown:
        kinds = ", ".join(str(k) for k, _ in unknown.most_common(8))
        log.problems.append(f"message types without a format definition (FMT) were passed over: {kinds}")


def _gather(data: NDArray[np.uint8], offsets: NDArray[np.int64], layout: Format) -> NDArray[np.void]:
    """Return the whole messages of one type, shape (n,), in their stored layout."""
    whole: NDArray[np.void] = np.ndarray(
        (len(data) - layout.length + 1,), dtype=f"V{layout.length}", buffer=data, strides=(1,)
    )
    return whole[offsets].view(layout.stored_dtype())


def _decode(stored: NDArray[np.void], layout: Format) -> NDArray[np.void]:
    """Return the columns of messages, scaled as the format's characters say."""
    table = np.empty(len(stored), dtype=layout.decoded_dtype())
    for name, character in zip(layout.columns, layout.characters, strict=True):
        divisor = CHARACTERS[character][1]
        if divisor == 1.0:
            table[name] = stored[name]
        else:
            np.divide(stored[name], divisor, out=table[name])
    return table


def _store(log: DataflashLog, message: str, parts: list[tuple[Format, NDArray[np.void]]]) -> None:
    """Put the tables of one name into the log; equal layouts are joined, others get a numbered name."""
    merged: list[tuple[Format, NDArray[np.void]]] = []
    for layout, table in parts:
        for k, (known, rows) in enumerate(merged):
            if known.characters == layout.characters and known.columns == layout.columns:
                merged[k] = (known, np.concatenate([rows, table]))
                break
        else:
            merged.append((layout, table))
    merged.sort(key=lambda part: -len(part[1]))
    for k, (layout, table) in enumerate(merged):
        name = message if k == 0 else f"{message}#{k + 1}"
        log.tables[name], log.formats[name] = table, layout
    if len(merged) > 1:
        log.problems.append(
            f"{message} is defined in {len(merged)} ways; only the commonest ({len(merged[0][1])} messages) "
            "is used"
        )

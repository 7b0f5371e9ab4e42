"""Columns of a channel: its raw messages gathered chunk by chunk, grouped by layout, decoded at once.

Messages of one length are compared with the layout of the first of them: bytes that are lengths or strings
must be equal, all others are numbers. Those that differ (another frame_id, another count of a sequence) make
the next group.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from logs.cdr import FRAME_ID, Layout, LayoutError, layout_of_message
from logs.chunks import gather
from logs.definition import Definition
from logs.recording import Series

_MOST_GROUPS = 64
_PADDING = 8


@dataclass(slots=True)
class Raw:
    """Undecoded messages of one channel, by the length of their data: log times, places in the file,
    bytes."""

    logs: dict[int, list[NDArray[np.int64]]] = field(default_factory=dict)
    places: dict[int, list[NDArray[np.int64]]] = field(default_factory=dict)
    data: dict[int, list[NDArray[np.void]]] = field(default_factory=dict)
    too_short: int = 0

    def add(
        self, records: bytes | memoryview, offsets: NDArray[np.int64], head: NDArray[np.void], base: int
    ) -> None:
        """Gather the messages at the offsets; ``base`` places the chunk among the others."""
        sizes = head["length"].astype(np.int64) - 22
        one_size = bool((sizes == sizes[:1]).all())
        for size in sizes[:1].tolist() if one_size else np.unique(sizes).tolist():
            chosen = slice(None) if one_size else sizes == size
            if size < 4:
                self.too_short += len(sizes[chosen])
                continue
            self.logs.setdefault(size, []).append(head["log"][chosen].astype(np.int64))
            self.places.setdefault(size, []).append(base + offsets[chosen])
            self.data.setdefault(size, []).append(gather(records, offsets[chosen], size))

    def groups(self) -> Iterable[tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.void]]]:
        """Yield log times, places and data (n,) of each length."""
        for size in self.data:
            yield (
                np.concatenate(self.logs[size]),
                np.concatenate(self.places[size]),
                np.concatenate(self.data[size]),
            )


@dataclass(slots=True)
class _Part:
    """Messages of one layout: log times, places, stamps in UTC and columns."""

    layout: Layout
    logs: NDArray[np.int64]
    places: NDArray[np.int64]
    stamps: NDArray[np.int64]
    columns: NDArray[np.void]


def decode(
    raw: Raw, definition: Definition, topic: str, metadata: Mapping[str, str], clock: str, offset_ns: int
) -> tuple[list[tuple[Series, NDArray[np.int64]]], int]:
    """Return the series of a channel, each with its messages' places, and how many messages were not decoded.

    A series holds the messages of equal strings and sequence lengths. Where there are more than 64 such
    groups, those of equal columns are joined, and strings that differ among them are left out.
    """
    parts: list[_Part] = []
    undecoded = raw.too_short
    for logs, places, data in raw.groups():
        undecoded += _split(parts, definition, logs, places, data)
    joined: dict[tuple[object, ...], list[_Part]] = {}
    many = len(parts) > _MOST_GROUPS
    for part in parts:
        strings = () if many else tuple(sorted(part.layout.strings.items()))
        joined.setdefault((part.layout.row_dtype, strings), []).append(part)
    found = []
    for group in joined.values():
        strings_of = [p.layout.strings for p in group]
        common = {k: v for k, v in strings_of[0].items() if all(s.get(k) == v for s in strings_of)}
        found.append(_series(group, topic, common, metadata, clock, offset_ns))
    found.sort(key=lambda pair: int(pair[1][0]))
    return found, undecoded


def _split(
    parts: list[_Part],
    definition: Definition,
    logs: NDArray[np.int64],
    places: NDArray[np.int64],
    data: NDArray[np.void],
) -> int:
    """Append the parts of messages of one length; return how many of them have no layout."""
    undecoded = 0
    size = data.dtype.itemsize
    while len(data):
        octets = data.view(np.uint8).reshape(len(data), size)
        try:
            found = layout_of_message(definition, octets[0].tobytes())
            same = found.matches(octets)
            fits = 0 <= size - found.dtype.itemsize < _PADDING
        except LayoutError:
            fits, same = False, np.zeros(len(data), dtype=np.bool_)
            same[0] = True
        if fits:
            chosen = octets if same.all() else octets[same]
            trimmed = np.ascontiguousarray(chosen[:, : found.dtype.itemsize]).reshape(-1)
            stamps, columns = found.unpack(trimmed.view(found.dtype))
            parts.append(_Part(found, logs[same], places[same], stamps, columns))
        else:
            undecoded += int(same.sum())
        logs, places, data = logs[~same], places[~same], data[~same]
    return undecoded


def _series(
    group: list[_Part],
    topic: str,
    strings: dict[str, str],
    metadata: Mapping[str, str],
    clock: str,
    offset_ns: int,
) -> tuple[Series, NDArray[np.int64]]:
    logs = np.concatenate([p.logs for p in group])
    places = np.concatenate([p.places for p in group])
    stamps = np.concatenate([p.stamps for p in group]) - offset_ns
    columns = np.concatenate([p.columns for p in group])
    if not group[0].layout.stamped:
        stamps = logs - offset_ns
    order = np.lexsort((places, logs))
    if not np.array_equal(order, np.arange(len(order))):
        logs, places, stamps, columns = logs[order], places[order], stamps[order], columns[order]
    frame_id = strings.pop(FRAME_ID, "")
    return Series(topic, stamps, logs, columns, clock, frame_id, strings, dict(metadata)), places

"""Telemetry logs (.tlog) as columns: MAVLink 1 and 2 frames, each after eight bytes of arrival time.

Every place that could begin a frame is checked at once: the message must be known, its length possible and
its check sum right (computed for all frames of a length together). What is left is walked as a chain, and
each message type is gathered by NumPy in the layout of pymavlink's dialect, shortened payloads filled up with
zeros.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.chain import chain, gaps
from logs.errors import LogError

Bytes = NDArray[np.uint8]
Offsets = NDArray[np.int64]

_STAMP = 8
_MAVLINK1, _MAVLINK2 = 0xFE, 0xFD
_HEADER = {_MAVLINK1: 6, _MAVLINK2: 10}
_SIGNED = 1
_SIGNATURE = 13
_BLOCK = 1 << 22
_CRC_START = 0xFFFF
_YEAR_2100_US = 4_102_444_800_000_000


@dataclass(frozen=True, slots=True)
class MessageType:
    """A MAVLink message: its layout in the order of the wire, with extensions, and its check sum's seed."""

    id: int
    name: str
    seed: int
    dtype: np.dtype[np.void]


@dataclass(frozen=True, slots=True)
class Messages:
    """Messages of one type in the order of the file.

    ``data`` (n,) in the message's own units; ``arrival_ns`` (n,) UTC as the recorder stamped them; who sent
    them.
    """

    data: NDArray[np.void]
    arrival_ns: Offsets
    system: Bytes
    component: Bytes

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.data)

    def __getitem__(self, rows: NDArray[np.bool_]) -> Messages:
        """Return the messages that a mask (n,) selects."""
        return Messages(self.data[rows], self.arrival_ns[rows], self.system[rows], self.component[rows])


@dataclass(slots=True)
class TelemetryLog:
    """The frames of a telemetry log, decoded type by type on demand."""

    raw: Bytes
    payload_at: Offsets
    payload_length: Offsets
    kind: NDArray[np.int32]
    arrival_ns: Offsets
    system: Bytes
    component: Bytes
    problems: list[str] = field(default_factory=list)

    def __len__(self) -> int:
        """Return the number of frames."""
        return len(self.kind)

    def names(self) -> dict[str, int]:
        """Return the number of messages by name."""
        known = dialect()
        kinds, counts = np.unique(self.kind, return_counts=True)
        return {known[k].name: n for k, n in zip(kinds.tolist(), counts.tolist(), strict=True)}

    def messages(self, name: str) -> Messages:
        """Return all messages of a type, possibly none. Raises KeyError for a type that the dialect lacks."""
        message = next((m for m in dialect().values() if m.name == name), None)
        if message is None:
            raise KeyError(name)
        rows = np.flatnonzero(self.kind == message.id)
        size = message.dtype.itemsize
        filled = np.zeros((len(rows), size), dtype=np.uint8)
        length = np.minimum(self.payload_length[rows], size)
        for n in np.unique(length).tolist():
            same = np.flatnonzero(length == n)
            filled[same, :n] = self.raw[self.payload_at[rows[same], np.newaxis] + np.arange(n)]
        data = filled.view(message.dtype)[:, 0] if size else np.empty(len(rows), dtype=message.dtype)
        return Messages(data, self.arrival_ns[rows], self.system[rows], self.component[rows])


def is_telemetry(head: bytes) -> bool:
    """Say whether the first bytes of a file look like a telemetry log (a stamp and a frame, twice)."""
    if len(head) < _STAMP + 8:
        return False
    raw = np.frombuffer(head, dtype=np.uint8)
    return len(_frames(raw)[0]) > 0


def read_telemetry(path: Path) -> TelemetryLog:
    """Find and check the frames of a .tlog file.

    Raises LogError when the file is empty or holds no intact frame.
    """
    raw = np.fromfile(path, dtype=np.uint8)
    if len(raw) == 0:
        raise LogError(path, "the file is empty", "copy the log again")
    return find_frames(raw, path)


def find_frames(raw: Bytes, path: str | Path = "log") -> TelemetryLog:
    """Find and check the frames in the bytes (n,) of a log; ``path`` is named in errors."""
    at, ends, kind = _frames(raw)
    keep = chain(at, ends, len(raw))
    at, ends, kind = at[keep], ends[keep], kind[keep]
    if len(at) == 0:
        raise LogError(path, "no intact MAVLink frame found", "check that it is a telemetry log (.tlog)")
    magic = raw[at + _STAMP]
    second = magic == _MAVLINK2
    begin = at + _STAMP
    microseconds = raw[at[:, np.newaxis] + np.arange(_STAMP)].view(">u8")[:, 0]
    log = TelemetryLog(
        raw=raw,
        payload_at=begin + np.where(second, _HEADER[_MAVLINK2], _HEADER[_MAVLINK1]),
        payload_length=raw[begin + 1].astype(np.int64),
        kind=kind,
        arrival_ns=np.minimum(microseconds, np.uint64(_YEAR_2100_US)).astype(np.int64) * 1000,
        system=raw[begin + np.where(second, 5, 3)],
        component=raw[begin + np.where(second, 6, 4)],
    )
    starts, stops = gaps(at, ends, len(raw))
    if len(starts) == 1 and stops[0] == len(raw):
        log.problems.append(f"the log ends within a frame, whose {stops[0] - starts[0]} bytes are lost")
    elif len(starts):
        log.problems.append(
            f"{int((stops - starts).sum())} bytes in {len(starts)} places are not readable frames (damaged, "
            "or of unknown messages) and were passed over"
        )
    return log


@lru_cache(maxsize=1)
def dialect() -> Mapping[int, MessageType]:
    """Return the messages of pymavlink's ardupilotmega dialect (which includes common) by id."""
    from pymavlink.dialects.v20 import ardupilotmega

    found = {}
    for kind, message in ardupilotmega.mavlink_map.items():
        form = message.unpacker.format
        text = form.decode() if isinstance(form, bytes) else form
        parts = re.findall(r"(\d*)([a-zA-Z])", text.lstrip("<"))
        fields = [
            (name, _dtype(int(n or 1), character))
            for name, (n, character) in zip(message.ordered_fieldnames, parts, strict=True)
        ]
        found[kind] = MessageType(kind, message.msgname, message.crc_extra, np.dtype(fields))
    return found


def _dtype(count: int, character: str) -> np.dtype[np.generic]:
    if character in "sc":
        return np.dtype(f"S{count}")
    base = np.dtype("<" + {"B": "u1", "b": "i1", "q": "i8", "Q": "u8"}.get(character, character))
    return np.dtype((base, (count,))) if count > 1 else base


def _frames(raw: Bytes) -> tuple[Offsets, Offsets, NDArray[np.int32]]:
    """Return where sound frames begin (with their stamp) and end, and their messages' ids."""
    candidates = _candidates(raw)
    known = dialect()
    seeds = np.full(1 << 16, -1, dtype=np.int32)
    for kind, message in known.items():
        seeds[kind] = message.seed
    kinds, lengths, heads = _read_headers(raw, candidates)
    whole = (kinds < len(seeds)) & (candidates + heads + lengths + 2 <= len(raw))
    whole[whole] = seeds[kinds[whole]] >= 0
    begin, kinds, lengths, heads = candidates[whole], kinds[whole], lengths[whole], heads[whole]
    second = raw[begin] == _MAVLINK2
    flags = np.where(second, raw[begin + np.where(second, 2, 0)], 0)
    good = (flags | _SIGNED) == _SIGNED
    ends = begin + heads + lengths + 2 + np.where(flags & _SIGNED, _SIGNATURE, 0)
    good &= ends <= len(raw)
    good[good] = _check_sums(raw, begin[good] + 1, (heads + lengths)[good] - 1, seeds[kinds[good]])
    return begin[good] - _STAMP, ends[good], kinds[good].astype(np.int32)


def _candidates(raw: Bytes) -> Offsets:
    """Return the places of a start byte with room for a stamp before it and a header behind it."""
    parts = []
    last = len(raw) - _HEADER[_MAVLINK2]
    for start in range(_STAMP, len(raw) - 8, _BLOCK):
        block = raw[start : min(start + _BLOCK, len(raw) - 8)]
        at = np.flatnonzero((block == _MAVLINK1) | (block == _MAVLINK2)) + start
        parts.append(at[(raw[at] == _MAVLINK1) | (at <= last)])
    return np.concatenate(parts) if parts else np.empty(0, dtype=np.int64)


def _read_headers(raw: Bytes, begin: Offsets) -> tuple[Offsets, Offsets, Offsets]:
    """Return each candidate's message id, payload length and header length."""
    second = raw[begin] == _MAVLINK2
    kinds = raw[begin + 5].astype(np.int64)
    wide = begin[second]
    kinds[second] = raw[wide + 7].astype(np.int64) + (raw[wide + 8].astype(np.int64) << 8)
    kinds[second] += raw[wide + 9].astype(np.int64) << 16
    heads = np.where(second, _HEADER[_MAVLINK2], _HEADER[_MAVLINK1])
    return kinds, raw[begin + 1].astype(np.int64), heads


@lru_cache(maxsize=1)
def _crc_table() -> NDArray[np.uint16]:
    """Return the byte-wise table of MAVLink's check sum (CRC-16/MCRF4XX)."""
    table = np.arange(256, dtype=np.uint16)
    for _ in range(8):
        table = np.where(table & 1, (table >> 1) ^ 0x8408, table >> 1).astype(np.uint16)
    return table


def _check_sums(raw: Bytes, start: Offsets, length: Offsets, seed: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return whether the two bytes behind ``length`` bytes from ``start`` on are their check sum."""
    table = _crc_table()
    good = np.zeros(len(start), dtype=np.bool_)
    if len(start) == 0:
        return good
    order = np.argsort(length, kind="stable")
    sizes, firsts = np.unique(length[order], return_index=True)
    for size, first, last in zip(
        sizes.tolist(), firsts.tolist(), [*firsts[1:].tolist(), len(order)], strict=True
    ):
        rows = order[first:last]
        columns = np.ascontiguousarray(raw[start[rows, np.newaxis] + np.arange(size + 2)].T)
        crc = np.full(len(rows), _CRC_START, dtype=np.uint16)
        for column in columns[:size]:
            crc = (crc >> 8) ^ table[(crc ^ column) & 0xFF]
        crc = (crc >> 8) ^ table[(crc ^ seed[rows].astype(np.uint16)) & 0xFF]
        good[rows] = (columns[size] == (crc & 0xFF)) & (columns[size + 1] == (crc >> 8))
    return good

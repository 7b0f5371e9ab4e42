"""MAVLink frames out of a stream of bytes as it arrives, in the rows of ``logs.tlog.dialect``.

Bytes that are no sound frame are counted and passed over, one at a time, so that garbage never costs a frame that
follows it. At most one unfinished frame is held back.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from logs.tlog import MessageType, dialect

LONGEST = 10 + 255 + 2 + 13
"""Bytes of the longest frame: header, payload, check sum, signature."""
_MAVLINK1, _MAVLINK2 = 0xFE, 0xFD
_SIGNED = 1


@dataclass(frozen=True, slots=True)
class Frame:
    """One sound frame: its message's name and row (1,), its sender, and its bytes."""

    name: str
    row: NDArray[np.void]
    system: int
    component: int
    raw: bytes

    @property
    def signed(self) -> bool:
        """True where a signature follows; whether it is right is not told here."""
        return self.raw[0] == _MAVLINK2 and bool(self.raw[2] & _SIGNED)


@dataclass(slots=True)
class FrameReader:
    """Finds the frames in what arrives; ``garbage`` counts the bytes passed over, among them messages that the
    dialect lacks, whose check sum cannot be verified.
    """

    garbage: int = 0
    _held: bytes = field(default=b"")

    def datagram(self, data: bytes) -> list[Frame]:
        """Return the frames of a datagram. What an earlier one left unfinished counts only if this one finishes it."""
        held, self._held = self._held, b""
        if held and not (data[:1] and data[0] in (_MAVLINK1, _MAVLINK2) and self._one(data, 0)):
            return self.stream(held + data)
        self.garbage += len(held)
        return self.stream(data)

    def stream(self, data: bytes) -> list[Frame]:
        """Return the frames that are complete with the bytes that have come."""
        data = self._held + data
        found: list[Frame] = []
        at = 0
        while at < len(data):
            if data[at] not in (_MAVLINK1, _MAVLINK2):
                at += 1
                self.garbage += 1
                continue
            size = _length(data, at)
            if size is None or at + size > len(data):
                if len(data) - at < LONGEST and _plausible(data, at):
                    break
                size = 0
            frame = self._one(data, at) if size else None
            if frame is None:
                at += 1
                self.garbage += 1
                continue
            found.append(frame)
            at += len(frame.raw)
        self._held = data[at:]
        return found

    def _one(self, data: bytes, at: int) -> Frame | None:
        """Return the frame that begins at a place, or None where there is none that is sound."""
        size = _length(data, at)
        if size is None or at + size > len(data):
            return None
        raw = data[at : at + size]
        second = raw[0] == _MAVLINK2
        head = 10 if second else 6
        number = int.from_bytes(raw[7:10], "little") if second else raw[5]
        known = _known(number)
        if known is None:
            return None
        payload, end = raw[head : head + raw[1]], head + raw[1]
        if _check_sum(raw[1:end], known.seed) != int.from_bytes(raw[end : end + 2], "little"):
            return None
        size = known.dtype.itemsize
        row = np.frombuffer(payload[:size].ljust(size, b"\0"), dtype=known.dtype)
        return Frame(known.name, row, raw[5] if second else raw[3], raw[6] if second else raw[4], raw)


def _length(data: bytes, at: int) -> int | None:
    """Return the length of the frame that begins at a place, None where its header is not complete."""
    if at + 3 > len(data):
        return None
    if data[at] == _MAVLINK1:
        return 8 + data[at + 1]
    return 12 + data[at + 1] + (13 if data[at + 2] & _SIGNED else 0)


def _plausible(data: bytes, at: int) -> bool:
    """Tell whether an unfinished frame may be one: its flags and, once there, its message are known."""
    if data[at] == _MAVLINK1:
        return at + 6 > len(data) or _known(data[at + 5]) is not None
    if at + 3 <= len(data) and data[at + 2] & ~_SIGNED:
        return False
    return at + 10 > len(data) or _known(int.from_bytes(data[at + 7 : at + 10], "little")) is not None


def _known(number: int) -> MessageType | None:
    return dialect().get(number)


def _check_sum(data: bytes, seed: int) -> int:
    """Return MAVLink's check sum (CRC-16/MCRF4XX) of a frame's bytes and its message's seed."""
    table = _table()
    crc = 0xFFFF
    for byte in data:
        crc = (crc >> 8) ^ table[(crc ^ byte) & 0xFF]
    return (crc >> 8) ^ table[(crc ^ seed) & 0xFF]


@lru_cache(maxsize=1)
def _table() -> tuple[int, ...]:
    rows = []
    for value in range(256):
        for _ in range(8):
            value = (value >> 1) ^ 0x8408 if value & 1 else value >> 1
        rows.append(value)
    return tuple(rows)

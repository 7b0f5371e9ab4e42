"""Inside a chunk: decompressed and checked within bounds, its messages found and gathered as columns."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from numpy.typing import NDArray

from logs.container import INDEX_ENTRY, MESSAGE_HEADER

LARGEST_CHUNK = 1 << 28
"""A chunk that claims to be larger is taken for damaged: its length is not believed before it is
allocated."""

_RECORD = struct.Struct("<BQ")
_HEAD = MESSAGE_HEADER.itemsize


class ChunkError(ValueError):
    """A chunk cannot be read; the message says why, in a few words."""


@dataclass(frozen=True, slots=True)
class ChunkRef:
    """Where a chunk stands in its file and what its header says.

    ``start`` and ``size`` are those of the stored (compressed) content; ``indexes`` gives the file offset of
    each channel's message index, or is None where the file has none.
    """

    offset: int
    start: int
    size: int
    compression: str
    uncompressed_size: int
    crc: int
    first_ns: int
    last_ns: int
    indexes: dict[int, int] | None = None
    truncated: bool = False


def decompress(stored: bytes | memoryview, chunk: ChunkRef) -> bytes | memoryview:
    """Return the records of a chunk, their check sum validated.

    A truncated chunk gives as many bytes as can be had, unchecked.

    Raises:
        ChunkError: the content is damaged, too large, or its compression is unknown.
    """
    if chunk.uncompressed_size > LARGEST_CHUNK:
        raise ChunkError(f"claims {chunk.uncompressed_size} bytes")
    size = chunk.uncompressed_size
    try:
        if chunk.compression == "":
            records: bytes | memoryview = stored
        elif chunk.compression == "zstd":
            records = _zstd(stored, size, chunk.truncated)
        elif chunk.compression == "lz4":
            decoder = lz4.frame.LZ4FrameDecompressor()
            records = decoder.decompress(bytes(stored), max_length=size + 1)
        else:
            raise ChunkError(f"unknown compression {chunk.compression!r}")
    except (zstandard.ZstdError, RuntimeError, MemoryError) as error:
        raise ChunkError(f"does not decompress ({error})") from error
    if chunk.truncated:
        return records[:size]
    if len(records) != size:
        raise ChunkError(f"has {len(records)} bytes instead of {size}")
    if chunk.crc and zlib.crc32(records) != chunk.crc:
        raise ChunkError("fails its check sum")
    return records


def _zstd(stored: bytes | memoryview, size: int, truncated: bool) -> bytes:
    # The frame states its own size, which is allocated at once: believed only where it is the chunk's.
    if not truncated and zstandard.frame_content_size(stored) == size:
        return zstandard.ZstdDecompressor().decompress(stored, max_output_size=size)
    stream = zstandard.ZstdDecompressor().decompressobj()
    parts, total = [], 0
    for start in range(0, len(stored), 1 << 14):
        try:
            part = stream.decompress(stored[start : start + (1 << 14)])
        except zstandard.ZstdError:
            if truncated:
                break
            raise
        parts.append(part)
        total += len(part)
        if total > size or stream.eof:
            break
    return b"".join(parts)


def walk(records: bytes | memoryview) -> Iterator[tuple[int, int, int]]:
    """Yield (opcode, start of the content, length) of each whole record; stop at one that is not whole."""
    position, end = 0, len(records)
    while position + 9 <= end:
        opcode, length = _RECORD.unpack_from(records, position)
        if opcode == 0 or length > end - position - 9:
            return
        yield opcode, position + 9, length
        position += 9 + length


def index_by_walking(records: bytes | memoryview) -> dict[int, NDArray[np.void]]:
    """Return the message indexes (INDEX_ENTRY) of a chunk by channel, in the order of the records."""
    found: dict[int, list[tuple[int, int]]] = {}
    for opcode, start, length in walk(records):
        if opcode == 5 and length >= 22:
            channel, _, log_time = struct.unpack_from("<HIQ", records, start)
            found.setdefault(channel, []).append((log_time, start - 9))
    return {channel: np.array(entries, dtype=INDEX_ENTRY) for channel, entries in found.items()}


def heads(records: bytes | memoryview, offsets: NDArray[np.int64]) -> NDArray[np.void] | None:
    """Return the message heads (MESSAGE_HEADER) at the offsets, or None where one is no whole message
    record."""
    if len(offsets) == 0:
        return np.empty(0, dtype=MESSAGE_HEADER)
    if int(offsets.min()) < 0 or int(offsets.max()) > len(records) - _HEAD:
        return None
    slots = np.ndarray((len(records) - _HEAD + 1,), dtype=f"V{_HEAD}", buffer=records, strides=(1,))
    found = slots[offsets].view(MESSAGE_HEADER)
    length = found["length"].astype(np.int64)
    whole = (found["op"] == 5) & (length >= 22) & (length <= len(records) - 9 - offsets)
    return found if bool(whole.all()) else None


def gather(records: bytes | memoryview, offsets: NDArray[np.int64], size: int) -> NDArray[np.void]:
    """Return the data (n,) ``V{size}`` of messages whose records begin at the offsets."""
    slots = np.ndarray((len(records) - size + 1,), dtype=f"V{size}", buffer=records, strides=(1,))
    data: NDArray[np.void] = slots[offsets + _HEAD]
    return data

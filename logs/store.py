"""Access to the chunks of a file: records decompressed once, indexes read, checked, and made anew where
wrong."""

from __future__ import annotations

import struct
from collections import OrderedDict
from collections.abc import Collection, Iterator

import numpy as np
from numpy.typing import NDArray

from logs.chunks import ChunkError, ChunkRef, decompress, heads, index_by_walking
from logs.container import INDEX_ENTRY
from logs.contents import Contents, FileBytes

LOOSE = -1
"""Number of the pseudo-chunk of messages outside of chunks; its records are the file itself."""

_CACHED_CHUNKS = 4
_NS = 1_000_000_000


class ChunkStore:
    """The chunks of one file by number, in the order of the file; what is found wrong goes to its
    contents."""

    def __init__(self, data: FileBytes, contents: Contents) -> None:
        self._data = data
        self._contents = contents
        self._indexes: dict[int, dict[int, NDArray[np.void]]] = {}
        self._chunks: OrderedDict[int, bytes | memoryview] = OrderedDict()
        self._bad: set[int] = set()
        self._walked = False

    def numbers(self) -> Iterator[int]:
        """Yield the numbers of all chunks, the loose messages first."""
        yield LOOSE
        yield from range(len(self._contents.chunks))

    def distrust_indexes(self) -> None:
        """Make all message indexes anew, from the chunks themselves."""
        self._walked = True
        self._indexes.clear()

    def records(self, number: int) -> bytes | memoryview | None:
        """Return a chunk's records (the file itself for loose messages), or None where it is damaged."""
        if number == LOOSE:
            return self._data.view
        if number in self._chunks:
            self._chunks.move_to_end(number)
            return self._chunks[number]
        if number in self._bad:
            return None
        chunk = self._contents.chunks[number]
        try:
            records = decompress(self._data.view[chunk.start : chunk.start + chunk.size], chunk)
        except ChunkError as error:
            self._bad.add(number)
            self._contents.damage(chunk.offset, chunk.size)
            self._contents.report(_chunk_problem(chunk, error))
            return None
        self._chunks[number] = records
        while len(self._chunks) > _CACHED_CHUNKS:
            self._chunks.popitem(last=False)
        return records

    def index(self, number: int) -> dict[int, NDArray[np.void]]:
        """Return a chunk's message indexes by channel, from the file or by walking its records."""
        if number not in self._indexes:
            self._indexes[number] = self._contents.loose if number == LOOSE else self._chunk_index(number)
        return self._indexes[number]

    def checked(
        self, records: bytes | memoryview, chunk: int, channel: int
    ) -> tuple[NDArray[np.int64], NDArray[np.void]]:
        """Return offsets and heads of a channel's messages; an index that is wrong is made anew."""
        offsets = self.index(chunk)[channel]["offset"].astype(np.int64)
        head = heads(records, offsets)
        entries = self.index(chunk)[channel]
        if head is None or not _agree(head, entries, channel):
            self._contents.report(f"The message index of chunk {chunk} is wrong and was made anew.")
            self._contents.complete = False
            self._indexes[chunk] = index_by_walking(records)
            offsets = self._indexes[chunk].get(channel, np.empty(0, INDEX_ENTRY))["offset"].astype(np.int64)
            head = heads(records, offsets)
        assert head is not None  # offsets come from walking whole records
        return offsets, head

    def order(
        self, wanted: Collection[int], start_ns: int | None, end_ns: int | None
    ) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
        """Return chunks and offsets of the messages of some channels, in the order of log times."""
        parts = []
        for chunk in self.numbers():
            index = self.index(chunk)
            for number in index:
                if number in wanted and len(index[number]):
                    entries = index[number]
                    parts.append((entries, np.full(len(entries), chunk)))
        if not parts:
            return np.empty(0, np.int64), np.empty(0, np.uint64)
        entries = np.concatenate([p[0] for p in parts])
        chunks = np.concatenate([p[1] for p in parts])
        keep = np.ones(len(entries), dtype=np.bool_)
        if start_ns is not None:
            keep &= entries["log"] >= np.uint64(max(start_ns, 0))
        if end_ns is not None:
            keep &= entries["log"] < np.uint64(max(end_ns, 0))
        entries, chunks = entries[keep], chunks[keep]
        order = np.lexsort((entries["offset"], chunks, entries["log"]))
        return chunks[order], entries["offset"][order]

    def _chunk_index(self, number: int) -> dict[int, NDArray[np.void]]:
        places = self._contents.chunks[number].indexes
        if places is not None and not self._walked:
            found = {}
            for channel, place in places.items():
                entries = self._index_record(channel, place)
                if entries is None:
                    break
                found[channel] = entries
            else:
                return found
        records = self.records(number)
        return {} if records is None else index_by_walking(records)

    def _index_record(self, channel: int, place: int) -> NDArray[np.void] | None:
        view = self._data.view
        if place + 15 > len(view):
            return None
        opcode, length, owner, size = struct.unpack_from("<BQHI", view, place)
        if (
            opcode != 7
            or owner != channel
            or size != length - 6
            or size % 16
            or size > len(view) - place - 15
        ):
            return None
        return np.frombuffer(view, dtype=INDEX_ENTRY, count=size // 16, offset=place + 15)


def _agree(head: NDArray[np.void], entries: NDArray[np.void], channel: int) -> bool:
    """Tell whether an index names messages of its channel and their times."""
    return bool((head["channel"] == channel).all() and (head["log"] == entries["log"]).all())


def _chunk_problem(chunk: ChunkRef, error: ChunkError) -> str:
    span = (chunk.last_ns - chunk.first_ns) / _NS
    return f"The chunk at byte {chunk.offset} ({span:.1f} s of messages) is lost: it {error}."

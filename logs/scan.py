"""What a file holds and where: from its summary where that can be believed, else record by record.

A damaged, truncated or unfinished file is read as far as it goes; each loss is a sentence in ``problems``.
Only a file that is no MCAP at all is refused.
"""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace
from pathlib import Path

import numpy as np
from mcap.records import Channel, Header, Metadata, Schema

from logs.chunks import ChunkError, decompress, walk
from logs.container import INDEX_ENTRY, MAGIC
from logs.contents import PARSE_ERRORS, Contents, FileBytes, add_attachment, chunk_at, parse
from logs.errors import LogError
from logs.summary import from_summary

_LARGEST_OPCODE = 0x0F


def scan(path: Path, data: FileBytes) -> Contents:
    """Find what an MCAP file holds.

    Raises:
        LogError: the file is no MCAP file.
    """
    if bytes(data.view[:8]) != MAGIC:
        if MAGIC.startswith(bytes(data.view[:8])):
            raise LogError(path, "the file ends within its first bytes", "nothing can be recovered from it")
        raise LogError(path, "not an MCAP file", "import other logs with 'deckfix import'")
    problems: list[str] = []
    summary = from_summary(data, problems)
    if summary is not None:
        return summary
    found = _Linear(data).run()
    for problem in problems:
        found.report(problem)
        found.complete = False
    return found


class _Linear:
    """Reads a file record by record; after damage it goes on at the next compressed chunk that it can
    find."""

    def __init__(self, data: FileBytes) -> None:
        self.data = data
        self.found = Contents()
        self.loose: dict[int, list[tuple[int, int]]] = {}
        self.ended = False
        self.indexes: dict[int, int] = {}

    def run(self) -> Contents:
        position = 8
        while position < self.data.size and not self.ended:
            step = self.record(position)
            if step == 0:
                step = self.skip_damage(position)
            position += step
        self.close_chunk()
        found = self.found
        if not self.ended:
            found.complete = False
            found.report("The file has no end: its recording was interrupted, or it was cut off.")
        elif bytes(self.data.view[-8:]) != MAGIC:
            found.complete = False
            found.report("The end of the file is damaged or cut off.")
        if not found.complete:
            # Some index of a damaged file may be missing; the chunks themselves have check sums.
            found.chunks = [replace(chunk, indexes=None) for chunk in found.chunks]
        found.loose = {c: np.array(e, dtype=INDEX_ENTRY) for c, e in self.loose.items()}
        self.complete_from_chunks()
        return found

    def record(self, position: int) -> int:
        """Take in the record at a position; return its size, or 0 where it cannot be one."""
        view, size = self.data.view, self.data.size
        if position + 9 > size:
            return 0
        opcode, length = struct.unpack_from("<BQ", view, position)
        if opcode == 0:
            return 0
        if length > size - position - 9:
            return self.truncated_chunk(position) if opcode == 6 else 0
        if opcode > _LARGEST_OPCODE and opcode < 0x80:
            return 0
        try:
            self.take(opcode, view[position + 9 : position + 9 + length], position)
        except PARSE_ERRORS:
            return 0
        return int(9 + length)

    def take(self, opcode: int, content: memoryview, position: int) -> None:
        found = self.found
        if opcode == 6:
            self.close_chunk()
            found.chunks.append(chunk_at(content, position))
        elif opcode == 7:
            (channel,) = struct.unpack_from("<H", content)
            self.indexes[channel] = position
        elif opcode == 5:
            channel, _, log_time = struct.unpack_from("<HIQ", content)
            if len(content) < 22:
                raise ValueError("a message without a head")
            self.loose.setdefault(channel, []).append((log_time, position))
        elif opcode == 3:
            schema = parse(Schema.read, content)
            found.schemas.setdefault(schema.id, schema)
        elif opcode == 4:
            channel_record = parse(Channel.read, content)
            found.channels.setdefault(channel_record.id, channel_record)
        elif opcode == 12:
            found.metadata.append(parse(Metadata.read, content))
        elif opcode == 9:
            add_attachment(found, content)
        elif opcode == 1:
            header = parse(Header.read, content)
            found.profile, found.library = header.profile, header.library
        elif opcode == 15:
            self.ended = True
            (crc,) = struct.unpack_from("<I", content)
            if crc and zlib.crc32(self.data.view[:position]) != crc:
                found.report("The file fails its check sum: some of its bytes have changed.")
                found.complete = False
        elif opcode == 2:
            self.ended = True

    def close_chunk(self) -> None:
        """Give the message indexes read since the last chunk to it."""
        if self.found.chunks and self.indexes:
            last = self.found.chunks[-1]
            self.found.chunks[-1] = replace(last, indexes=dict(self.indexes))
        self.indexes = {}

    def truncated_chunk(self, position: int) -> int:
        """Keep what is there of a chunk that runs beyond the end of the file, unless another chunk
        follows."""
        if self.next_chunk(position + 1) >= 0:
            return 0
        try:
            chunk = chunk_at(self.data.view[position + 9 :], position, truncated=True)
        except (struct.error, ValueError):
            return 0
        self.close_chunk()
        self.found.chunks.append(chunk)
        self.found.report(f"The last chunk, from byte {position} on, is cut off.")
        self.found.damage(position, self.data.size - position)
        return self.data.size - position

    def skip_damage(self, position: int) -> int:
        """Report damage at a position; return how far it is to the next chunk, or to the end."""
        self.close_chunk()
        after = self.next_chunk(position + 1)
        end = after if after >= 0 else self.data.size
        self.found.damage(position, end - position)
        if after >= 0 or end - position > 0:
            self.found.report(f"{end - position} bytes from byte {position} on cannot be read.")
        return end - position

    def next_chunk(self, start: int) -> int:
        """Return the place of the next chunk record that has a plausible head, -1 if there is none."""
        for name in (b"zstd", b"lz4"):
            pattern = struct.pack("<I", len(name)) + name
            at = self.data.find(pattern, start)
            while at >= 0:
                place = at - 37
                if place >= start and self.plausible(place, len(name)):
                    return place
                at = self.data.find(pattern, at + 1)
        return -1

    def plausible(self, place: int, name_length: int) -> bool:
        opcode, length = struct.unpack_from("<BQ", self.data.view, place)
        if opcode != 6 or length > self.data.size - place - 9:
            return False
        (stored,) = struct.unpack_from("<Q", self.data.view, place + 41 + name_length)
        return bool(stored == length - 40 - name_length)

    def complete_from_chunks(self) -> None:
        """Take schemas and channels out of the chunks, where other writers put them."""
        needed = {c for chunk in self.found.chunks for c in chunk.indexes or ()} | set(self.loose)
        for chunk in self.found.chunks:
            if chunk.indexes and needed <= set(self.found.channels):
                continue
            try:
                records = decompress(self.data.view[chunk.start : chunk.start + chunk.size], chunk)
            except ChunkError:
                continue  # reported when its messages are read
            for opcode, at, length in walk(records):
                if opcode in (3, 4):
                    try:
                        self.take(opcode, memoryview(records)[at : at + length], 0)
                    except PARSE_ERRORS:
                        continue

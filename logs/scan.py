"""What a file holds and where: from its summary where that can be believed, else record by record.

A damaged, truncated or unfinished file is read as far as it goes; each loss is a sentence in ``problems``.
Only a file that is no MCAP at all is refused.
"""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    Footer,
    Header,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
)
from numpy.typing import NDArray

from logs.chunks import ChunkError, ChunkRef, decompress, walk
from logs.container import INDEX_ENTRY, MAGIC
from logs.errors import LogError

PARSE_ERRORS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError)
"""What parsing a damaged record may raise."""

_CHUNK_HEAD = struct.Struct("<QQQII")
_FOOTER_BYTES = 9 + 20 + 8
_COMPRESSIONS = {b"": "", b"lz4": "lz4", b"zstd": "zstd"}
_MOST_PROBLEMS = 20
_LARGEST_OPCODE = 0x0F

R = TypeVar("R")


@dataclass(slots=True)
class Contents:
    """What was found in a file; ``loose`` are the messages outside of chunks, as message indexes of the
    file."""

    profile: str = ""
    library: str = ""
    schemas: dict[int, Schema] = field(default_factory=dict)
    channels: dict[int, Channel] = field(default_factory=dict)
    chunks: list[ChunkRef] = field(default_factory=list)
    loose: dict[int, NDArray[np.void]] = field(default_factory=dict)
    counts: dict[int, int] | None = None
    metadata: list[Metadata] = field(default_factory=list)
    attachments: list[Attachment] = field(default_factory=list)
    problems: list[str] = field(default_factory=list)
    complete: bool = True
    lost_bytes: int = 0
    damaged_at: int | None = None

    def report(self, problem: str) -> None:
        """Note a problem, unless there are many already."""
        if len(self.problems) < _MOST_PROBLEMS and problem not in self.problems:
            self.problems.append(problem)

    def damage(self, offset: int, size: int) -> None:
        """Count bytes that could not be read."""
        self.complete = False
        self.lost_bytes += size
        self.damaged_at = offset if self.damaged_at is None else min(self.damaged_at, offset)


class FileBytes:
    """A file mapped into memory, read-only; slices are copies only where asked for."""

    def __init__(self, path: Path) -> None:
        try:
            with path.open("rb") as stream:
                size = stream.seek(0, 2)
                if size == 0:
                    raise LogError(path, "the file is empty", "record or import it again")
                self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except FileNotFoundError:
            raise LogError(path, "no such file", "check the name") from None
        except (OSError, ValueError) as error:
            raise LogError(path, f"cannot be read ({error})", "check that it is a readable file") from None
        self.view = memoryview(self._map)
        self.size = size

    def find(self, pattern: bytes, start: int) -> int:
        """Return the first place of a pattern, -1 if there is none."""
        return self._map.find(pattern, start)


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
    summary = _from_summary(data, problems)
    if summary is not None:
        return summary
    found = _Linear(data).run()
    for problem in problems:
        found.report(problem)
        found.complete = False
    return found


def _parse(read: Callable[[ReadDataStream], R], content: memoryview) -> R:
    return read(ReadDataStream(BytesIO(content)))


def _from_summary(data: FileBytes, problems: list[str]) -> Contents | None:
    """Read the summary, or return None where it is missing, does not tell everything, or is damaged (a
    problem).
    """
    damaged = "The end of the file is damaged; it was read record by record."
    if data.size < 8 + _FOOTER_BYTES or bytes(data.view[-8:]) != MAGIC:
        return None  # said by whoever reads on
    footer_at = data.size - _FOOTER_BYTES
    opcode, length = struct.unpack_from("<BQ", data.view, footer_at)
    if opcode != 2 or length != 20:
        problems.append(damaged)
        return None
    footer = _parse(Footer.read, data.view[footer_at + 9 : footer_at + 29])
    start = footer.summary_start
    if start == 0:
        return None
    if start > footer_at:
        problems.append(damaged)
        return None
    if footer.summary_crc and zlib.crc32(data.view[start : footer_at + 25]) != footer.summary_crc:
        problems.append(damaged)
        return None
    try:
        return _read_summary(data, start, footer_at)
    except PARSE_ERRORS:
        problems.append(damaged)
        return None


def _read_summary(data: FileBytes, start: int, end: int) -> Contents | None:
    found = Contents()
    statistics: Statistics | None = None
    attachments, metadata = [], []
    opcode, length = struct.unpack_from("<BQ", data.view, 8)
    if opcode != 1 or length > data.size - 17:
        return None
    header = _parse(Header.read, data.view[17 : 17 + length])
    found.profile, found.library = header.profile, header.library
    section = data.view[start:end]
    for opcode, at, length in walk(section):
        content = section[at : at + length]
        if opcode == 3:
            schema = _parse(Schema.read, content)
            found.schemas[schema.id] = schema
        elif opcode == 4:
            channel = _parse(Channel.read, content)
            found.channels[channel.id] = channel
        elif opcode == 8:
            found.chunks.append(_chunk_of_index(data, _parse(ChunkIndex.read, content)))
        elif opcode == 10:
            attachments.append(_parse(AttachmentIndex.read, content))
        elif opcode == 13:
            metadata.append(_parse(MetadataIndex.read, content))
        elif opcode == 11:
            statistics = _parse(Statistics.read, content)
    if statistics is None or not _complete(found, statistics, len(attachments), len(metadata)):
        return None
    found.counts = dict(statistics.channel_message_counts)
    found.chunks.sort(key=lambda c: c.offset)
    for entry in attachments:
        _add_attachment(found, _record(data, entry.offset, 9))
    for item in metadata:
        found.metadata.append(_parse(Metadata.read, _record(data, item.offset, 12)))
    return found


def _complete(found: Contents, statistics: Statistics, attachments: int, metadata: int) -> bool:
    """Tell whether the summary indexes everything that its statistics count."""
    return (
        statistics.chunk_count == len(found.chunks)
        and statistics.channel_count == len(found.channels)
        and statistics.attachment_count == attachments
        and statistics.metadata_count == metadata
        and sum(statistics.channel_message_counts.values()) == statistics.message_count
        and (statistics.message_count == 0 or bool(found.chunks))
        and all(c.schema_id == 0 or c.schema_id in found.schemas for c in found.channels.values())
        and all(chunk.indexes for chunk in found.chunks)
    )


def _record(data: FileBytes, offset: int, opcode: int) -> memoryview:
    """Return the content of the record at an offset.

    Raises:
        ValueError: another record, or none, stands there.
    """
    if offset + 9 > data.size:
        raise ValueError("a record outside of the file")
    found, length = struct.unpack_from("<BQ", data.view, offset)
    if found != opcode or length > data.size - offset - 9:
        raise ValueError("not the record that the index promises")
    return data.view[offset + 9 : offset + 9 + length]


def _chunk_of_index(data: FileBytes, index: ChunkIndex) -> ChunkRef:
    chunk = _chunk(_record(data, index.chunk_start_offset, 6), index.chunk_start_offset)
    return replace(
        chunk,
        first_ns=index.message_start_time,
        last_ns=index.message_end_time,
        indexes=dict(index.message_index_offsets),
    )


def _chunk(content: memoryview, offset: int, truncated: bool = False) -> ChunkRef:
    """Parse the head of a chunk record; ``content`` may end early where the chunk is truncated."""
    first, last, size, crc, length = _CHUNK_HEAD.unpack_from(content)
    name = bytes(content[32 : 32 + length]) if length <= 8 else b"?"
    if name not in _COMPRESSIONS:
        raise ValueError("a chunk of unknown compression")
    (stored,) = struct.unpack_from("<Q", content, 32 + length)
    start = 40 + length
    if stored > len(content) - start:
        if not truncated:
            raise ValueError("a chunk longer than its record")
        stored = len(content) - start
    return ChunkRef(
        offset, offset + 9 + start, stored, _COMPRESSIONS[name], size, crc, first, last, None, truncated
    )


def _add_attachment(found: Contents, content: memoryview) -> None:
    """Parse an attachment and check its sum, which covers all but itself."""
    attachment = _parse(Attachment.read, content)
    names = len(attachment.name.encode()) + len(attachment.media_type.encode())
    end = 32 + names + len(attachment.data)  # the record may be padded behind its check sum
    (crc,) = struct.unpack_from("<I", content, end)
    if crc and zlib.crc32(content[:end]) != crc:
        found.report(f"The attachment {attachment.name!r} fails its check sum and was left out.")
        found.complete = False
        return
    found.attachments.append(attachment)


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
            found.chunks.append(_chunk(content, position))
        elif opcode == 7:
            (channel,) = struct.unpack_from("<H", content)
            self.indexes[channel] = position
        elif opcode == 5:
            channel, _, log_time = struct.unpack_from("<HIQ", content)
            if len(content) < 22:
                raise ValueError("a message without a head")
            self.loose.setdefault(channel, []).append((log_time, position))
        elif opcode == 3:
            schema = _parse(Schema.read, content)
            found.schemas.setdefault(schema.id, schema)
        elif opcode == 4:
            channel_record = _parse(Channel.read, content)
            found.channels.setdefault(channel_record.id, channel_record)
        elif opcode == 12:
            found.metadata.append(_parse(Metadata.read, content))
        elif opcode == 9:
            _add_attachment(found, content)
        elif opcode == 1:
            header = _parse(Header.read, content)
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
            chunk = _chunk(self.data.view[position + 9 :], position, truncated=True)
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

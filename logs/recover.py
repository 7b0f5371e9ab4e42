"""Recovering a damaged or interrupted log: everything readable into a new, complete file."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.chunks import ChunkError, ChunkRef, decompress, index_by_walking
from logs.container import Container, create
from logs.contents import Contents, FileBytes
from logs.errors import LogError
from logs.scan import scan

RECOVERED = "deckfix.recovered"
_MESSAGE = struct.Struct("<BQHIQQ")
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class RecoverReport:
    """What was recovered and what was lost.

    ``lost_from_byte`` is the first damaged byte; ``lost_s`` the time span of the messages in damaged chunks,
    as their headers tell it, or None where bytes were lost of which nothing is known.
    """

    messages: int
    chunks: int
    damaged_chunks: int
    lost_bytes: int
    lost_from_byte: int | None
    lost_s: float | None
    last_ns: int | None
    problems: tuple[str, ...]

    def summary(self) -> str:
        """Return one line for the user."""
        text = f"{self.messages} messages in {self.chunks} chunks recovered"
        if self.lost_bytes == 0:
            return text + ("; nothing was lost" if not self.problems else "; no bytes were unreadable")
        span = "" if self.lost_s is None else f" ({self.lost_s:.1f} s of messages)"
        return f"{text}; {self.lost_bytes} bytes{span} lost from byte {self.lost_from_byte} on"


def recover(src: str | Path, dst: str | Path, *, force: bool = False) -> RecoverReport:
    """Write what can be read of ``src`` to ``dst``, as a complete file with indexes and check sums.

    Intact chunks are copied as they are; of a chunk that is cut off, the whole messages are kept.

    Raises:
        LogError: ``src`` is no MCAP file or nothing of it can be read, or ``dst`` exists (without ``force``)
            or is the same file.
    """
    source, target = Path(src), Path(dst)
    if target.exists() and source.exists() and target.samefile(source):
        raise LogError(target, "source and target are the same file", "choose another name")
    data = FileBytes(source)
    contents = scan(source, data)
    found = contents.chunks or contents.loose or contents.metadata or contents.attachments
    if not found and not contents.complete:
        raise LogError(source, "nothing in the file can be read", "it cannot be recovered")
    with create(target, force) as stream:
        copy = _Copy(data, contents, Container(stream, contents.library or "deckfix", contents.profile))
        return copy.run()


class _Copy:
    """Carries the readable contents of one file over to another."""

    def __init__(self, data: FileBytes, contents: Contents, container: Container) -> None:
        self.data, self.contents, self.container = data, contents, container
        self.chunks = self.damaged = 0
        self.lost_ns = 0
        self.span_known = True
        self.last_ns: int | None = None

    def run(self) -> RecoverReport:
        contents, container = self.contents, self.container
        self.span_known = not any("cannot be read" in p for p in contents.problems)
        for schema in contents.schemas.values():
            container.add_schema(schema.name, schema.encoding, schema.data, schema.id)
        for channel in contents.channels.values():
            container.add_channel(
                channel.topic, channel.message_encoding, channel.schema_id, channel.metadata, channel.id
            )
        for record in contents.metadata:
            container.add_metadata(record.name, record.metadata)
        for attachment in contents.attachments:
            container.add_attachment(
                attachment.name, attachment.media_type, attachment.data, attachment.log_time
            )
        for chunk in contents.chunks:
            self.chunk(chunk)
        self.messages(self.data.view, contents.loose)
        container.flush()
        report = RecoverReport(
            container.message_count,
            self.chunks,
            self.damaged,
            contents.lost_bytes,
            contents.damaged_at,
            self.lost_ns / _NS if self.span_known and contents.lost_bytes else None,
            self.last_ns,
            tuple(contents.problems),
        )
        if not contents.complete:
            entries = {"summary": report.summary()}
            entries.update({f"problem_{i:02d}": p for i, p in enumerate(report.problems)})
            container.add_metadata(RECOVERED, entries)
        container.finish()
        return report

    def chunk(self, chunk: ChunkRef) -> None:
        stored = self.data.view[chunk.start : chunk.start + chunk.size]
        try:
            records = decompress(stored, chunk)
        except ChunkError as error:
            self.damaged += 1
            self.lost_ns += max(chunk.last_ns - chunk.first_ns, 0)
            self.contents.damage(chunk.offset, chunk.size)
            self.contents.report(f"The chunk at byte {chunk.offset} is lost: it {error}.")
            return
        index = index_by_walking(records)
        known = {c: entries for c, entries in index.items() if c in self.contents.channels}
        self.note_last(known)
        if chunk.truncated or len(known) < len(index):
            self.messages(records, known)
            self.container.flush()
            if chunk.truncated:
                self.damaged += 1
                reached = max((int(e["log"].max()) for e in known.values()), default=chunk.first_ns)
                self.lost_ns += max(chunk.last_ns - reached, 0)
        else:
            crc = chunk.crc or zlib.crc32(records)
            self.container.write_stored_chunk(stored, chunk.compression, len(records), crc, known)
            self.container.count(known)
        self.chunks += bool(known)

    def messages(self, records: bytes | memoryview, index: Mapping[int, NDArray[np.void]]) -> None:
        """Write messages one by one, in the order in which they stand."""
        known = {c: entries for c, entries in index.items() if c in self.contents.channels and len(entries)}
        if not known:
            return
        self.note_last(known)
        for offset in np.sort(np.concatenate([e["offset"] for e in known.values()])).tolist():
            _, length, channel, sequence, log_time, publish = _MESSAGE.unpack_from(records, offset)
            content = bytes(records[offset + _MESSAGE.size : offset + 9 + length])
            self.container.add(channel, log_time, publish, content, sequence=sequence)

    def note_last(self, index: Mapping[int, NDArray[np.void]]) -> None:
        for entries in index.values():
            latest = int(entries["log"].max())
            self.last_ns = latest if self.last_ns is None else max(self.last_ns, latest)

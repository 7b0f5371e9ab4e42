"""The MCAP container, written: records, chunks with their message indexes, summary and check sums.

Messages come either one by one (``add``: into one of two open chunks, compressed or not) or in bulk
(``write_chunk``: a chunk that was built elsewhere). Records are the ``mcap`` package's; what is written by
hand here is the chunk and its index, the only parts whose number grows with the messages. Nothing is kept of
a chunk but its index entry.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

import numpy as np
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)
from numpy.typing import NDArray

from logs.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
MESSAGE_HEADER = np.dtype(
    [
        ("op", "u1"),
        ("length", "<u8"),
        ("channel", "<u2"),
        ("sequence", "<u4"),
        ("log", "<u8"),
        ("publish", "<u8"),
    ]
)
"""What stands before the data of a message record; ``length`` counts from behind itself (22 + data)."""

INDEX_ENTRY = np.dtype([("log", "<u8"), ("offset", "<u8")])
"""One entry of a message index: log time and offset of the record in its uncompressed chunk."""

_MESSAGE = struct.Struct("<BQHIQQ")
_CHUNK_HEAD = struct.Struct("<BQQQQI")
_PREFIXED = struct.Struct("<I")
ZSTD_LEVEL = 1


def create(path: Path, force: bool) -> BinaryIO:
    """Create a file for writing.

    Raises:
        LogError: it exists and ``force`` is not set, or cannot be created.
    """
    try:
        return path.open("wb" if force else "xb")
    except FileExistsError:
        raise LogError(path, "the file exists", "choose another name or use --force") from None
    except OSError as error:
        raise LogError(path, f"cannot be created ({error.strerror})", "check the folder") from None


@dataclass(slots=True)
class _OpenChunk:
    """Records waiting to become a chunk."""

    compression: str
    records: bytearray = field(default_factory=bytearray)
    entries: dict[int, list[tuple[int, int]]] = field(default_factory=dict)

    def drain(self) -> tuple[bytearray, dict[int, NDArray[np.void]]]:
        records = self.records
        entries = {channel: np.array(e, dtype=INDEX_ENTRY) for channel, e in self.entries.items()}
        self.records, self.entries = bytearray(), {}
        return records, entries


class Container:
    """An MCAP file being written to a binary stream; ``finish`` completes it, ``flush`` makes it readable so
    far."""

    def __init__(
        self, stream: BinaryIO, library: str, profile: str = "ros2", chunk_size: int = 1 << 20
    ) -> None:
        self._stream = stream
        self._chunk_size = chunk_size
        self._position = 0
        self._data_crc = 0
        self._schemas: dict[int, Schema] = {}
        self._channels: dict[int, Channel] = {}
        self._chunk_indexes = bytearray()  # their records: a recording of hours has tens of thousands
        self._chunk_count = 0
        self._attachment_indexes: list[AttachmentIndex] = []
        self._metadata_indexes: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._start: int | None = None
        self._end = 0
        self._open = {True: _OpenChunk("zstd"), False: _OpenChunk("")}
        self._compress: Callable[[bytes | bytearray], bytes] = zstandard.ZstdCompressor(
            level=ZSTD_LEVEL
        ).compress
        self._emit(MAGIC)
        self._emit_record(Header(profile=profile, library=library))
        stream.flush()  # from here on the file is an MCAP file, whatever happens

    @property
    def message_count(self) -> int:
        """Messages written so far, those in open chunks included."""
        return sum(self._counts.values())

    def add_schema(self, name: str, encoding: str, data: bytes, schema_id: int | None = None) -> int:
        """Write a schema and return its id, which is the one given or a new one."""
        number = schema_id if schema_id is not None else max(self._schemas, default=0) + 1
        if number not in self._schemas:
            self._schemas[number] = Schema(id=number, name=name, encoding=encoding, data=data)
            self._emit_record(self._schemas[number])
        return number

    def add_channel(
        self,
        topic: str,
        message_encoding: str,
        schema_id: int,
        metadata: Mapping[str, str],
        channel_id: int | None = None,
    ) -> int:
        """Write a channel and return its id, which is the one given or a new one.

        Channels stand outside of chunks, so that none of them is lost with a damaged chunk.
        """
        number = channel_id if channel_id is not None else max(self._channels, default=0) + 1
        if number not in self._channels:
            self._channels[number] = Channel(
                id=number,
                topic=topic,
                message_encoding=message_encoding,
                schema_id=schema_id,
                metadata=dict(metadata),
            )
            self._emit_record(self._channels[number])
        return number

    def add(
        self,
        channel_id: int,
        log_time: int,
        publish_time: int,
        data: bytes | memoryview,
        compress: bool = True,
        sequence: int | None = None,
    ) -> None:
        """Append one message to the open chunk; it reaches the file with the chunk, or with ``flush``."""
        count = self._counts.get(channel_id, 0)
        number = count if sequence is None else sequence
        chunk = self._open[compress]
        if chunk.records and len(chunk.records) + len(data) + 31 > self._chunk_size:
            self._close(chunk)
        chunk.entries.setdefault(channel_id, []).append((log_time, len(chunk.records)))
        chunk.records += _MESSAGE.pack(
            5, 22 + len(data), channel_id, number & 0xFFFFFFFF, log_time, publish_time
        )
        chunk.records += data
        self._counts[channel_id] = count + 1
        self._span(log_time, log_time)

    def write_chunk(
        self, records: bytes | bytearray, entries: Mapping[int, NDArray[np.void]], compression: str = "zstd"
    ) -> None:
        """Write a chunk of message records and one message index (INDEX_ENTRY) for each of its channels."""
        stored = self._compress(records) if compression == "zstd" else records
        self.write_stored_chunk(stored, compression, len(records), zlib.crc32(records), entries)
        self.count(entries)

    def count(self, entries: Mapping[int, NDArray[np.void]]) -> None:
        """Add the messages of a chunk's indexes to the file's statistics."""
        for channel, index in entries.items():
            self._counts[channel] = self._counts.get(channel, 0) + len(index)

    def write_stored_chunk(
        self,
        stored: bytes | bytearray | memoryview,
        compression: str,
        size: int,
        crc: int,
        entries: Mapping[int, NDArray[np.void]],
    ) -> None:
        """Write a chunk whose content is compressed already; the caller counts its messages."""
        logs = [index["log"] for index in entries.values() if len(index)]
        start = min((int(x.min()) for x in logs), default=0)
        end = max((int(x.max()) for x in logs), default=0)
        name = compression.encode()
        head = _CHUNK_HEAD.pack(6, 40 + len(name) + len(stored), start, end, size, crc)
        chunk_start = self._position
        self._emit(head + _PREFIXED.pack(len(name)) + name + struct.pack("<Q", len(stored)))
        self._emit(stored)
        index_start = self._position
        offsets = {}
        for channel, index in entries.items():
            offsets[channel] = self._position
            self._emit(struct.pack("<BQHI", 7, 6 + index.nbytes, channel, index.nbytes) + index.tobytes())
        if logs:
            self._span(start, end)
        entry = ChunkIndex(
            message_start_time=start,
            message_end_time=end,
            chunk_start_offset=chunk_start,
            chunk_length=index_start - chunk_start,
            message_index_offsets=offsets,
            message_index_length=self._position - index_start,
            compression=compression,
            compressed_size=len(stored),
            uncompressed_size=size,
        )
        self._chunk_indexes += _record(entry)
        self._chunk_count += 1

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record."""
        offset = self._position
        self._emit_record(Metadata(name=name, metadata=dict(entries)))
        self._metadata_indexes.append(MetadataIndex(offset=offset, length=self._position - offset, name=name))

    def add_attachment(self, name: str, media_type: str, data: bytes, log_time: int = 0) -> None:
        """Write an attachment."""
        offset = self._position
        record = Attachment(create_time=0, log_time=log_time, name=name, media_type=media_type, data=data)
        self._emit_record(record)
        self._attachment_indexes.append(
            AttachmentIndex(
                offset=offset,
                length=self._position - offset,
                log_time=log_time,
                create_time=0,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )

    def flush(self) -> None:
        """Write the open chunks and hand everything to the operating system."""
        for chunk in self._open.values():
            self._close(chunk)
        self._stream.flush()

    def finish(self) -> None:
        """Write what is open, the summary and the footer; the stream stays open."""
        self.flush()
        self._emit_record(DataEnd(data_section_crc=self._data_crc))
        statistics = Statistics(
            attachment_count=len(self._attachment_indexes),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=self._chunk_count,
            message_count=self.message_count,
            metadata_count=len(self._metadata_indexes),
            message_start_time=self._start or 0,
            message_end_time=self._end,
            schema_count=len(self._schemas),
        )
        groups: list[tuple[Opcode, bytes | bytearray]] = [
            (Opcode.SCHEMA, _records(self._schemas.values())),
            (Opcode.CHANNEL, _records(self._channels.values())),
            (Opcode.STATISTICS, _record(statistics)),
            (Opcode.CHUNK_INDEX, self._chunk_indexes),
            (Opcode.ATTACHMENT_INDEX, _records(self._attachment_indexes)),
            (Opcode.METADATA_INDEX, _records(self._metadata_indexes)),
        ]
        start = self._position
        summary = bytearray()
        offsets = []
        for opcode, records in groups:
            if records:
                offsets.append(SummaryOffset(opcode, start + len(summary), len(records)))
            summary += records
        offset_start = start + len(summary)
        summary += _records(offsets)
        head = struct.pack("<BQQQ", Opcode.FOOTER, 20, start, offset_start)
        self._emit(summary)
        self._emit_record(Footer(start, offset_start, zlib.crc32(head, zlib.crc32(summary))))
        self._emit(MAGIC)
        self._stream.flush()

    def _close(self, chunk: _OpenChunk) -> None:
        if not chunk.records:
            return
        records, entries = chunk.drain()
        stored = self._compress(records) if chunk.compression else records
        self.write_stored_chunk(stored, chunk.compression, len(records), zlib.crc32(records), entries)

    def _span(self, start: int, end: int) -> None:
        self._end = end if self._start is None else max(self._end, end)
        self._start = start if self._start is None else min(self._start, start)

    def _emit_record(self, record: McapRecord) -> None:
        self._emit(_record(record))

    def _emit(self, data: bytes | bytearray | memoryview) -> None:
        self._stream.write(data)
        self._position += len(data)
        self._data_crc = zlib.crc32(data, self._data_crc)


def _record(record: McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    data: bytes = builder.end()  # type: ignore[no-untyped-call]
    return data


def _records(records: Iterable[McapRecord]) -> bytes:
    return b"".join(_record(record) for record in records)

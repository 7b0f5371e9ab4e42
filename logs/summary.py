"""Reading a file's summary: what it holds, without a pass over its data."""

from __future__ import annotations

import struct
import zlib
from dataclasses import replace

from mcap.records import (
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

from logs.chunks import ChunkRef, walk
from logs.container import MAGIC
from logs.contents import PARSE_ERRORS, Contents, FileBytes, add_attachment, chunk_at, parse

_FOOTER_BYTES = 9 + 20 + 8


def from_summary(data: FileBytes, problems: list[str]) -> Contents | None:
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
    footer = parse(Footer.read, data.view[footer_at + 9 : footer_at + 29])
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
    header = parse(Header.read, data.view[17 : 17 + length])
    found.profile, found.library = header.profile, header.library
    section = data.view[start:end]
    for opcode, at, length in walk(section):
        content = section[at : at + length]
        if opcode == 3:
            schema = parse(Schema.read, content)
            found.schemas[schema.id] = schema
        elif opcode == 4:
            channel = parse(Channel.read, content)
            found.channels[channel.id] = channel
        elif opcode == 8:
            found.chunks.append(_chunk_of_index(data, parse(ChunkIndex.read, content)))
        elif opcode == 10:
            attachments.append(parse(AttachmentIndex.read, content))
        elif opcode == 13:
            metadata.append(parse(MetadataIndex.read, content))
        elif opcode == 11:
            statistics = parse(Statistics.read, content)
    if statistics is None or not _complete(found, statistics, len(attachments), len(metadata)):
        return None
    found.counts = dict(statistics.channel_message_counts)
    found.chunks.sort(key=lambda c: c.offset)
    for entry in attachments:
        add_attachment(found, _record(data, entry.offset, 9))
    for item in metadata:
        found.metadata.append(parse(Metadata.read, _record(data, item.offset, 12)))
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
    chunk = chunk_at(_record(data, index.chunk_start_offset, 6), index.chunk_start_offset)
    return replace(
        chunk,
        first_ns=index.message_start_time,
        last_ns=index.message_end_time,
        indexes=dict(index.message_index_offsets),
    )

"""What was found in a file, and the parsing of single records of files that may be damaged."""

from __future__ import annotations

import mmap
import struct
import zlib
from collections.abc import Callable
from dataclasses import dataclass, field
from io import BytesIO
from pathlib import Path
from typing import TypeVar

import numpy as np
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.records import Attachment, Channel, Metadata, Schema
from numpy.typing import NDArray

from logs.chunks import ChunkRef
from logs.errors import LogError

PARSE_ERRORS = (McapError, struct.error, UnicodeDecodeError, ValueError, OverflowError, MemoryError)
"""What parsing a damaged record may raise."""

_CHUNK_HEAD = struct.Struct("<QQQII")
_COMPRESSIONS = {b"": "", b"lz4": "lz4", b"zstd": "zstd"}
_MOST_PROBLEMS = 20

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
                self.size = stream.seek(0, 2)
                if self.size:
                    self._map = mmap.mmap(stream.fileno(), 0, access=mmap.ACCESS_READ)
        except FileNotFoundError:
            raise LogError(path, "no such file", "check the name") from None
        except (OSError, ValueError) as error:
            raise LogError(path, f"cannot be read ({error})", "check that it is a readable file") from None
        if not self.size:
            raise LogError(path, "the file is empty", "record or import it again")
        self.view = memoryview(self._map)

    def find(self, pattern: bytes, start: int) -> int:
        """Return the first place of a pattern, -1 if there is none."""
        return self._map.find(pattern, start)


def parse(read: Callable[[ReadDataStream], R], content: memoryview) -> R:
    """Parse the content of a record with the ``read`` of its class; raises any of ``PARSE_ERRORS``."""
    return read(ReadDataStream(BytesIO(content)))


def chunk_at(content: memoryview, offset: int, truncated: bool = False) -> ChunkRef:
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


def add_attachment(found: Contents, content: memoryview) -> None:
    """Parse an attachment and check its sum, which covers all but itself."""
    attachment = parse(Attachment.read, content)
    names = len(attachment.name.encode()) + len(attachment.media_type.encode())
    end = 32 + names + len(attachment.data)  # the record may be padded behind its check sum
    (crc,) = struct.unpack_from("<I", content, end)
    if crc and zlib.crc32(content[:end]) != crc:
        found.report(f"The attachment {attachment.name!r} fails its check sum and was left out.")
        found.complete = False
        return
    found.attachments.append(attachment)

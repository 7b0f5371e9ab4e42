"""Reading a flight: ``open_flight(path)`` gives columns, messages, events and what was wrong with the file.

Numeric topics are read whole, through the message indexes: each chunk is decompressed once for all topics
asked for, its check sum validated, and the messages gathered without touching the others. Images and texts
stream through ``Flight.messages`` with at most a few chunks in memory.
"""

from __future__ import annotations

import struct
import zlib
from collections import OrderedDict
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.events import AUTOPILOT, EventBatch
from logs.chunks import ChunkError, ChunkRef, decompress, heads, index_by_walking
from logs.columns import Raw, decode
from logs.container import INDEX_ENTRY
from logs.definition import Definition, DefinitionError, parse
from logs.errors import LogError
from logs.events import EVENT_TOPICS, FOREIGN, events_of_series
from logs.recording import Recording, Series
from logs.scan import Contents, FileBytes, scan
from logs.topics import TOPICS
from logs.writer import CLOCKS, PROBLEMS

_LOOSE = -1
_CACHED_CHUNKS = 4
_CHUNK_SHIFT = 32
_NS = 1_000_000_000


@dataclass(frozen=True, slots=True)
class ChannelInfo:
    """One channel: a topic can have several, one for each source."""

    id: int
    topic: str
    message_type: str
    message_encoding: str
    schema_encoding: str
    schema: bytes
    clock: str
    clock_offset_ns: int
    count: int
    first_ns: int | None
    last_ns: int | None
    metadata: Mapping[str, str]


@dataclass(slots=True)
class LoggedMessage:
    """One message as it was logged; ``decoded`` is made when asked for."""

    channel: ChannelInfo
    log_time_ns: int
    publish_time_ns: int
    sequence: int
    data: bytes
    decoder: Callable[[bytes], Any] | None

    @property
    def topic(self) -> str:
        """The channel's topic."""
        return self.channel.topic

    @property
    def decoded(self) -> Any:
        """The message's fields as attributes, as ``mcap-ros2-support`` gives them.

        Raises:
            LogError: the message is not ROS 2 CDR, or is damaged.
        """
        if self.decoder is None:
            raise LogError(
                self.topic, f"encoded as {self.channel.message_encoding!r}", "read its data as bytes"
            )
        try:
            return self.decoder(self.data)
        except Exception as error:  # the generic decoder raises whatever its input provokes
            raise LogError(self.topic, f"a message is damaged ({error})", "recover the file") from error

    @property
    def stamp_ns(self) -> int:
        """The source's stamp in the channel's clock, from a leading header or time; the log time without
        one."""
        if len(self.data) < 12:
            return self.log_time_ns
        order = "<" if self.data[1] & 1 else ">"
        seconds, nanoseconds = struct.unpack_from(order + "iI", self.data, 4)
        return int(seconds * _NS + nanoseconds) - self.channel.clock_offset_ns


class Flight:
    """One log file, opened for reading; made by ``open_flight``."""

    def __init__(self, path: Path, data: FileBytes, contents: Contents) -> None:
        self.path = path
        self._data = data
        self._contents = contents
        self._problems = contents.problems
        self._indexes: dict[int, dict[int, NDArray[np.void]]] = {}
        self._chunks: OrderedDict[int, bytes | memoryview] = OrderedDict()
        self._bad: set[int] = set()
        self._series: dict[int, list[tuple[Series, NDArray[np.int64]]]] = {}
        self._decoders: dict[int, Callable[[bytes], Any] | None] = {}
        self._metadata = _merged(contents)
        self._channels: dict[int, ChannelInfo] | None = None
        self._walked = False
        if not contents.channels and not contents.chunks and not contents.loose and not contents.complete:
            self._problems.append("The file holds no messages that could be read.")

    @property
    def metadata(self) -> Mapping[str, Mapping[str, str]]:
        """The file's metadata records by name; records of one name are merged, the latest entry wins."""
        return MappingProxyType(self._metadata)

    @property
    def attachments(self) -> Mapping[str, tuple[str, bytes]]:
        """Media type and content of each attachment, by name."""
        return {a.name: (a.media_type, a.data) for a in self._contents.attachments}

    @property
    def profile(self) -> str:
        """The file's MCAP profile, ``ros2`` for ours."""
        return self._contents.profile

    @property
    def complete(self) -> bool:
        """True where nothing of the file was found damaged or missing so far."""
        return self._contents.complete

    @property
    def problems(self) -> list[str]:
        """Sentences about what was wrong, with the file and with the flight that was recorded into it."""
        recorded = [text for _, text in sorted(self._metadata.get(PROBLEMS, {}).items())]
        return [*recorded, *self._problems]

    @property
    def clock_offsets_ns(self) -> dict[str, int]:
        """The constant of each clock: UTC stamp in the file less the source's stamp."""
        offsets = {}
        for clock, text in self._metadata.get(CLOCKS, {}).items():
            offset = _integer(text)
            if offset is not None:
                offsets[clock] = offset
        for channel in self._contents.channels.values():
            offset = _integer(channel.metadata.get("clock_offset_ns", ""))
            if offset is not None and "clock" in channel.metadata:
                offsets[channel.metadata["clock"]] = offset
        return offsets

    @property
    def channels(self) -> list[ChannelInfo]:
        """Every channel with its count and its first and last log time."""
        return list(self._channel_infos().values())

    @property
    def topics(self) -> dict[str, list[ChannelInfo]]:
        """The channels of each topic that has messages."""
        found: dict[str, list[ChannelInfo]] = {}
        for info in self.channels:
            if info.count:
                found.setdefault(info.topic, []).append(info)
        return found

    def series(self, topic: str) -> list[Series]:
        """Return a topic's messages as columns: one series for each source, and each layout of its messages.

        Stamps are the source's own. An absent topic gives an empty list.

        Raises:
            LogError: the topic's messages are not ROS 2 CDR, or have no columns (images).
        """
        return [series for series, _ in self._load([topic])]

    def load(self, topics: Iterable[str]) -> dict[str, list[Series]]:
        """Return the columns of several topics, each chunk read once for all of them."""
        wanted = list(topics)
        found: dict[str, list[Series]] = {topic: [] for topic in wanted}
        for series, _ in self._load(wanted):
            found[series.topic].append(series)
        return found

    def events(self) -> EventBatch:
        """Return the events of all sensor topics, in the order of their arrival (equal ones as in the
        file)."""
        loaded = self._load([t for t in EVENT_TOPICS if t in self.topics])
        return events_of_series([s for s, _ in loaded], [places for _, places in loaded])

    def recording(self) -> Recording:
        """Return everything that has columns as a ``Recording``; images and other media stay in the file."""
        numeric = [t for t in self.topics if self._columnar(t)]
        return Recording(
            [s for s, _ in self._load(numeric)],
            self.clock_offsets_ns,
            {n: dict(m) for n, m in self._metadata.items() if n not in (CLOCKS, PROBLEMS)},
            dict(self.attachments),
            self.problems,
        )

    def messages(
        self,
        topics: Iterable[str] | None = None,
        start_ns: int | None = None,
        end_ns: int | None = None,
    ) -> Iterator[LoggedMessage]:
        """Yield messages in the order of their log times, ``start_ns`` included, ``end_ns`` not."""
        wanted = None if topics is None else set(topics)
        infos = {n: c for n, c in self._channel_infos().items() if wanted is None or c.topic in wanted}
        chunks, offsets = self._order(infos, start_ns, end_ns)
        for chunk, offset in zip(chunks.tolist(), offsets.tolist(), strict=True):
            records = self._records(chunk)
            if records is None:
                continue
            head = heads(records, np.array([offset], dtype=np.int64))
            if head is None or int(head["channel"][0]) not in infos:
                continue
            channel = int(head["channel"][0])
            size = int(head["length"][0]) - 22
            data = bytes(records[offset + 31 : offset + 31 + size])
            yield LoggedMessage(
                infos[channel],
                int(head["log"][0]),
                int(head["publish"][0]),
                int(head["sequence"][0]),
                data,
                self._decoder(channel),
            )

    def verify(self) -> bool:
        """Read the whole file and tell whether everything in it is sound; what is not goes to
        ``problems``."""
        for number in range(len(self._contents.chunks)):
            self._records(number)
        self._check_data_section()
        return self._contents.complete

    def _check_data_section(self) -> None:
        end = self._data.size
        view = self._data.view
        if not self._contents.complete or self._contents.counts is None:
            return
        (summary_start,) = struct.unpack_from("<Q", view, end - 28)
        opcode, length = struct.unpack_from("<BQ", view, summary_start - 13)
        if opcode == 15 and length == 4:
            (crc,) = struct.unpack_from("<I", view, summary_start - 4)
            if crc and zlib.crc32(view[: summary_start - 13]) != crc:
                self._problems.append("The file fails its check sum: some of its bytes have changed.")
                self._contents.complete = False

    def _columnar(self, topic: str) -> bool:
        return all(_has_columns(c) for c in self.topics.get(topic, ()))

    def _load(self, topics: Iterable[str]) -> list[tuple[Series, NDArray[np.int64]]]:
        infos = self._channel_infos()
        names = list(dict.fromkeys(topics))
        wanted = [n for t in names for n, c in infos.items() if c.topic == t and c.count]
        for number in wanted:
            if not _has_columns(infos[number]):
                raise LogError(
                    self.path, f"topic {infos[number].topic!r} has no columns", "iterate over Flight.messages"
                )
        missing = [n for n in wanted if n not in self._series]
        if missing:
            self._read_columns(missing)
        return [pair for n in wanted for pair in self._series[n]]

    def _read_columns(self, channels: list[int]) -> None:
        infos = self._channel_infos()
        raw = {n: Raw() for n in channels}
        for chunk in [_LOOSE, *range(len(self._contents.chunks))]:
            index = self._index(chunk)
            present = [n for n in channels if n in index and len(index[n])]
            records = self._records(chunk) if present else None
            if records is None:
                continue
            for number in present:
                offsets, head = self._checked(records, index, number, chunk)
                raw[number].add(records, offsets, head, (chunk + 1) << _CHUNK_SHIFT)
        for number in channels:
            info = infos[number]
            definition = self._definition(info)
            found: list[tuple[Series, NDArray[np.int64]]] = []
            if definition is not None:
                metadata = _series_metadata(info)
                found, undecoded = decode(
                    raw[number], definition, info.topic, metadata, info.clock, info.clock_offset_ns
                )
                if undecoded:
                    self._problems.append(
                        f"{undecoded} messages of {info.topic} do not fit {info.message_type}."
                    )
            self._series[number] = found

    def _definition(self, info: ChannelInfo) -> Definition | None:
        try:
            return parse(info.message_type, info.schema.decode())
        except (DefinitionError, UnicodeDecodeError) as error:
            self._problems.append(f"{info.topic} cannot be decoded: {error}.")
            return None

    def _checked(
        self, records: bytes | memoryview, index: dict[int, NDArray[np.void]], channel: int, chunk: int
    ) -> tuple[NDArray[np.int64], NDArray[np.void]]:
        """Return offsets and heads of a channel's messages; an index that is wrong is made anew."""
        offsets = index[channel]["offset"].astype(np.int64)
        head = heads(records, offsets)
        if head is None or not (head["channel"] == channel).all():
            self._problems.append(f"The message index of chunk {chunk} is wrong and was made anew.")
            self._contents.complete = False
            self._indexes[chunk] = index_by_walking(records)
            offsets = self._indexes[chunk].get(channel, np.empty(0, INDEX_ENTRY))["offset"].astype(np.int64)
            head = heads(records, offsets)
        assert head is not None  # offsets come from walking whole records
        return offsets, head

    def _order(
        self, infos: Mapping[int, ChannelInfo], start_ns: int | None, end_ns: int | None
    ) -> tuple[NDArray[np.int64], NDArray[np.uint64]]:
        """Return chunks and offsets of the channels' messages, in the order of log times."""
        parts = []
        for chunk in [_LOOSE, *range(len(self._contents.chunks))]:
            index = self._index(chunk)
            for number in index:
                if number in infos and len(index[number]):
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

    def _records(self, number: int) -> bytes | memoryview | None:
        """Return a chunk's records (the file itself for loose messages), or None where it is damaged."""
        if number == _LOOSE:
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
            self._problems.append(_chunk_problem(chunk, error))
            return None
        self._chunks[number] = records
        while len(self._chunks) > _CACHED_CHUNKS:
            self._chunks.popitem(last=False)
        return records

    def _index(self, number: int) -> dict[int, NDArray[np.void]]:
        """Return a chunk's message indexes by channel, from the file or by walking its records."""
        if number not in self._indexes:
            self._indexes[number] = self._contents.loose if number == _LOOSE else self._chunk_index(number)
        return self._indexes[number]

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
        records = self._records(number)
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

    def _channel_infos(self) -> dict[int, ChannelInfo]:
        if self._channels is None:
            self._channels = self._count()
            promised = self._contents.counts
            found = {n: c.count for n, c in self._channels.items()}
            if promised is not None and any(found.get(n, 0) != k for n, k in promised.items()):
                # The indexes do not hold what the statistics count: believe the chunks alone.
                self._walked = True
                self._indexes.clear()
                self._channels = self._count()
                self._problems.append("The message indexes lack messages; the chunks were searched.")
                self._contents.complete = False
        return self._channels

    def _count(self) -> dict[int, ChannelInfo]:
        counts: dict[int, int] = {}
        first: dict[int, int] = {}
        last: dict[int, int] = {}
        for chunk in [_LOOSE, *range(len(self._contents.chunks))]:
            for number, entries in self._index(chunk).items():
                if not len(entries):
                    continue
                low, high = int(entries["log"].min()), int(entries["log"].max())
                counts[number] = counts.get(number, 0) + len(entries)
                first[number] = min(first.get(number, low), low)
                last[number] = max(last.get(number, high), high)
        unknown = sum(n for c, n in counts.items() if c not in self._contents.channels)
        if unknown:
            self._problems.append(f"{unknown} messages belong to channels whose description is lost.")
        infos = {}
        offsets = self.clock_offsets_ns
        for number, channel in self._contents.channels.items():
            schema = self._contents.schemas.get(channel.schema_id)
            clock = channel.metadata.get("clock", AUTOPILOT)
            infos[number] = ChannelInfo(
                number,
                channel.topic,
                schema.name if schema else "",
                channel.message_encoding,
                schema.encoding if schema else "",
                schema.data if schema else b"",
                clock,
                offsets.get(clock, 0) if "clock" in channel.metadata else 0,
                counts.get(number, 0),
                first.get(number),
                last.get(number),
                MappingProxyType(dict(channel.metadata)),
            )
        return infos

    def _decoder(self, number: int) -> Callable[[bytes], Any] | None:
        if number not in self._decoders:
            from mcap_ros2.decoder import DecoderFactory

            channel = self._contents.channels[number]
            schema = self._contents.schemas.get(channel.schema_id)
            try:
                made = DecoderFactory().decoder_for(channel.message_encoding, schema)
            except Exception:  # the parser of definitions raises its own errors and those of its helpers
                made = None
            self._decoders[number] = made
        return self._decoders[number]


def open_flight(path: str | Path) -> Flight:
    """Open a log for reading.

    Raises:
        LogError: there is no such file, it is empty, or no MCAP file. A damaged one is opened.
    """
    place = Path(path)
    data = FileBytes(place)
    return Flight(place, data, scan(place, data))


def _merged(contents: Contents) -> dict[str, dict[str, str]]:
    merged: dict[str, dict[str, str]] = {}
    for record in contents.metadata:
        merged.setdefault(record.name, {}).update(record.metadata)
    return merged


def _integer(text: str) -> int | None:
    try:
        return int(text)
    except ValueError:
        return None


def _has_columns(info: ChannelInfo) -> bool:
    media = info.message_type.endswith(("/Image", "/CompressedImage", "/CompressedVideo", "/PointCloud2"))
    return info.message_encoding == "cdr" and info.schema_encoding == "ros2msg" and not media


def _series_metadata(info: ChannelInfo) -> dict[str, str]:
    metadata = {k: v for k, v in info.metadata.items() if k not in ("clock", "clock_offset_ns")}
    if "clock" not in info.metadata:
        metadata["source"] = FOREIGN
    known = TOPICS.get(info.topic)
    if known is None or known.message_type != info.message_type:
        metadata["message_type"] = info.message_type
        metadata["message_definition"] = info.schema.decode(errors="replace")
    return metadata


def _chunk_problem(chunk: ChunkRef, error: ChunkError) -> str:
    span = (chunk.last_ns - chunk.first_ns) / _NS
    return f"The chunk at byte {chunk.offset} ({span:.1f} s of messages) is lost: it {error}."

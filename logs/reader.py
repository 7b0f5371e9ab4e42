"""Reading a flight: ``open_flight(path)`` gives columns, messages, events and what was wrong with the file.

Numeric topics are read whole, through the message indexes: each chunk is decompressed once for all topics
asked for, its check sum validated, and the messages gathered without touching the others. Images and texts
stream through ``Flight.messages`` with at most a few chunks in memory.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.events import EventBatch
from logs.channels import ChannelInfo, LoggedMessage, channel_infos, has_columns, series_metadata
from logs.columns import Raw, decode
from logs.contents import Contents, FileBytes
from logs.definition import Definition, DefinitionError, parse
from logs.errors import LogError
from logs.events import EVENT_TOPICS, events_of_series, fits
from logs.recording import Recording, Series
from logs.scan import scan
from logs.store import ChunkStore
from logs.writer import CLOCKS, PROBLEMS

_CHUNK_SHIFT = 32
_MESSAGE = struct.Struct("<BQHIQQ")


class Flight:
    """One log file, opened for reading; made by ``open_flight``."""

    def __init__(self, path: Path, data: FileBytes, contents: Contents) -> None:
        self.path = path
        self._data = data
        self._contents = contents
        self._store = ChunkStore(data, contents)
        self._series: dict[int, list[tuple[Series, NDArray[np.int64]]]] = {}
        self._decoders: dict[int, Callable[[bytes], Any] | None] = {}
        self._metadata = _merged(contents)
        self._channels: dict[int, ChannelInfo] | None = None
        if not contents.channels and not contents.chunks and not contents.loose and not contents.complete:
            self._contents.report("The file holds no messages that could be read.")

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
        return [*recorded, *self._contents.problems]

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
        """Return the events of all sensor topics in the order of arrival, equal ones as in the file."""
        loaded = self._load([t for t in EVENT_TOPICS if t in self.topics])
        for series, _ in loaded:
            if not fits(series):
                self._contents.report(f"{series.topic} is no sensor topic of ours: its columns are others.")
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
        chunks, offsets = self._store.order(infos, start_ns, end_ns)
        for chunk, offset in zip(chunks.tolist(), offsets.tolist(), strict=True):
            records = self._store.records(chunk)
            if records is None:
                continue
            if offset + _MESSAGE.size > len(records):
                continue
            opcode, length, channel, sequence, log_time, publish_time = _MESSAGE.unpack_from(records, offset)
            if opcode != 5 or channel not in infos or not 22 <= length <= len(records) - offset - 9:
                continue
            data = bytes(records[offset + _MESSAGE.size : offset + 9 + length])
            yield LoggedMessage(
                infos[channel], log_time, publish_time, sequence, data, partial(self._decoder, channel)
            )

    def verify(self) -> bool:
        """Read the whole file and tell whether all of it is sound; what is not goes to ``problems``."""
        for number in range(len(self._contents.chunks)):
            self._store.records(number)
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
                self._contents.report("The file fails its check sum: some of its bytes have changed.")
                self._contents.complete = False

    def _columnar(self, topic: str) -> bool:
        return all(has_columns(c) for c in self.topics.get(topic, ()))

    def _load(self, topics: Iterable[str]) -> list[tuple[Series, NDArray[np.int64]]]:
        infos = self._channel_infos()
        names = list(dict.fromkeys(topics))
        wanted = [n for t in names for n, c in infos.items() if c.topic == t and c.count]
        for number in wanted:
            if not has_columns(infos[number]):
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
        for chunk in self._store.numbers():
            index = self._store.index(chunk)
            present = [n for n in channels if n in index and len(index[n])]
            records = self._store.records(chunk) if present else None
            if records is None:
                continue
            for number in present:
                offsets, head = self._store.checked(records, chunk, number)
                raw[number].add(records, offsets, head, (chunk + 1) << _CHUNK_SHIFT)
        for number in channels:
            info = infos[number]
            definition = self._definition(info)
            found: list[tuple[Series, NDArray[np.int64]]] = []
            if definition is not None:
                metadata = series_metadata(info)
                found, undecoded = decode(
                    raw[number], definition, info.topic, metadata, info.clock, info.clock_offset_ns
                )
                if undecoded:
                    self._contents.report(
                        f"{undecoded} messages of {info.topic} do not fit {info.message_type}."
                    )
            self._series[number] = found

    def _definition(self, info: ChannelInfo) -> Definition | None:
        try:
            return parse(info.message_type, info.schema.decode())
        except (DefinitionError, UnicodeDecodeError) as error:
            self._contents.report(f"{info.topic} cannot be decoded: {error}.")
            return None

    def _channel_infos(self) -> dict[int, ChannelInfo]:
        if self._channels is None:
            self._channels = channel_infos(self._contents, self._store, self.clock_offsets_ns)
            promised = self._contents.counts
            found = {n: c.count for n, c in self._channels.items()}
            if promised is not None and any(found.get(n, 0) != k for n, k in promised.items()):
                # The indexes do not hold what the statistics count: believe the chunks alone.
                self._store.distrust_indexes()
                self._channels = channel_infos(self._contents, self._store, self.clock_offsets_ns)
                self._contents.report("The message indexes lack messages; the chunks were searched.")
                self._contents.complete = False
        return self._channels

    def _decoder(self, number: int) -> Callable[[bytes], Any] | None:
        if number not in self._decoders:
            from mcap_ros2.decoder import DecoderFactory

            channel = self._contents.channels[number]
            schema = self._contents.schemas.get(channel.schema_id)
            made = None
            if schema is not None and self._definition(self._channel_infos()[number]) is not None:
                try:
                    made = DecoderFactory().decoder_for(channel.message_encoding, schema)
                except Exception:  # its parser raises its own errors and those of its helpers
                    self._contents.report(f"{channel.topic} has a definition that cannot be decoded.")
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

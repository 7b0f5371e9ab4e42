"""Channels of a file and single messages of them, as the reader hands them out."""

from __future__ import annotations

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from estimation.events import AUTOPILOT
from logs.contents import Contents
from logs.errors import LogError
from logs.event_columns import FOREIGN
from logs.store import ChunkStore
from logs.topics import TOPICS

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
    find_decoder: Callable[[], Callable[[bytes], Any] | None]

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
        decoder = self.find_decoder()
        if decoder is None:
            raise LogError(
                self.topic, f"encoded as {self.channel.message_encoding!r}", "read its data as bytes"
            )
        try:
            return decoder(self.data)
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


def channel_infos(
    contents: Contents, store: ChunkStore, offsets: Mapping[str, int]
) -> dict[int, ChannelInfo]:
    """Return what is known of each channel, counting the messages of its indexes."""
    times: dict[int, list[NDArray[np.uint64]]] = {}
    for chunk in store.numbers():
        for number, entries in store.index(chunk).items():
            if len(entries):
                times.setdefault(number, []).append(entries["log"])
    logs = {number: np.concatenate(parts) for number, parts in times.items()}
    counts = {number: len(log) for number, log in logs.items()}
    first = {number: int(log.min()) for number, log in logs.items()}
    last = {number: int(log.max()) for number, log in logs.items()}
    unknown = sum(n for c, n in counts.items() if c not in contents.channels)
    if unknown:
        contents.report(f"{unknown} messages belong to channels whose description is lost.")
    infos = {}
    for number, channel in contents.channels.items():
        schema = contents.schemas.get(channel.schema_id)
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


def has_columns(info: ChannelInfo) -> bool:
    """Tell whether the channel's messages are ROS 2 CDR and no images or other media."""
    media = info.message_type.endswith(("/Image", "/CompressedImage", "/CompressedVideo", "/PointCloud2"))
    return info.message_encoding == "cdr" and info.schema_encoding == "ros2msg" and not media


def series_metadata(info: ChannelInfo) -> dict[str, str]:
    """Return the metadata of a channel's series; those of other programs name their source and definition."""
    metadata = {k: v for k, v in info.metadata.items() if k not in ("clock", "clock_offset_ns")}
    if "clock" not in info.metadata:
        metadata["source"] = FOREIGN
    known = TOPICS.get(info.topic)
    if known is None or known.message_type != info.message_type:
        metadata["message_type"] = info.message_type
        metadata["message_definition"] = info.schema.decode(errors="replace")
    return metadata

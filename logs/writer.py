"""Writing a flight: MCAP, profile ``ros2``, readable by any ROS 2 tool while it is still being written.

Stamps are kept: ``header.stamp`` is the source's stamp plus one constant for each clock. The constants are
in the metadata record ``deckfix.clocks`` and each channel names its clock, so that the reader gives the raw
stamps back. Nothing here reads a clock: all times come with the messages.

The file is a ROS 2 bag by itself: ``rosbags`` (``AnyReader([path])``),
``mcap_ros2.reader.read_ros2_messages`` and Foxglove open it as it is, without a ``metadata.yaml`` beside
it.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import ParamSpec, Self, TypeVar

import numpy as np
from numpy.typing import NDArray

from estimation.events import Event, Imu
from logs.bulk import Block, merged_chunks
from logs.cdr import FRAME_ID, STAMP_NANOSEC, STAMP_SEC, Columns, Layout, LayoutError, check_stamps, layout
from logs.container import Container, create
from logs.definition import parse
from logs.encode import encode
from logs.errors import LogError
from logs.event_columns import FOREIGN
from logs.events import series_of_event
from logs.recording import Recording, Series
from logs.topics import TOPICS, definition_text

CLOCKS = "deckfix.clocks"
PROBLEMS = "deckfix.problems"
LIBRARY = "deckfix"
UTC = "utc"
_SECOND_NS = 1_000_000_000
_CHUNK_BYTES = 1 << 20
_INCOMPRESSIBLE = ("CompressedImage", "CompressedVideo")

P = ParamSpec("P")
R = TypeVar("R")


class FlightWriter:
    """Writes one flight's log; a context manager, complete when it is left.

    The file is written in place, so that a killed process leaves all but the last second of it. Chunks are
    closed when they reach 1 MiB and, message by message, after each second of arrival time.

    Raises:
        LogError: the file exists and ``force`` is not set, or cannot be created or written.
    """

    def __init__(
        self, path: str | Path, *, force: bool = False, clock_offsets_ns: Mapping[str, int] | None = None
    ) -> None:
        self.path = Path(path)
        self._file = create(self.path, force)
        self._container = Container(self._file, LIBRARY, chunk_size=_CHUNK_BYTES)
        self._offsets: dict[str, int] = {}
        self._channels: dict[tuple[object, ...], int] = {}
        self._schemas: dict[tuple[str, str, bytes], int] = {}
        self._layouts: dict[tuple[object, ...], Layout] = {}
        self._imus: dict[tuple[str, str], tuple[int, NDArray[np.void]]] = {}
        self._flushed_ns: int | None = None
        if clock_offsets_ns:
            self.set_clocks(clock_offsets_ns)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        self.close()

    @property
    def clock_offsets_ns(self) -> dict[str, int]:
        """The constant of each clock used so far: UTC stamp in the file less the source's stamp."""
        return dict(self._offsets)

    def set_clocks(self, offsets_ns: Mapping[str, int]) -> None:
        """Fix the constants of clocks; a clock without one gets its first message's arrival less its stamp.

        Raises:
            ValueError: a clock has another constant already, with which messages were stamped.
        """
        for clock, offset in offsets_ns.items():
            if self._offsets.get(clock, offset) != offset:
                raise ValueError(f"the constant of clock {clock!r} is already {self._offsets[clock]} ns")
        new = {clock: int(offset) for clock, offset in offsets_ns.items() if clock not in self._offsets}
        if new:
            self._offsets.update(new)
            self.add_metadata(CLOCKS, {clock: str(offset) for clock, offset in self._offsets.items()})

    def write_recording(self, recording: Recording) -> None:
        """Write a whole recording: clocks, metadata, attachments and its series, merged by arrival.

        Series of equal arrival keep the recording's order.
        """
        self.set_clocks(recording.clock_offsets_ns)
        for name, entries in recording.metadata.items():
            self.add_metadata(name, entries)
        for name, (media_type, data) in recording.attachments.items():
            self.add_attachment(name, media_type, data)
        if recording.problems:
            problems = {f"{i:04d}": text for i, text in enumerate(recording.problems)}
            self.add_metadata(PROBLEMS, problems)
        self.write_series(*recording.series)

    def write_series(self, *series: Series) -> None:
        """Write series in bulk, merged by arrival.

        Raises:
            LogError: a topic is unknown and names no message type (metadata ``message_type``), columns do not
                fit it, or a time cannot be stored: found before any message is written; or the disk fails.
        """
        blocks = [self._block(s) for s in series if len(s)]
        if not blocks:
            return
        self._guard(self._container.flush)
        for records, entries in merged_chunks(blocks, _CHUNK_BYTES):
            self._guard(self._container.write_chunk, records, entries)

    def write_event(self, event: Event) -> None:
        """Write one sensor event, as its topic's message; what ``logs.events`` reads back is this event."""
        if isinstance(event, Imu):
            self._write_imu(event)
            return
        for series in series_of_event(event):
            self._write_row(series)

    def write_message(
        self,
        topic: str,
        message: object,
        *,
        arrival_ns: int,
        stamp_ns: int | None = None,
        clock: str = "autopilot",
        frame_id: str | None = None,
        message_type: str | None = None,
        metadata: Mapping[str, str] | None = None,
    ) -> None:
        """Write one message of any layout: a mapping (or object) of its fields, the header excepted, or its
        CDR.

        ``stamp_ns`` is the source's, in ``clock``; without it the message is stamped with its arrival, in the
        clock ``utc``, whose constant is zero. For messages given as bytes the header is taken as it is.

        Raises:
            LogError: the type is unknown, or the message does not fit it.
        """
        known = TOPICS.get(topic)
        kind = message_type or (known.message_type if known else None)
        if kind is None:
            raise LogError(self.path, f"topic {topic!r} has no message type", "name its message_type")
        if stamp_ns is None:
            clock = UTC
            self.set_clocks({UTC: 0})
        stamp = arrival_ns if stamp_ns is None else stamp_ns
        offset = self._offset(clock, stamp, arrival_ns)
        channel = self._channel(topic, kind, self._clocked(clock, metadata or {}))
        if isinstance(message, bytes | bytearray | memoryview):
            data = bytes(message)
        else:
            frame = frame_id if frame_id is not None else (known.frame_id if known else "")
            data = self._encode(kind, message, stamp + offset, frame)
        compress = not kind.endswith(_INCOMPRESSIBLE)
        self._add(channel, arrival_ns, stamp + offset, data, compress)

    def open_channel(
        self,
        topic: str,
        message_encoding: str,
        schema: tuple[str, str, bytes] | None,
        metadata: Mapping[str, str],
    ) -> int:
        """Return the id of a channel for ``write_raw``; ``schema`` is (name, encoding, data)."""
        key = (topic, message_encoding, schema, tuple(sorted(metadata.items())))
        if key not in self._channels:
            number = 0
            if schema is not None:
                if schema not in self._schemas:
                    self._schemas[schema] = self._guard(self._container.add_schema, *schema)
                number = self._schemas[schema]
            self._channels[key] = self._guard(
                self._container.add_channel, topic, message_encoding, number, metadata
            )
        return self._channels[key]

    def write_raw(
        self, channel: int, arrival_ns: int, publish_ns: int, data: bytes, *, compress: bool = True
    ) -> None:
        """Pass a message of another file through, unchanged."""
        self._add(channel, arrival_ns, publish_ns, data, compress)

    def add_metadata(self, name: str, entries: Mapping[str, str]) -> None:
        """Write a metadata record."""
        self._guard(self._container.add_metadata, name, entries)

    def add_attachment(self, name: str, media_type: str, data: bytes) -> None:
        """Write an attachment."""
        self._guard(self._container.add_attachment, name, media_type, data)

    def flush(self, *, sync: bool = False) -> None:
        """Write what is held back, so that it survives the process, and with ``sync`` the loss of power.

        Messages flush by themselves as later ones arrive; call this when a recording falls silent.
        """
        self._guard(self._container.flush)
        if sync:
            self._guard(os.fsync, self._file.fileno())
        self._flushed_ns = None

    def close(self) -> None:
        """Complete the file; closing twice does nothing."""
        if self._file.closed:
            return
        try:
            self._guard(self._container.finish)
        finally:
            self._file.close()

    def _add(self, channel: int, arrival_ns: int, publish_ns: int, data: bytes, compress: bool) -> None:
        if arrival_ns < 0 or arrival_ns >= 1 << 64:
            raise LogError(self.path, f"arrival {arrival_ns} ns is before 1970", "check the log's clock")
        publish = publish_ns if 0 <= publish_ns < 1 << 64 else arrival_ns
        self._guard(self._container.add, channel, arrival_ns, publish, data, compress)
        if self._flushed_ns is None:
            self._flushed_ns = arrival_ns
        elif abs(arrival_ns - self._flushed_ns) >= _SECOND_NS:
            self.flush()

    def _write_row(self, series: Series) -> None:
        offset = self._offset(series.clock, int(series.stamp_ns[0]), int(series.arrival_ns[0]))
        channel, built = self._prepare(series)
        stamp = series.stamp_ns + offset
        data = self._pack(built, stamp, series.data).tobytes()
        self._add(channel, int(series.arrival_ns[0]), int(stamp[0]), data, True)

    def _write_imu(self, event: Imu) -> None:
        """Write the sample of an IMU by changing the last one: at its rate the general way is too slow
        onboard.
        """
        key = (event.sensor, event.clock)
        if key not in self._imus:
            (series,) = series_of_event(event)
            self._offset(event.clock, event.stamp_ns, event.arrival_ns)
            channel, built = self._prepare(series)
            self._imus[key] = channel, self._pack(built, np.zeros(1, np.int64), series.data)
        channel, message = self._imus[key]
        stamp = event.stamp_ns + self._offsets[event.clock]
        seconds, message[STAMP_NANOSEC] = divmod(stamp, _SECOND_NS)
        if not -(2**31) <= seconds < 2**31:
            raise LogError(
                self.path, "a stamp is outside the years 1901 to 2038", "check the clock's constant"
            )
        message[STAMP_SEC] = seconds
        message["angular_velocity"] = event.angular_velocity_radps
        message["linear_acceleration"] = event.specific_force_mps2
        self._add(channel, event.arrival_ns, stamp, message.tobytes(), True)

    def _block(self, series: Series) -> Block:
        offset = self._offset(series.clock, int(series.stamp_ns[0]), int(series.arrival_ns[0]))
        if int(series.arrival_ns.min()) < 0:
            raise LogError(self.path, f"{series.topic} has arrivals before 1970", "check the log's clock")
        if not len(series.stamp_ns) == len(series.arrival_ns) == len(series.data):
            raise LogError(self.path, f"{series.topic} has columns of unequal length", "correct the importer")
        channel, built = self._prepare(series)
        if built.columns and series.data.dtype.names is None:
            raise LogError(self.path, f"{series.topic} has no columns", "give it a structured array")
        if built.stamped:
            try:
                check_stamps(series.stamp_ns + offset)
            except LayoutError as error:
                raise LogError(self.path, str(error), "check the stamps and the clock's constant") from None
        return Block(channel, built, series, offset, np.argsort(series.arrival_ns, kind="stable"))

    def _prepare(self, series: Series) -> tuple[int, Layout]:
        known = TOPICS.get(series.topic)
        metadata = dict(series.metadata)
        kind = metadata.pop("message_type", None) or (known.message_type if known else None)
        if kind is None:
            raise LogError(
                self.path,
                f"topic {series.topic!r} has no message type",
                "name it in metadata['message_type']",
            )
        text = metadata.pop("message_definition", None)
        frame = series.frame_id or (known.frame_id if known else "")
        strings = {**(known.strings if known else {}), **series.strings, FRAME_ID: frame}
        key = (kind, text, series.data.dtype, tuple(sorted(strings.items())))
        if key not in self._layouts:
            try:
                definition = parse(kind, text if text is not None else definition_text(kind))
                built = layout(definition, Columns(series.data.dtype, strings))
                missing = set(built.columns) - set(series.data.dtype.names or ())
                if missing:
                    raise LayoutError(f"column {sorted(missing)[0]!r} is missing")
            except KeyError:
                raise LogError(
                    self.path, f"message type {kind!r} is unknown", "give its definition"
                ) from None
            except ValueError as error:
                raise LogError(
                    self.path, f"{series.topic}: {error}", "see logs.topics for the columns"
                ) from None
            self._layouts[key] = built
        channel = self._channel(series.topic, kind, self._clocked(series.clock, metadata), text)
        return channel, self._layouts[key]

    def _channel(self, topic: str, kind: str, metadata: Mapping[str, str], text: str | None = None) -> int:
        try:
            definition = definition_text(kind) if text is None else text
        except KeyError:
            raise LogError(self.path, f"message type {kind!r} is unknown", "give its definition") from None
        return self.open_channel(topic, "cdr", (kind, "ros2msg", definition.encode()), metadata)

    def _clocked(self, clock: str, metadata: Mapping[str, str]) -> dict[str, str]:
        """Name the clock and its constant, which a damaged file may hold nowhere else."""
        if metadata.get("source") == FOREIGN:
            return dict(metadata)
        return {"clock": clock, "clock_offset_ns": str(self._offsets[clock]), **metadata}

    def _offset(self, clock: str, stamp_ns: int, arrival_ns: int) -> int:
        if clock not in self._offsets:
            self.set_clocks({clock: arrival_ns - stamp_ns})
        return self._offsets[clock]

    def _pack(self, built: Layout, stamp_ns: NDArray[np.int64], data: NDArray[np.void]) -> NDArray[np.void]:
        try:
            return built.pack(stamp_ns, data)
        except ValueError as error:
            raise LogError(self.path, str(error), "check the stamps and the clock's constant") from None

    def _encode(self, kind: str, message: object, stamp_ns: int, frame_id: str) -> bytes:
        definition = parse(kind, definition_text(kind))
        first = definition.fields[definition.name][0]
        seconds, nanoseconds = divmod(stamp_ns, _SECOND_NS)
        stamp = {"sec": seconds, "nanosec": nanoseconds}
        fields = dict(message) if isinstance(message, Mapping) else dict(vars(message))
        if first.type == "std_msgs/Header":
            fields.setdefault(first.name, {"stamp": stamp, "frame_id": frame_id})
        elif first.type == "builtin_interfaces/Time":
            fields.setdefault(first.name, stamp)
        try:
            return encode(definition, fields)
        except LayoutError as error:
            raise LogError(self.path, str(error), "see logs.topics for the message's fields") from None

    def _guard(self, call: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return call(*args, **kwargs)
        except OSError as error:
            raise LogError(
                self.path, f"cannot be written ({error.strerror})", "free space or choose another place"
            ) from error

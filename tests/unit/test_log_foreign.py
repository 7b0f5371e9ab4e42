"""Logs that other programs wrote: the MCAP conformance files, ROS 2 writers, files without chunks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import CompressionType, IndexType, Writer
from mcap_ros2.writer import Writer as Ros2Writer

from logs import FlightWriter, open_flight
from logs.definition import parse
from logs.encode import encode
from logs.recover import recover
from logs.topics import definition_text

IMU = "sensor_msgs/msg/Imu"
COUNTS = {
    "NoData": (0, 0, 0),
    "OneAttachment": (0, 1, 0),
    "OneMessage": (1, 0, 0),
    "OneMetadata": (0, 0, 1),
    "OneSchemalessMessage": (1, 0, 0),
    "TenMessages": (10, 0, 0),
}
"""Messages, attachments and metadata records that the name of a conformance file promises."""


def test_all_conformance_files_are_read(data_dir: Path, tmp_path: Path) -> None:
    files = sorted((data_dir / "mcap_conformance").glob("*.mcap"))
    assert len(files) >= 44
    for file in files:
        flight = open_flight(file)
        messages, attachments, metadata = COUNTS[file.stem.split("-")[0]]
        found = list(flight.messages())
        assert len(found) == messages, file.name
        assert sum(c.count for c in flight.channels) == messages
        assert len(flight.attachments) == attachments
        assert len(flight.metadata) == metadata
        assert flight.verify()
        assert flight.problems == []
        if messages:
            assert flight.topics.keys() == {"example"}
            assert found[0].data == bytes([1, 2, 3])
            assert found[0].channel.message_type == ("" if "Schemaless" in file.name else "Example")
        report = recover(file, tmp_path / file.name)
        assert report.messages == messages
        assert report.lost_bytes == 0
        copied = open_flight(tmp_path / file.name)
        assert [m.data for m in copied.messages()] == [m.data for m in found]
        assert copied.attachments == flight.attachments
        assert copied.metadata == flight.metadata


def imu(i: int, frame: str) -> dict[str, Any]:
    return {
        "header": {"stamp": {"sec": i, "nanosec": 7}, "frame_id": frame},
        "linear_acceleration": {"x": float(i), "y": 0.5, "z": -9.8},
    }


@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_ros2_writer_with_changing_frames(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "f.mcap"
    with path.open("wb") as stream:
        writer = Ros2Writer(stream, chunk_size=2000, compression=compression)
        schema = writer.register_msgdef(IMU, definition_text(IMU))
        for i in range(100):
            frame = "base_link" if i % 3 else "imu_link_with_a_longer_name"
            writer.write_message("/imu", schema, imu(i, frame), log_time=i * 1000 + 1)
        writer.finish()
    flight = open_flight(path)
    parts = flight.series("/imu")
    assert [p.frame_id for p in parts] == ["imu_link_with_a_longer_name", "base_link"]
    assert [len(p) for p in parts] == [34, 66]
    for part in parts:
        seconds = part.data["linear_acceleration"][:, 0]
        assert np.array_equal(part.stamp_ns, seconds.astype(np.int64) * 10**9 + 7)
        assert np.array_equal(part.arrival_ns, seconds.astype(np.int64) * 1000 + 1)
    # Events are in the order of arrival, whatever the frame.
    assert flight.events().rows["value"][:, 3].tolist() == list(range(100))
    assert flight.problems == []


@pytest.mark.parametrize("indexes", [IndexType.ALL, IndexType.NONE, IndexType.CHUNK])
@pytest.mark.parametrize("chunked", [True, False])
def test_files_without_indexes_or_chunks(tmp_path: Path, indexes: IndexType, chunked: bool) -> None:
    path = tmp_path / "f.mcap"
    text = definition_text(IMU)
    with path.open("wb") as stream:
        writer = Writer(stream, chunk_size=3000, index_types=indexes, use_chunking=chunked)
        writer.start("ros2", "test")
        schema = writer.register_schema(IMU, "ros2msg", text.encode())
        channel = writer.register_channel("/imu", "cdr", schema)
        for i in range(50):
            writer.add_message(channel, 10 + i, encode(parse(IMU, text), imu(i, "a")), 10 + i)
        writer.add_metadata("note", {"a": "b"})
        writer.finish()
    flight = open_flight(path)
    assert flight.problems == []
    assert flight.metadata["note"] == {"a": "b"}
    (series,) = flight.series("/imu")
    assert series.data["linear_acceleration"][:, 0].tolist() == list(range(50))
    assert [m.log_time_ns for m in flight.messages()] == list(range(10, 60))
    assert [m.decoded.linear_acceleration.x for m in flight.messages(start_ns=20, end_ns=22)] == [10, 11]
    assert recover(path, tmp_path / "g.mcap").messages == 50
    assert len(open_flight(tmp_path / "g.mcap").events()) == 50


def test_many_texts_are_joined_and_stay_readable_as_messages(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    with FlightWriter(path) as writer:
        for i in range(200):
            writer.write_message("/log", {"level": i % 50, "msg": f"text {'x' * (i % 80)} {i}"}, arrival_ns=i)
    flight = open_flight(path)
    (series,) = flight.series("/log")
    assert series.data["level"].tolist() == [i % 50 for i in range(200)]
    assert "msg" not in series.strings
    assert [m.decoded.msg.split()[-1] for m in flight.messages()][:3] == ["0", "1", "2"]


def test_messages_that_do_not_fit_their_definition_are_said(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    with FlightWriter(path) as writer:
        writer.write_message("/baro", {"fluid_pressure": 1.0}, arrival_ns=1)
        writer.write_message("/baro", b"\0\1\0\0\0", arrival_ns=2, clock="utc", stamp_ns=2)
        writer.write_message("/baro", b"", arrival_ns=3, clock="utc", stamp_ns=3)
    flight = open_flight(path)
    assert [len(s) for s in flight.series("/baro")] == [1]
    assert flight.problems == ["2 messages of /baro do not fit sensor_msgs/msg/FluidPressure."]

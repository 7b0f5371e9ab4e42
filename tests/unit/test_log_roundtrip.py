"""What is written is read back to the bit, by us and by the tools that others use."""

from __future__ import annotations

import random
import sys
import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from mcap_ros2.reader import read_ros2_messages
from rosbags.highlevel import AnyReader

from logs import FlightWriter, LogError, Series, open_flight
from logs.topics import TOPICS, new_rows

sys.path.insert(0, str(Path(__file__).parent))
from log_samples import UTC, flight, same, series

JPEG = bytes(range(256)) * 40


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A recording with sensors, images, texts and transforms."""
    place = tmp_path / "flight.mcap"
    with FlightWriter(place) as writer:
        writer.write_recording(flight())
        for i in range(30):
            arrival = UTC + i * 33_000_000
            writer.write_message(
                "/camera/image/compressed",
                {"format": "jpeg", "data": JPEG[i:]},
                arrival_ns=arrival,
                stamp_ns=77 + i * 33_000_000,
                clock="camera",
            )
        writer.write_message("/log", {"level": 20, "name": "mode", "msg": "TRACKING"}, arrival_ns=UTC)
        writer.write_message("/log", {"level": 30, "msg": "target lost"}, arrival_ns=UTC + 1)
    return place


def test_columns_come_back_to_the_bit(path: Path) -> None:
    written, opened = flight(), open_flight(path)
    assert opened.complete
    assert opened.verify()
    assert opened.problems == ["The compass was calibrated in flight."]
    assert opened.clock_offsets_ns["autopilot"] == UTC
    assert opened.metadata["deckfix.vehicle"] == {"name": "raft <lander>"}
    assert opened.attachments["params.txt"] == ("text/plain", b"INS_GYRO_FILTER 20\n")
    for one in written.series:
        (back,) = opened.series(one.topic)
        same(one, back)
        assert back.metadata == one.metadata
        assert back.frame_id == TOPICS[one.topic].frame_id


def test_a_recording_read_and_written_again_is_the_same(path: Path, tmp_path: Path) -> None:
    first = open_flight(path).recording()
    with FlightWriter(tmp_path / "again.mcap") as writer:
        writer.write_recording(first)
    again = open_flight(tmp_path / "again.mcap").recording()
    assert again.metadata == first.metadata
    assert again.attachments == first.attachments
    assert again.problems == first.problems
    assert again.clock_offsets_ns == first.clock_offsets_ns
    assert len(again.series) == len(first.series)
    for a, b in zip(first.series, again.series, strict=True):
        same(a, b)
        assert (a.strings, a.frame_id, a.metadata) == (b.strings, b.frame_id, b.metadata)


def test_stock_readers_read_every_message(path: Path) -> None:
    expected = {s.topic: len(s) for s in flight().series}
    expected |= {"/camera/image/compressed": 30, "/log": 2}
    counted: dict[str, int] = {}
    stamps: list[int] = []
    for message in read_ros2_messages(str(path)):
        counted[message.channel.topic] = counted.get(message.channel.topic, 0) + 1
        if message.channel.topic == "/imu":
            stamp = message.ros_msg.header.stamp
            stamps.append(stamp.sec * 10**9 + stamp.nanosec)
            assert message.ros_msg.header.frame_id == "base_link_frd"
    assert counted == expected
    assert np.array_equal(np.array(stamps) - UTC, flight().series[0].stamp_ns)
    with path.open("rb") as stream:
        # Every check sum, the data section's included, holds for the reference implementation.
        records = [r for r in StreamReader(stream, validate_crcs=True).records if isinstance(r, Message)]
    assert len(records) == sum(expected.values())
    with path.open("rb") as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == sum(expected.values())
    for chunk in summary.chunk_indexes:
        assert chunk.uncompressed_size <= 1 << 20


def test_bulk_messages_stand_in_the_order_of_arrival(tmp_path: Path) -> None:
    with FlightWriter(tmp_path / "f.mcap") as writer:
        writer.write_recording(flight(60.0))
    with (tmp_path / "f.mcap").open("rb") as stream:
        times = [r.log_time for r in StreamReader(stream).records if isinstance(r, Message)]
    assert times == sorted(times)
    assert [m.log_time_ns for m in open_flight(tmp_path / "f.mcap").messages()] == times


def test_rosbags_reads_it_as_a_ros2_bag(path: Path) -> None:
    imu = flight().series[0]
    with AnyReader([path]) as bag:
        connections = [c for c in bag.connections if c.topic == "/imu"]
        found: list[Any] = [bag.deserialize(raw, c.msgtype) for c, _, raw in bag.messages(connections)]
        assert bag.message_count == sum(len(s) for s in flight().series) + 32
        for connection, _, raw in bag.messages():
            assert bag.deserialize(raw, connection.msgtype) is not None
    assert len(found) == len(imu)
    assert found[7].linear_acceleration.z == imu.data["linear_acceleration"][7, 2]
    assert np.array_equal(found[7].orientation_covariance, imu.data["orientation_covariance"][7])


def test_images_stream_and_keep_their_clock(path: Path) -> None:
    opened = open_flight(path)
    messages = list(opened.messages(["/camera/image/compressed"], start_ns=UTC + 1))
    assert len(messages) == 29
    assert messages[0].decoded.data == JPEG[1:]
    assert messages[0].decoded.format == "jpeg"
    assert messages[0].stamp_ns == 77 + 33_000_000
    assert messages[0].channel.clock == "camera"
    with pytest.raises(LogError, match="has no columns"):
        opened.series("/camera/image/compressed")
    texts = [m.decoded.msg for m in opened.messages(["/log"])]
    assert texts == ["TRACKING", "target lost"]
    assert [s.strings["msg"] for s in opened.series("/log")] == texts


def test_image_chunks_are_not_compressed_and_numbers_are(path: Path) -> None:
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    images = {i for i, c in summary.channels.items() if c.topic == "/camera/image/compressed"}
    for chunk in summary.chunk_indexes:
        assert (chunk.compression == "") == bool(images & set(chunk.message_index_offsets))


def test_nothing_is_overwritten_without_force(path: Path) -> None:
    before = path.read_bytes()
    with pytest.raises(LogError, match=r"the file exists; choose another name or use --force"):
        FlightWriter(path)
    assert path.read_bytes() == before
    with FlightWriter(path, force=True):
        pass
    assert open_flight(path).channels == []


@pytest.mark.parametrize(
    ("data", "said"),
    [(None, "no such file; check the name"), (b"", "the file is empty; record or import it again")],
)
def test_a_file_that_holds_nothing_is_told_in_one_line(tmp_path: Path, data: bytes | None, said: str) -> None:
    path = tmp_path / "f.mcap"
    if data is not None:
        path.write_bytes(data)
    with pytest.raises(LogError) as caught:
        open_flight(path)
    assert str(caught.value) == f"{path}: {said}"


def test_a_missing_folder_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(LogError, match="cannot be created") as caught:
        FlightWriter(tmp_path / "no" / "f.mcap")
    assert "\n" not in str(caught.value)


def test_one_channel_for_each_sensor_of_a_topic(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    pair = [series("/imu", 50, 2, rng, sensor=name) for name in ("imu", "imu2")]
    with FlightWriter(tmp_path / "f.mcap", clock_offsets_ns={"autopilot": UTC}) as writer:
        writer.write_series(*pair)
    opened = open_flight(tmp_path / "f.mcap")
    assert [c.metadata["sensor"] for c in opened.topics["/imu"]] == ["imu", "imu2"]
    for one, back in zip(pair, opened.series("/imu"), strict=True):
        same(one, back)
    batch = opened.events()
    assert batch.sensors == ("imu", "imu2")
    # At equal arrivals the order in the file decides, which is the order of the series.
    assert batch.rows["sensor"].tolist() == [0, 1] * 100


def test_a_clock_without_a_constant_gets_one_from_its_first_message(tmp_path: Path) -> None:
    one = series("/baro", 10, 1, np.random.default_rng(0), clock="companion")
    with FlightWriter(tmp_path / "f.mcap") as writer:
        writer.write_series(one)
        with pytest.raises(ValueError, match="already"):
            writer.set_clocks({"companion": 5})
    opened = open_flight(tmp_path / "f.mcap")
    assert opened.clock_offsets_ns == {"companion": UTC + 2_000_000}
    same(one, opened.series("/baro")[0])


def test_columns_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    one = series("/baro", 10, 1, np.random.default_rng(0))
    wrong = Series("/imu", one.stamp_ns, one.arrival_ns, one.data)
    unknown = Series("/what", one.stamp_ns, one.arrival_ns, one.data)
    early = Series("/baro", one.stamp_ns, one.arrival_ns - 2 * UTC, one.data)
    late = Series("/baro", one.stamp_ns + 2**62, one.arrival_ns, one.data)
    with FlightWriter(tmp_path / "f.mcap", clock_offsets_ns={"autopilot": UTC}) as writer:
        for bad, problem in (
            (wrong, "missing"),
            (unknown, "no message type"),
            (early, "before 1970"),
            (late, "2038"),
        ):
            with pytest.raises(LogError, match=problem):
                writer.write_series(bad)
        writer.write_series(one)
    same(one, open_flight(tmp_path / "f.mcap").series("/baro")[0])


def test_what_cannot_be_stored_is_refused_before_any_of_it_is_written(tmp_path: Path) -> None:
    # Several chunks of messages, the last of which is stamped beyond what a message can hold.
    long = series("/baro", 40_000, 1, np.random.default_rng(0))
    long.stamp_ns[-1] += 2**62
    short = series("/baro", 10, 1, np.random.default_rng(1))
    with FlightWriter(tmp_path / "f.mcap", clock_offsets_ns={"autopilot": UTC}) as writer:
        with pytest.raises(LogError, match="2038"):
            writer.write_series(long)
        writer.write_series(short)
    same(short, open_flight(tmp_path / "f.mcap").series("/baro")[0])


def test_any_series_with_a_definition_of_its_own_is_written(tmp_path: Path) -> None:
    data = np.zeros(3, dtype=[("depth", "f4"), ("beams", "u2", (2,))])
    data["depth"] = [1, 2, 3]
    stamp = np.arange(3, dtype=np.int64)
    text = (
        "std_msgs/Header header\nfloat32 depth\nuint16[] beams\n"
        + TOPICS["/baro"].definition.partition("variance\n")[2]
    )
    metadata = {"message_type": "sonar_msgs/msg/Echo", "message_definition": text}
    with FlightWriter(tmp_path / "f.mcap", clock_offsets_ns={"autopilot": UTC}) as writer:
        writer.write_series(Series("/sonar", stamp, stamp + UTC, data, metadata=metadata))
    (back,) = open_flight(tmp_path / "f.mcap").series("/sonar")
    assert back.data.tobytes() == data.tobytes()
    assert back.metadata == metadata
    assert [m.ros_msg.beams for m in read_ros2_messages(str(tmp_path / "f.mcap"))] == [[0, 0]] * 3


def test_other_encodings_pass_through_unchanged(tmp_path: Path) -> None:
    with FlightWriter(tmp_path / "f.mcap") as writer:
        channel = writer.open_channel("/custom", "json", ("thing", "jsonschema", b"{}"), {"a": "b"})
        writer.write_raw(channel, UTC, UTC, b'{"x": 1}')
        assert writer.open_channel("/custom", "json", ("thing", "jsonschema", b"{}"), {"a": "b"}) == channel
    opened = open_flight(tmp_path / "f.mcap")
    (message,) = opened.messages()
    assert message.data == b'{"x": 1}'
    assert message.channel.metadata == {"a": "b"}
    with pytest.raises(LogError, match="json"):
        _ = message.decoded
    with pytest.raises(LogError, match="no columns"):
        opened.series("/custom")
    assert opened.recording().series == []


def test_messages_that_do_not_fit_are_refused(tmp_path: Path) -> None:
    with FlightWriter(tmp_path / "f.mcap") as writer:
        for topic, message, problem in (
            ("/log", {"text": "x"}, "no field 'text'"),
            ("/log", {"level": 256}, "cannot hold"),
            ("/unknown", {}, "no message type"),
        ):
            with pytest.raises(LogError, match=problem):
                writer.write_message(topic, message, arrival_ns=UTC)
        with pytest.raises(LogError, match="before 1970"):
            writer.write_message("/log", {}, arrival_ns=-1)


def test_an_error_within_leaves_a_complete_file(tmp_path: Path) -> None:
    def record() -> None:
        with FlightWriter(tmp_path / "f.mcap") as writer:
            writer.write_message("/log", {"msg": "a"}, arrival_ns=UTC)
            raise RuntimeError("the camera fell off")

    with pytest.raises(RuntimeError, match="fell off"):
        record()
    opened = open_flight(tmp_path / "f.mcap")
    assert opened.complete
    assert [m.decoded.msg for m in opened.messages()] == ["a"]


def test_a_silent_recording_is_readable_after_flush(tmp_path: Path) -> None:
    writer = FlightWriter(tmp_path / "f.mcap")
    writer.write_message("/log", {"msg": "a"}, arrival_ns=UTC)
    assert list(open_flight(tmp_path / "f.mcap").messages()) == []
    writer.flush(sync=True)
    assert open_flight(tmp_path / "f.mcap").channels[0].count == 1
    writer.close()
    writer.close()


def test_images_stream_in_bounded_memory(tmp_path: Path) -> None:
    path, size, count = tmp_path / "f.mcap", 200_000, 150
    content = random.Random(0).randbytes(size)
    with FlightWriter(path) as writer:
        for i in range(count):
            writer.write_message(
                "/camera/image/compressed", {"format": "jpeg", "data": content}, arrival_ns=UTC + i * 10**7
            )
    opened = open_flight(path)
    tracemalloc.start()
    try:
        total = sum(len(m.decoded.data) for m in opened.messages())
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert total == size * count
    assert peak < 0.3 * total


def test_hours_of_small_chunks_keep_little_memory(tmp_path: Path) -> None:
    path, count = tmp_path / "f.mcap", 2000
    with FlightWriter(path) as writer:

        def write(first: int, end: int) -> None:
            for i in range(first, end):
                for topic in ("/vision/image_a", "/vision/image_b", "/vision/image_c", "/vision/image_d"):
                    writer.write_message(
                        topic, {"format": "jpeg", "data": b"x"}, arrival_ns=UTC + i * 10**7,
                        message_type="sensor_msgs/msg/CompressedImage",
                    )  # fmt: skip
                writer.flush()

        write(0, 100)
        tracemalloc.start()
        try:
            write(100, count)
            grown, _ = tracemalloc.get_traced_memory()
        finally:
            tracemalloc.stop()
    assert grown < 200 * count
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert len(summary.chunk_indexes) == count
    assert summary.statistics is not None
    assert summary.statistics.chunk_count == count
    assert [len(c.message_index_offsets) for c in summary.chunk_indexes] == [4] * count


def test_series_of_zero_length_are_passed_over(tmp_path: Path) -> None:
    empty = Series("/imu", np.empty(0, np.int64), np.empty(0, np.int64), new_rows("/imu", 0))
    with FlightWriter(tmp_path / "f.mcap") as writer:
        writer.write_series(empty)
    assert open_flight(tmp_path / "f.mcap").events().rows.shape == (0,)

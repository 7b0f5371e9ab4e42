"""Damaged, truncated and interrupted logs: what can be read is read, the loss is said, nothing grows or
hangs.
"""

from __future__ import annotations

import random
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation.events import Event
from logs import FlightWriter, LogError, open_flight
from logs.chunks import LARGEST_CHUNK
from logs.events import events_of_series
from logs.recover import RECOVERED, recover

sys.path.insert(0, str(Path(__file__).parents[1] / "unit"))
from log_samples import UTC, flight

IMU_HZ = 200


class Sound(bytes):
    """The bytes of a file, without the bytes in the messages of failing tests."""

    def __repr__(self) -> str:
        return f"<{len(self)} bytes>"


@pytest.fixture(scope="module")
def sound(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """A small live recording: one chunk a second, images among the numbers."""
    path = tmp_path_factory.mktemp("sound") / "f.mcap"
    with FlightWriter(path, clock_offsets_ns={"autopilot": UTC}) as writer:
        for i, event in enumerate(_events(5.0)):
            writer.write_event(event)
            if i % 40 == 0:
                image = {"format": "jpeg", "data": random.Random(i).randbytes(3000)}
                writer.write_message("/camera/image/compressed", image, arrival_ns=event.arrival_ns)
        writer.add_metadata("note", {"a": "b"})
        writer.add_attachment("params", "text/plain", b"x" * 100)
    return Sound(path.read_bytes())


def _events(duration_s: float) -> list[Event]:
    return list(events_of_series(flight(duration_s).series))


def _read_everything(path: Path) -> tuple[int, list[str]]:
    """Touch all that a reader offers; return the number of messages and the problems."""
    opened = open_flight(path)
    count = sum(1 for _ in opened.messages())
    _ = opened.metadata, opened.attachments, opened.clock_offsets_ns, opened.topics
    opened.events()
    opened.recording()
    opened.verify()
    return count, opened.problems


@pytest.mark.parametrize("content", [b"", b"\x89MCAP0", b"%PDF-1.7 " + b"x" * 400, b"\xa3\x95\x80" * 90])
def test_empty_and_foreign_files_are_one_line(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "f.mcap"
    path.write_bytes(content)
    for call in (open_flight, lambda p: recover(p, tmp_path / "g.mcap")):
        with pytest.raises(LogError) as caught:
            call(path)
        assert re.fullmatch(r"[^\n]*f\.mcap: [^\n;]+; [^\n]+", str(caught.value))
    assert not (tmp_path / "g.mcap").exists()


def test_missing_files_and_folders_are_one_line(tmp_path: Path) -> None:
    for path in (tmp_path / "none.mcap", tmp_path):
        with pytest.raises(LogError):
            open_flight(path)


def test_every_truncation_keeps_whole_seconds(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    path.write_bytes(sound)
    whole = open_flight(path)
    total = sum(c.count for c in whole.channels)
    kept = []
    for cut in np.linspace(9, len(sound) - 1, 60).astype(int).tolist():
        path.write_bytes(sound[:cut])
        count, problems = _read_everything(path)
        assert problems, cut
        if count == 0:
            continue
        report = recover(path, tmp_path / "g.mcap", force=True)
        assert report.messages == count
        again, after = _read_everything(tmp_path / "g.mcap")
        assert (again, after) == (count, [])
        kept.append(count)
    assert len(kept) > 40
    assert kept == sorted(kept)
    assert kept[-1] == total


def test_a_damaged_chunk_is_left_out_and_said(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    path.write_bytes(sound)
    whole = open_flight(path)
    (imu,) = whole.series("/imu")
    damaged = bytearray(sound)
    place = sound.index(b"\x04\x00\x00\x00zstd", len(sound) // 2) + 200
    damaged[place] ^= 0x10
    path.write_bytes(damaged)
    opened = open_flight(path)
    (left,) = opened.series("/imu")
    assert 0 < len(imu) - len(left) <= IMU_HZ + 1
    assert set(left.stamp_ns.tolist()) < set(imu.stamp_ns.tolist())
    assert any("is lost" in p for p in opened.problems)
    assert not opened.complete
    report = recover(path, tmp_path / "g.mcap")
    assert report.damaged_chunks == 1
    assert report.lost_s is not None
    assert 0.5 < report.lost_s < 1.1
    assert "lost from byte" in report.summary()
    copy = open_flight(tmp_path / "g.mcap")
    assert copy.verify()
    assert np.array_equal(copy.series("/imu")[0].stamp_ns, left.stamp_ns)
    assert copy.metadata[RECOVERED]["summary"] == report.summary()
    assert copy.attachments["params"] == ("text/plain", b"x" * 100)


def test_a_change_outside_of_chunks_is_found_by_verify(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    damaged = bytearray(sound)
    damaged[sound.index(b"deckfix.clocks") + 25] ^= 1
    path.write_bytes(damaged)
    opened = open_flight(path)
    # The constants are with the channels too, whose description has a check sum of its own.
    assert opened.clock_offsets_ns["autopilot"] == UTC
    assert not opened.verify()
    assert any("check sum" in p for p in opened.problems)


def test_a_wrong_message_index_is_made_anew(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    path.write_bytes(sound)
    (imu,) = open_flight(path).series("/imu")
    for change in (
        15 + 8,
        15,
        9,
        1,
        0,
    ):  # an entry's offset, its time, the channel, the length, the record's kind
        damaged = bytearray(sound)
        chunk = sound.index(b"\x04\x00\x00\x00zstd") - 37
        length = int.from_bytes(sound[chunk + 1 : chunk + 9], "little")
        damaged[chunk + 9 + length + change] ^= 0x04
        path.write_bytes(damaged)
        opened = open_flight(path)
        assert np.array_equal(opened.series("/imu")[0].stamp_ns, imu.stamp_ns), change


def test_nothing_is_recovered_onto_itself_or_over_another(sound: bytes, tmp_path: Path) -> None:
    path, other = tmp_path / "f.mcap", tmp_path / "g.mcap"
    path.write_bytes(sound)
    other.write_bytes(b"mine")
    with pytest.raises(LogError, match="same file"):
        recover(path, path, force=True)
    with pytest.raises(LogError, match="the file exists"):
        recover(path, other)
    assert path.read_bytes() == sound
    assert other.read_bytes() == b"mine"


RECORDER = """
import sys, itertools
from pathlib import Path
sys.path.insert(0, {tests!r})
from estimation.events import Imu
from estimation.events import Event
from logs import FlightWriter
writer = FlightWriter({path!r})
for i in itertools.count():
    t = i * 5_000_000
    if t < {stop_ns}:
        writer.write_event(Imu(t, {utc} + t, (float(i), 0.0, 0.0), (0.0, 0.0, -9.8)))
        if i % 10 == 0:
            image = {{"format": "jpeg", "data": bytes(40_000)}}
            writer.write_message("/camera/image/compressed", image, arrival_ns={utc} + t)
    else:
        print(i, flush=True)
        sys.stdin.read()
"""


@pytest.mark.parametrize("stop_ns", [7_400_000_000, 7_995_000_000])
def test_a_killed_recording_loses_at_most_its_last_second(tmp_path: Path, stop_ns: int) -> None:
    path = tmp_path / "f.mcap"
    script = RECORDER.format(tests=str(Path(__file__).parent), path=str(path), utc=UTC, stop_ns=stop_ns)
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as child:
        assert child.stdout is not None
        written = int(child.stdout.readline())
        child.send_signal(signal.SIGKILL)
        assert child.wait(20) == -signal.SIGKILL
    opened = open_flight(path)
    (imu,) = opened.series("/imu")
    assert written - IMU_HZ <= len(imu) < written
    assert np.array_equal(imu.data["angular_velocity"][:, 0], np.arange(len(imu)))
    assert any("interrupted" in p for p in opened.problems)
    report = recover(path, tmp_path / "g.mcap")
    assert report.last_ns == imu.arrival_ns[-1]
    assert any("interrupted" in p for p in report.problems)
    images = sum(1 for _ in open_flight(tmp_path / "g.mcap").messages(["/camera/image/compressed"]))
    assert report.messages == len(imu) + images
    assert images >= (written - IMU_HZ) // 10


def test_a_recording_killed_at_any_moment_is_readable(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    script = RECORDER.format(tests=str(Path(__file__).parent), path=str(path), utc=UTC, stop_ns=10**18)
    with subprocess.Popen([sys.executable, "-c", script], stdin=subprocess.PIPE) as child:
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and (not path.exists() or path.stat().st_size < 4_000_000):
            time.sleep(0.02)
        child.kill()
        child.wait(20)
    (imu,) = open_flight(path).series("/imu")
    assert np.array_equal(imu.data["angular_velocity"][:, 0], np.arange(len(imu)))
    assert len(imu) > IMU_HZ
    count, _ = _read_everything(path)
    assert recover(path, tmp_path / "g.mcap").messages == count


@settings(max_examples=60, deadline=None)
@given(
    flips=st.lists(st.tuples(st.floats(0, 1, exclude_max=True), st.integers(1, 255)), max_size=4),
    cut=st.one_of(st.none(), st.floats(0, 1)),
)
def test_random_damage_never_escapes(
    sound: bytes,
    tmp_path_factory: pytest.TempPathFactory,
    flips: list[tuple[float, int]],
    cut: float | None,
) -> None:
    folder = tmp_path_factory.mktemp("damage")
    data = bytearray(sound)
    for place, change in flips:
        data[int(place * len(data))] ^= change
    if cut is not None:
        del data[int(cut * len(data)) :]
    path = folder / "f.mcap"
    path.write_bytes(data)
    try:
        count, problems = _read_everything(path)
    except LogError:
        assert bytes(data[:8]) != sound[:8]
        return
    changed = bytes(data) != sound
    assert problems or not changed
    try:
        report = recover(path, folder / "g.mcap")
    except LogError:
        assert count == 0
        return
    again, after = _read_everything(folder / "g.mcap")
    # A definition that was damaged together with its copy in the summary stays so.
    assert all("decoded" in p or "do not fit" in p for p in after)
    assert again == report.messages
    assert report.messages == count or problems


LIMITED = """
import resource, sys
sys.path.insert(0, {unit!r})
import numpy, mcap.reader, mcap_ros2.decoder, lz4.frame, zstandard
from logs import LogError, open_flight
from logs.events import events_of_series
from logs.recover import recover
import random
sound = open({path!r}, "rb").read()
limit = 600 * 2**20
resource.setrlimit(resource.RLIMIT_AS, (limit, limit))
rng = random.Random(5)
worst = 0
for k in range({runs}):
    data = bytearray(sound)
    for _ in range(rng.randint(1, 3)):
        # Lengths are little-endian: a high byte makes gigabytes of them.
        data[rng.randrange(len(data))] = rng.choice([0xFF, 0x7F, 0x40, rng.randrange(256)])
    if k % 3 == 0:
        del data[rng.randrange(len(data)):]
    with open({out!r}, "wb") as stream:
        stream.write(data)
    try:
        flight = open_flight({out!r})
        for message in flight.messages():
            pass
        flight.recording(), flight.events(), flight.verify()
        recover({out!r}, {out!r} + ".g", force=True)
    except LogError:
        pass
print("fine")
"""


def test_damage_allocates_no_gigabytes(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "sound.mcap"
    path.write_bytes(sound)
    script = LIMITED.format(
        unit=str(Path(__file__).parents[1] / "unit"), path=str(path), out=str(tmp_path / "f.mcap"), runs=150
    )
    done = subprocess.run(
        [sys.executable, "-c", script],
        capture_output=True,
        text=True,
        check=False,
        timeout=250,
    )
    assert done.stdout.strip() == "fine", done.stderr[-2000:]


def test_a_chunk_that_claims_gigabytes_is_refused_before_it_is_read(sound: bytes, tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    data = bytearray(sound)
    chunk = sound.index(b"\x04\x00\x00\x00zstd") - 37
    data[chunk + 25 : chunk + 33] = (LARGEST_CHUNK * 100).to_bytes(8, "little")
    path.write_bytes(data)
    opened = open_flight(path)
    opened.series("/imu")
    assert any("claims 26843545600 bytes" in p for p in opened.problems)

"""A camera's recording is joined to a flight: video or pictures, stamps, offset, and whatever is wrong with them."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np
import pytest
from imaged_flight import CAMERA, COUNT, FIRST_S, RATE_HZ, TARGET, imaged_flight, write_flight
from small_flight import BOOT, UTC, small_log

import deckfix
from deckfix.cli import main
from logs import LogError, open_flight
from logs.images import images
from logs.video import Frame, _with_av, _with_opencv, frames, read_stamps

AV = pytest.mark.skipif(
    importlib.util.find_spec("av") is None, reason="PyAV (deckfix[video]) is not installed"
)
READERS = [pytest.param(_with_opencv, id="opencv"), pytest.param(_with_av, id="av", marks=AV)]


def grey(value: int, width: int = 64, height: int = 48) -> np.ndarray:
    picture = np.full((height, width, 3), value, np.uint8)
    picture[::7] = 255 - value
    return picture


def video(path: Path, code: str, count: int = 20, rate: float = 20.0) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*code), rate, (64, 48))
    assert writer.isOpened()
    for k in range(count):
        writer.write(grey(5 * k))
    writer.release()
    return path


def folder(path: Path, count: int = 5) -> Path:
    path.mkdir()
    for k in range(count):
        assert cv2.imwrite(str(path / f"p{k:03d}.{'png' if k == 1 else 'jpg'}"), grey(5 * k))
    return path


@pytest.fixture(scope="module")
def flight(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_log(tmp_path_factory.mktemp("log") / "flight.mcap", seconds=4.0)


def failure(capsys: pytest.CaptureFixture[str], *arguments: str | Path) -> str:
    assert main([str(a) for a in arguments]) == 1
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("deckfix: ")
    assert err.count("\n") == 1
    assert "internal error" not in err
    return err


# -- frames --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("reader", READERS)
@pytest.mark.parametrize(("name", "code"), [("v.avi", "MJPG"), ("v.mp4", "mp4v")])
def test_a_videos_frames_have_its_times(reader: object, name: str, code: str, tmp_path: Path) -> None:
    found: list[Frame] = list(reader(video(tmp_path / name, code)))  # type: ignore[operator]
    assert [f.number for f in found] == list(range(20))
    assert [f.t_ns for f in found] == pytest.approx([50_000_000 * k for k in range(20)], abs=1000)
    for k, frame in enumerate(found):
        assert frame.data is not None
        assert frame.format == "jpeg"
        shown = cv2.imdecode(np.frombuffer(frame.data, np.uint8), cv2.IMREAD_COLOR)
        assert abs(float(shown[3:7, 3:60].mean()) - 5 * k) < 4.0


@pytest.mark.parametrize("reader", READERS)
def test_motion_jpeg_is_kept_and_damaged_frames_are_counted(reader: object, tmp_path: Path) -> None:
    path = video(tmp_path / "v.avi", "MJPG")
    raw = path.read_bytes()
    kept = [f.data for f in reader(path)]  # type: ignore[operator]
    assert all(data in raw for data in kept)
    at = raw.index(kept[4])
    path.write_bytes(raw[:at] + bytes(len(kept[4])) + raw[at + len(kept[4]) :])
    spoiled: list[Frame] = list(reader(path))  # type: ignore[operator]
    assert [f.number for f in spoiled if f.data is None] == [4]
    assert [f.data for f in spoiled if f.number != 4] == [d for k, d in enumerate(kept) if k != 4]


def test_a_cut_off_videos_missing_frames_are_counted(tmp_path: Path) -> None:
    path = video(tmp_path / "v.avi", "MJPG", count=40)
    data = path.read_bytes()
    path.write_bytes(data[: data.index(b"idx1") // 2])
    found = list(_with_opencv(path))
    good = sum(f.data is not None for f in found)
    assert 10 < good < 30
    assert len(found) in (40, good, good + 1)


def test_pictures_are_kept_as_they_are(tmp_path: Path) -> None:
    place = folder(tmp_path / "pictures")
    (place / "p003.jpg").write_bytes(b"\xff\xd8 no picture")
    (place / "notes.txt").write_text("no picture either")
    found = list(frames(place))
    assert [f.name for f in found] == ["p000.jpg", "p001.png", "p002.jpg", "p003.jpg", "p004.jpg"]
    assert [f.format for f in found] == ["jpeg", "png", "jpeg", "jpeg", "jpeg"]
    assert found[3].data is None
    assert found[4].data == (place / "p004.jpg").read_bytes()


@pytest.mark.parametrize("content", [b"", b"no video", b"\0" * 5000])
@pytest.mark.parametrize("reader", READERS)
def test_what_is_no_video_is_an_error(reader: object, content: bytes, tmp_path: Path) -> None:
    path = tmp_path / "v.mp4"
    path.write_bytes(content)
    with pytest.raises(LogError, match="cannot be opened as a video"):
        list(reader(path))  # type: ignore[operator]


# -- stamps --------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("text", "frame", "t_ns"),
    [
        ("t_ns\n5\n7\n", Frame(1, "", None, b""), 7),
        ("frame,t_s\n3,1.000000001\n", Frame(3, "", None, b""), 1_000_000_001),
        ("frame,Time [ms]\n0,-2.5\n", Frame(0, "", None, b""), -2_500_000),
        ("stamp_us,frame\n4,a.jpg\n", Frame(9, "a.jpg", None, b""), 4_000),
        ("frame,t_ns\na,4\n", Frame(9, "a.jpg", None, b""), 4),
        ("frame,t_ns\n1,4\n", Frame(0, "", 99, b""), None),
    ],
)
def test_a_table_of_stamps(text: str, frame: Frame, t_ns: int | None, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(text)
    assert read_stamps(path, None).of(frame) == t_ns
    assert read_stamps(path, 3).of(frame) == (None if t_ns is None else t_ns - 3)


@pytest.mark.parametrize(
    ("text", "wrong"),
    [
        ("", "no column of times"),
        ("frame,t\n0,1\n", "no column of times"),
        ("t_s,t_ns\n0,1\n", "or several"),
        ("t_s\n", "holds no stamps"),
        ("frame,t_s\n0,1\n1,x\n", "line 3 has no time"),
        ("frame,t_s\n0,nan\n", "line 2 has no time"),
        ("frame,t_s\n0\n", "line 2 has no time"),
        ("frame,t_s\n0,1\n0,2\n", "line 3 has frame 0 again"),
        ("t_s,clock\n0,gps\n", "names the clocks gps"),
        ("t_s,clock\n0,utc\n1,camera\n", "names the clocks camera, utc"),
    ],
)
def test_a_table_that_cannot_be_used_is_one_line(text: str, wrong: str, tmp_path: Path) -> None:
    path = tmp_path / "s.csv"
    path.write_text(text)
    with pytest.raises(LogError, match=wrong):
        read_stamps(path, None)


# -- import --------------------------------------------------------------------------------------------------------


def test_the_offset_ties_the_videos_time_to_the_flights(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, out = video(tmp_path / "v.avi", "MJPG"), tmp_path / "out.mcap"
    begins_s = BOOT * 1e-9 + 1.5
    offset = f"-{begins_s:.9f}"
    assert main(["import", str(flight), "--video", str(recording), "--offset", offset, "-o", str(out)]) == 0
    assert "20 images of v.avi" in capsys.readouterr().out
    seen = list(images(open_flight(out)))
    assert [i.stamp_ns for i in seen] == [BOOT + 1_500_000_000 + 50_000_000 * k for k in range(20)]
    assert [i.arrival_ns - i.stamp_ns for i in seen] == [UTC] * 20
    assert {i.clock for i in seen} == {"autopilot"}
    channel = open_flight(out).topics["/camera/image/compressed"][0]
    assert channel.metadata["frames_offset_ns"] == str(-BOOT - 1_500_000_000)
    assert open_flight(out).verify()


@pytest.mark.parametrize(("clock", "shift"), [("autopilot", 0), ("utc", UTC), ("camera", 7_000_000_000)])
def test_stamps_of_any_clock(clock: str, shift: int, flight: Path, tmp_path: Path) -> None:
    place, table, out = folder(tmp_path / "pictures"), tmp_path / "s.csv", tmp_path / "out.mcap"
    true = [BOOT + 1_000_000_000 + 100_000_000 * k for k in range(5)]
    lines = [f"p{k:03d}.{'png' if k == 1 else 'jpg'},{t + shift},{clock}" for k, t in enumerate(true)]
    table.write_text("\n".join(["frame,t_ns,clock", *lines]))
    extra = ["--offset", "7"] if clock == "camera" else []
    command = ["import", flight, "--video", place, "--stamps", table, "-o", out, *extra]
    assert main([str(a) for a in command]) == 0
    assert [i.stamp_ns for i in images(open_flight(out))] == true


def test_frames_that_cannot_be_used_are_counted(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    place, table, out = folder(tmp_path / "pictures"), tmp_path / "s.csv", tmp_path / "out.mcap"
    (place / "p002.jpg").write_bytes(b"\xff\xd8 no picture")
    table.write_text(
        f"frame,t_s,clock\n0,{BOOT / 1e9},autopilot\n2,41,autopilot\n3,41.5,autopilot\n4,900,autopilot\n"
    )
    assert main(["import", str(flight), "--video", str(place), "--stamps", str(table), "-o", str(out)]) == 0
    said = capsys.readouterr().out
    opened = open_flight(out)
    for told in ("1 frames of the camera cannot be decoded", "1 frames of the camera have no time",
                 "1 frames of the camera lie outside the flight's time"):  # fmt: skip
        assert told in said
        assert any(told in p for p in opened.problems)
    assert len(list(images(opened))) == 2
    assert opened.metadata["deckfix.video"]["undecodable"] == "1"


def test_what_is_wrong_is_said_before_anything_is_written(
    flight: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    recording, place = video(tmp_path / "v.avi", "MJPG"), folder(tmp_path / "pictures")
    camera, out = tmp_path / "camera.toml", tmp_path / "out.mcap"
    camera.write_text(CAMERA.to_toml())
    to = ("-o", out)
    base = ("import", flight, "--video", recording)
    assert "give --offset" in failure(capsys, *base, *to)
    assert "no number of seconds" in failure(capsys, *base, "--offset", "x", *to)
    assert "none of its frames can be used" in failure(capsys, *base, "--offset", "-9999", *to)
    assert "the camera file is for 320 x 240" in failure(
        capsys, *base, "--offset", "-41", "--camera", camera, *to
    )
    assert "no such file" in failure(capsys, "import", flight, "--video", tmp_path / "no.avi", *to)
    assert "pictures have no times" in failure(
        capsys, "import", flight, "--video", place, "--offset", "0", *to
    )
    assert "give --video too" in failure(capsys, "import", flight, "--offset", "0", *to)
    assert "no such file" in failure(capsys, "import", flight, "--camera", tmp_path / "no.toml", *to)
    assert "field" in failure(capsys, "import", flight, "--target", camera, *to)
    assert "an MCAP file already" in failure(capsys, "import", flight, *to)
    table = tmp_path / "s.csv"
    table.write_text("t_s,clock\n41,companion\n")
    assert "no companion clock" in failure(capsys, *base, "--stamps", table, *to)
    assert not out.exists()
    assert not list(tmp_path.glob(".*partial*"))


# -- a whole flight ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def bare(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    yield write_flight(tmp_path_factory.mktemp("bare") / "bare.mcap", images=False, carried=False)


def test_a_flight_and_its_video_become_a_log_that_replays_with_fixes(bare: Path, tmp_path: Path) -> None:
    made = imaged_flight()
    recording = tmp_path / "v.avi"
    code = cv2.VideoWriter_fourcc(*"MJPG")
    writer = cv2.VideoWriter(str(recording), cv2.CAP_FFMPEG, code, RATE_HZ, (CAMERA.width, CAMERA.height))
    for data in made.pictures:
        writer.write(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    writer.release()
    for name, one in (("c.toml", CAMERA), ("t.toml", TARGET)):
        (tmp_path / name).write_text(one.to_toml())
    out = tmp_path / "seen.mcap"
    offset_s = -(FIRST_S + made.flight.clock.offset_s)
    arguments = ["--video", recording, "--offset", offset_s, "--camera", tmp_path / "c.toml"]
    arguments += ["--target", tmp_path / "t.toml", "-o", out]
    assert main(["import", str(bare), *map(str, arguments)]) == 0
    opened = open_flight(out)
    assert opened.topics["/camera/camera_info"][0].count == 1
    assert {"camera.toml", "target.toml", "config.toml"} <= set(opened.attachments)
    assert opened.topics["/imu"][0].count == open_flight(bare).topics["/imu"][0].count
    result = deckfix.replay(out, jobs=1)
    assert result.images is not None
    assert len(result.images.fixes or ()) > 0.8 * COUNT
    truth = {int(s): p for s, p in zip(made.stamps_ns, made.true_m, strict=True)}
    for fix in result.images.fixes:  # type: ignore[union-attr]
        near = min(truth, key=lambda s: abs(s - fix.stamp_ns))
        assert abs(near - fix.stamp_ns) < 1000
        # A video's JPEG is coarser than what the fixes' covariance knows of: metres here, its honesty elsewhere.
        assert np.linalg.norm(np.array(fix.position_cam_m) - truth[near]) < 0.01 * np.linalg.norm(truth[near])
    assert result.outcomes("vision")
    assert result.has_deck

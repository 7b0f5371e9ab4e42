"""Images in a log become fixes: true, the same in any number of processes, and whatever the images are."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from imaged_flight import CAMERA, COUNT, DELAY_S, TARGET, imaged_flight, write_flight
from small_flight import deck_recording

import deckfix
from deckfix.cli import main
from deckfix.files import InputError
from deckfix.findings import findings
from deckfix.log_images import camera_of
from deckfix.pipeline import decode
from deckfix.result import Result
from estimation.events import VisionFix
from logs import FlightWriter, open_flight
from logs.images import TOPIC, count, file_of, images

DAMAGED = 7


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_flight(tmp_path_factory.mktemp("log") / "f.mcap", damaged=(DAMAGED,))


@pytest.fixture(scope="module")
def result(log: Path) -> Result:
    return deckfix.replay(log, jobs=1)


def nees(fixes: list[VisionFix]) -> list[float]:
    """Return the squared error of each fix against the truth, over its covariance."""
    made = imaged_flight()
    frame = {int(s): k for k, s in enumerate(made.stamps_ns)}
    out = []
    for fix in fixes:
        error = np.array(fix.position_cam_m) - made.true_m[frame[fix.stamp_ns]]
        xx, xy, xz, yy, yz, zz = fix.covariance_m2
        own = np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
        out.append(float(error @ np.linalg.solve(own, error)))
    return out


def test_fixes_lie_within_their_covariance_of_the_truth(result: Result) -> None:
    assert result.images is not None
    assert result.images.fixes is not None
    fixes = [f for f in result.images.fixes if isinstance(f, VisionFix)]
    assert len(fixes) >= 50
    found = nees(fixes)
    assert 2.0 < np.mean(found) < 4.1  # 99.9 % band of the mean of 50 values of 3 degrees of freedom
    assert max(found) < 25.0
    assert result.has_deck
    assert result.outcomes("vision")


def test_images_damaged_and_without_a_target_are_counted(result: Result) -> None:
    told = result.summary()["vision"]
    assert told["source"] == "images"
    assert told["frames"] == COUNT
    assert told["undecodable"] == 1
    assert told["fixes"] + told["undecodable"] + sum(told["no_fix"].values()) == COUNT
    symptoms = [f.symptom for f in findings(result)]
    assert f"1 of {COUNT} images cannot be decoded" in symptoms
    assert any("showed no target" in s for s in symptoms)
    assert imaged_flight().stamps_ns[DAMAGED] not in {f.stamp_ns for f in result.images.fixes}  # type: ignore


def test_a_fix_has_its_images_stamp_and_arrival(result: Result) -> None:
    made = imaged_flight()
    for fix in result.images.fixes:  # type: ignore[union-attr]
        arrival = made.flight.place.utc_ns + round(
            (made.flight.clock.true_s(np.array([fix.stamp_ns]))[0] + DELAY_S) * 1e9
        )
        assert abs(fix.arrival_ns - arrival) < 1000
        assert fix.clock == "autopilot"


def test_any_number_of_processes_gives_the_same_bytes(log: Path, result: Result, tmp_path: Path) -> None:
    one, two = tmp_path / "one.mcap", tmp_path / "two.mcap"
    result.write(one)
    deckfix.replay(log, jobs=2).write(two)
    assert one.read_bytes() == two.read_bytes()


def test_the_output_replays_without_its_images_to_the_same_bits(result: Result, tmp_path: Path) -> None:
    first = tmp_path / "first.mcap"
    result.write(first)
    again = deckfix.replay(first)
    assert again.summary()["vision"] == {"source": "recorded", "frames": COUNT}
    assert np.array_equal(again.run.nominal, result.run.nominal)
    assert np.array_equal(again.run.deck_covariance, result.run.deck_covariance)
    assert main(["replay", str(first), "--check"]) == 0
    assert open_flight(first).metadata["deckfix.vision"]["undecodable"] == "1"


def test_fixes_are_replaced_where_images_are_asked_for(result: Result, tmp_path: Path) -> None:
    first = tmp_path / "first.mcap"
    result.write(first)
    again = deckfix.replay(first, images=True, jobs=1)
    assert again.images is not None
    assert again.images.source == "images"
    assert np.array_equal(again.run.nominal, result.run.nominal)
    again.write(tmp_path / "second.mcap")
    assert first.read_bytes() == (tmp_path / "second.mcap").read_bytes()


def test_images_are_left_alone_where_that_is_asked_for(log: Path, tmp_path: Path) -> None:
    without = deckfix.replay(log, images=False)
    assert without.summary()["vision"] == {"source": "none", "frames": COUNT, "reason": "not asked for"}
    assert not without.has_deck
    assert any("not looked at" in f.symptom for f in findings(without))
    without.write(tmp_path / "out.mcap")
    again = deckfix.replay(tmp_path / "out.mcap")
    assert again.summary()["vision"]["source"] == "none"
    assert np.array_equal(again.run.nominal, without.run.nominal)


def test_without_a_camera_the_images_are_told_of(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = write_flight(tmp_path / "bare.mcap", carried=False)
    told = deckfix.replay(path)
    assert told.summary()["vision"]["reason"] == "the log holds no camera and no target"
    assert any("--camera C.toml" in f.remedy for f in findings(told))
    assert main(["replay", str(path), "--images"]) == 1
    assert "holds no camera and no target; add what is missing" in capsys.readouterr().err


def test_camera_info_is_a_camera(tmp_path: Path) -> None:
    path = write_flight(tmp_path / "f.mcap", images=False, carried=False)
    assert camera_of(open_flight(path)) is None
    told = tmp_path / "told.mcap"
    with FlightWriter(told) as writer:
        writer.write_message(
            "/camera/camera_info", CAMERA.to_camera_info(), arrival_ns=2, stamp_ns=1, clock="camera"
        )
    assert camera_of(open_flight(told)) == CAMERA


@pytest.mark.parametrize("name", ["camera.toml", "target.toml"])
def test_a_damaged_attachment_is_one_line(name: str, tmp_path: Path) -> None:
    recording = deck_recording(2.0)
    for own, text in (("camera.toml", CAMERA.to_toml()), ("target.toml", TARGET.to_toml())):
        recording.attachments[own] = ("application/toml", ("x = [" if own == name else text).encode())
    path = tmp_path / "f.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
        writer.write_message(
            TOPIC, {"data": b"x"}, arrival_ns=1_795_342_541_000_000_000, stamp_ns=41_000_000_000
        )
    with pytest.raises(InputError, match=f"{path}: its {name.split('.', maxsplit=1)[0]}: .*deckfix import"):
        deckfix.replay(path, images=True)
    assert main(["info", str(path)]) == 0


def test_recorded_fixes_of_another_camera_stay(tmp_path: Path) -> None:
    recording = deck_recording(3.0)
    path = tmp_path / "f.mcap"
    for name, text in (("camera.toml", CAMERA.to_toml()), ("target.toml", TARGET.to_toml())):
        recording.attachments[name] = ("application/toml", text.encode())
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
        writer.write_message(
            TOPIC, {"data": imaged_flight().pictures[0]}, arrival_ns=1_795_342_541_000_000_000,
            stamp_ns=41_000_000_000, clock="autopilot", metadata={"sensor": "vision/2"},
        )  # fmt: skip
    result = deckfix.replay(path, engine="filterpy", images=True)
    counts = {s.name: s.count for s in result.streams}
    assert counts["vision"] == 30
    assert result.images is not None
    assert result.images.sensors == ("vision/2",)
    result.write(tmp_path / "out.mcap")
    assert open_flight(tmp_path / "out.mcap").topics["/vision/fix"][0].count == 30


@pytest.mark.parametrize(
    "spoil",
    [
        lambda b: b"",
        lambda b: b[:3],
        lambda b: b[:20],
        lambda b: b[:-1],
        lambda b: b[:12] + b"\xff" * 8 + b[20:],
    ],
)
def test_a_damaged_message_is_an_image_that_cannot_be_decoded(spoil: Callable[[bytes], bytes]) -> None:
    whole = b"\0\1\0\0" + bytes(8) + b"\7\0\0\0camera\0\0" + b"\5\0\0\0jpeg\0\0\0\0" + b"\3\0\0\0abc"
    assert file_of(whole) == b"abc"
    assert file_of(spoil(whole)) == b""
    assert decode(file_of(spoil(whole))) is None


def test_images_stream_in_the_order_of_their_arrival(log: Path) -> None:
    flight = open_flight(log)
    assert count(flight) == COUNT
    seen = list(images(flight))
    assert [i.stamp_ns for i in seen] == imaged_flight().stamps_ns.tolist()
    assert seen[0].data == imaged_flight().pictures[0]
    part = images(flight, seen[10].arrival_ns, seen[20].arrival_ns)
    assert [i.data for i in part] == [i.data for i in seen[10:20]]


def test_info_names_images_camera_and_target(log: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", str(log)]) == 0
    out = capsys.readouterr().out
    assert f"images: {COUNT}, 320 x 240 pixels" in out
    assert "camera: 320 x 240 pixels, 62.2 deg wide" in out
    assert "target: recommended rings, 1 m across, 6 edges" in out


def test_the_command_writes_and_says_it(
    log: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    summary = tmp_path / "s.json"
    assert main(["replay", str(log), "--jobs", "1", "--json", str(summary), "--check"]) == 0
    out = capsys.readouterr().out
    assert f"of {COUNT} images gave a fix, 1 cannot be decoded" in out
    assert "check: two replays gave equal files" in out
    assert json.loads(summary.read_text())["vision"]["frames"] == COUNT

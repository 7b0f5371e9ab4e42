"""The commands ``target`` and ``calibrate``."""

import cv2
import numpy as np
import pytest
from click.testing import CliRunner

from deckfix.cli_vision import calibrate, target
from deckfix.files import InputError, OutputError
from vision.camera import Camera
from vision.target import RingTarget


def run(command, *arguments):
    return CliRunner().invoke(command, [str(a) for a in arguments], catch_exceptions=True)


@pytest.mark.parametrize("suffix", [".svg", ".pdf", ".png"])
def test_target_draws_and_writes_the_matching_toml(tmp_path, suffix):
    out = tmp_path / f"deck{suffix}"
    result = run(target, "-o", out, "--diameter", "0.5", "--dpi", "60")
    assert result.exit_code == 0, result.output
    assert out.stat().st_size > 500
    assert RingTarget.load(tmp_path / "deck.toml") == RingTarget.recommended(0.5)
    assert "500.0 mm" in result.output


def test_target_takes_a_file_and_leaves_it_alone(tmp_path):
    given = tmp_path / "t.toml"
    given.write_text(RingTarget((0.3, 0.1)).to_toml())
    before = given.read_bytes()
    result = run(target, given, "-o", tmp_path / "t.svg")
    assert result.exit_code == 0, result.output
    assert 'r="300.0000"' in (tmp_path / "t.svg").read_text()
    assert given.read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == ["t.svg", "t.toml"]


def test_target_never_overwrites_unasked(tmp_path):
    out = tmp_path / "t.svg"
    (tmp_path / "t.toml").write_text("mine")
    result = run(target, "-o", out)
    assert isinstance(result.exception, OutputError)
    assert (tmp_path / "t.toml").read_text() == "mine"
    assert not out.exists()
    assert run(target, "-o", out, "--force").exit_code == 0
    assert RingTarget.load(tmp_path / "t.toml") == RingTarget.recommended()


@pytest.mark.parametrize(
    ("arguments", "error", "said"),
    [
        (["-o", "t.doc"], OutputError, r"t\.doc: cannot tell"),
        (["-o", "t.svg", "--diameter", "-1"], InputError, "--diameter"),
        (["-o", "t.png", "--diameter", "9"], OutputError, r"t\.png: dpi"),
        (["-o", "t.pdf", "--diameter", "9"], OutputError, r"t\.pdf: paper"),
        (["missing.toml", "-o", "t.svg"], InputError, r"missing\.toml: no such file"),
    ],
)
def test_target_explains_what_is_wrong(tmp_path, monkeypatch, arguments, error, said):
    monkeypatch.chdir(tmp_path)
    result = run(target, *arguments)
    assert isinstance(result.exception, error)
    with pytest.raises(error, match=said):
        raise result.exception
    assert list(tmp_path.iterdir()) == []


def test_target_names_a_bad_file(tmp_path):
    bad = tmp_path / "bad.toml"
    bad.write_text("edges_m = [0.1, 0.2]")
    result = run(target, bad, "-o", tmp_path / "t.svg")
    assert isinstance(result.exception, InputError)
    assert "bad.toml" in str(result.exception)
    assert "descend" in str(result.exception)


def test_target_file_and_size_contradict(tmp_path):
    given = tmp_path / "t.toml"
    given.write_text(RingTarget.thesis().to_toml())
    assert run(target, given, "-o", tmp_path / "t.svg", "--diameter", "1").exit_code == 2


def test_calibrate_writes_camera_and_coverage(tmp_path, data_dir):
    files = sorted((data_dir / "camera_calibration").glob("left*.jpg"))[:6]
    result = run(
        calibrate,
        *files,
        "-o",
        tmp_path / "camera.toml",
        "--coverage",
        tmp_path / "c.png",
        "--readout-ms",
        "20",
    )
    assert result.exit_code == 0, result.output
    camera = Camera.load(tmp_path / "camera.toml")
    assert camera.fx == pytest.approx(535.9, rel=0.02)
    assert camera.readout_s == pytest.approx(0.02)
    assert "focal length known to" in result.output
    assert cv2.imread(str(tmp_path / "c.png")).shape == (480, 640, 3)


def test_calibrate_explains_what_is_wrong(tmp_path):
    text = tmp_path / "notes.txt"
    text.write_text("no picture")
    blank = tmp_path / "blank.png"
    cv2.imwrite(str(blank), np.full((48, 64), 255, np.uint8))
    out = tmp_path / "camera.toml"
    for files, options, said in (
        ([text], [], "notes.txt: not a picture"),
        ([blank], [], "found in 0 pictures"),
        ([tmp_path / "gone.png"], [], "gone.png: no such file"),
        ([blank], ["--square-mm", "-2"], "square_m"),
        ([blank], ["--board", "charuco", "--dictionary", "X"], "dictionary"),
    ):
        result = run(calibrate, *files, "-o", out, *options)
        assert isinstance(result.exception, InputError), result.output
        assert said in str(result.exception)
    assert run(calibrate, blank, "-o", out, "--size", "9").exit_code == 2
    assert not out.exists()

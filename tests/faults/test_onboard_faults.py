"""What is wrong before a flight is one line; what goes wrong in flight ends nothing; a kill costs a second."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest
from scripted_autopilot import CONFIG, HEIGHT_M, ScriptedAutopilot

from deckfix.check import compare_recorded
from deckfix.cli import main
from deckfix.replaying import replay
from estimation.frames import R_CB_NOMINAL
from logs import open_flight
from simulation.renderer import Renderer
from vision import Camera, RingTarget, TargetDetector

CAMERA = Camera.preset("rpi-v2-640x480")
TARGET = RingTarget.recommended()


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a flight's files, and a video of three seconds over the target.

    What is compiled of the detector is compiled here, so that no process has to do it while it is waited for.
    """
    path = tmp_path_factory.mktemp("onboard")
    (path / "camera.toml").write_text(CAMERA.to_toml())
    (path / "target.toml").write_text(TARGET.to_toml())
    (path / "small.toml").write_text(RingTarget.recommended(0.5).to_toml())
    own = '[onboard]\ncamera = "camera.toml"\ntarget = "target.toml"\nimu_rate_hz = 50.0\n'
    (path / "flight.toml").write_text(own + CONFIG)
    image = Renderer(CAMERA, TARGET).render(
        R_CB_NOMINAL.T, np.array([0.0, 0.0, -HEIGHT_M]), np.random.default_rng(1)
    )
    video = cv2.VideoWriter(str(path / "deck.avi"), cv2.VideoWriter_fourcc(*"MJPG"), 10.0, (640, 480))
    for _ in range(35):
        video.write(image)
    video.release()
    TargetDetector(CAMERA, TARGET).detect(image)
    return path


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        return int(wire.getsockname()[1])


def refused(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    """Run the command, and return the one line that it ends with."""
    assert main(["onboard", *arguments]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1, lines
    assert lines[0].startswith("deckfix: ")
    return lines[0]


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leave out what takes long before anything is looked at."""
    monkeypatch.setattr("deckfix.launch.warm_up", lambda setup, engine: None)


@pytest.mark.usefixtures("quick")
@pytest.mark.parametrize(
    ("url", "word"),
    [
        ("udpin:127.0.0.1", "host or port is missing"),
        ("udp:127.0.0.1:14550", "is no MAVLink address"),
        ("serial:/dev/ttyNONE:57600", "no such file or directory"),
        ("serial:/dev/null:57601", "baud rate '57601' is not supported"),
        ("serial:/dev/null:57600", "is no serial line"),
        ("tcp:127.0.0.1:1", "connection refused"),
    ],
)
def test_a_link_that_cannot_be(url: str, word: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert word in refused(capsys, "--mavlink", url)


@pytest.mark.usefixtures("quick")
def test_a_port_in_use(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        url = f"udpin:127.0.0.1:{taken.getsockname()[1]}"
        assert "address already in use" in refused(capsys, "--mavlink", url)


@pytest.mark.usefixtures("quick")
def test_no_autopilot(capsys: pytest.CaptureFixture[str]) -> None:
    url = f"udpin:127.0.0.1:{free_port()}"
    said = refused(capsys, "--mavlink", url, "--wait", "0.3")
    assert "nothing came within 0.3 s; is the autopilot on" in said


@pytest.mark.usefixtures("quick")
def test_a_wrong_baud_rate_shows_as_bytes_without_frames(capsys: pytest.CaptureFixture[str]) -> None:
    ours, theirs = os.openpty()
    stop = threading.Event()

    def noise() -> None:
        rng = np.random.default_rng(1)
        while not stop.wait(0.02):
            os.write(ours, rng.bytes(50))

    thread = threading.Thread(target=noise)
    thread.start()
    try:
        said = refused(capsys, "--mavlink", f"serial:{os.ttyname(theirs)}:57600", "--wait", "0.5")
    finally:
        stop.set()
        thread.join()
        os.close(ours)
        os.close(theirs)
    assert "no MAVLink frame; is the baud rate right" in said


@pytest.mark.usefixtures("quick")
def test_files_and_cameras_that_do_not_fit(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    base = ["--mavlink", f"udpin:127.0.0.1:{free_port()}", "--config", str(folder / "flight.toml")]
    assert "/dev/video97 is not there" in refused(capsys, *base, "--camera", "97")
    assert "no such camera or file" in refused(capsys, *base, "--camera", str(folder / "no.avi"))
    assert "gives no video" in refused(capsys, *base, "--camera", "http://127.0.0.1:9/video")
    said = refused(capsys, *base, "--target", str(folder / "small.toml"))
    assert "is for the target" in said
    assert "(1 m), not for" in said
    wide = folder / "wide.toml"
    wide.write_text(Camera.from_fov(320, 240, 1.0).to_toml())
    video = str(folder / "deck.avi")
    said = refused(capsys, *base, "--camera", video, "--calibration", str(wide))
    assert "gives 640 x 480 pixels, the camera file is for 320 x 240" in said
    said = refused(capsys, *base, "--record", str(folder / "target.toml"))
    assert "is a file; give a folder" in said
    # Nobody can make a folder below a file, whoever runs the test.
    said = refused(capsys, *base, "--record", str(folder / "target.toml" / "flights"))
    assert "cannot be created" in said
    said = refused(capsys, *base, "--publish", "everything")
    assert "use landing_target or odometry" in said
    bare = ["--mavlink", base[1], "--camera", video]
    assert "no camera file" in refused(capsys, *bare)
    (folder / "typo.toml").write_text("[onboard]\ncamara = 1\n")
    said = refused(capsys, "--mavlink", base[1], "--config", str(folder / "typo.toml"))
    assert "camara" in said


class Process:
    """``deckfix onboard`` as a process of its own, with the camera's video."""

    def __init__(self, folder: Path, port: int, record: Path) -> None:
        command = [
            sys.executable, "-m", "deckfix.cli", "onboard", "--mavlink", f"udpin:127.0.0.1:{port}",
            "--config", str(folder / "flight.toml"), "--camera", str(folder / "deck.avi"),
            "--record", str(record), "--engine", "filterpy",
        ]  # fmt: skip
        self.process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)

    def end(self, number: int) -> str:
        self.process.send_signal(number)
        said, _ = self.process.communicate(timeout=30.0)
        return said


def wait(condition: Callable[[], bool], process: subprocess.Popen[str], seconds: float = 120.0) -> None:
    until = time.monotonic() + seconds
    while not condition():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.05)


def test_sigterm_closes_the_log_and_a_camera_that_ends_is_said(folder: Path, tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "f.mcap"
    with ScriptedAutopilot(port) as autopilot:
        run = Process(folder, port, log)
        wait(lambda: len(autopilot.heard("LANDING_TARGET")) > 10, run.process)
        # The video is over after three seconds: the camera is gone, in mid-flight.
        wait(lambda: any("camera lost" in t.text for t in autopilot.heard("STATUSTEXT")), run.process)
        told = len(autopilot.heard("LANDING_TARGET"))
        wait(lambda: len(autopilot.heard("HEARTBEAT")) > 0 and bool(autopilot.heard("HEARTBEAT")[-1].custom_mode & 8),
             run.process)  # fmt: skip
        assert told > 10
        said = run.end(signal.SIGTERM)
    assert run.process.returncode == 0, said
    assert f"wrote {log}" in said
    flight = open_flight(log)
    assert flight.complete
    compared = compare_recorded(replay(flight, engine="filterpy"), flight)
    assert compared is not None
    assert compared[0] == []


def test_a_killed_process_loses_a_second_at_most(folder: Path, tmp_path: Path) -> None:
    port, log = free_port(), tmp_path / "f.mcap"
    with ScriptedAutopilot(port) as autopilot:
        run = Process(folder, port, log)
        wait(lambda: len(autopilot.heard("LANDING_TARGET")) > 10, run.process)
        said = run.end(signal.SIGKILL)
        told_ns = autopilot.heard("LANDING_TARGET")[-1].time_usec * 1000
    flight = open_flight(log)
    assert not flight.complete
    assert "/imu" in flight.topics, said
    (imu,) = flight.series("/imu")
    assert told_ns - int(imu.arrival_ns[-1]) < 1_000_000_000
    compared = compare_recorded(replay(flight, engine="filterpy"), flight)
    assert compared is not None
    assert compared[0] == []
    assert compared[1] > 100

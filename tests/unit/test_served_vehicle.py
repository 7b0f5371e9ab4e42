"""The simulated vehicle behind its MAVLink face: what it streams, what it obeys, and a landing in two processes."""

from __future__ import annotations

import math
import os
import socket
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from deckfix.cli import main
from deckfix.files import InputError
from deckfix.flight_file import load_flight_file
from deckfix.landing_target import landing_target
from deckfix.serving import Pictures, Ports, serve, write_flight_files
from estimation.events import Barometer, GpsPosition, GpsVelocity, Imu
from logs import open_flight
from logs.mavlink_frames import FrameReader
from logs.mavlink_live import SensorStream
from simulation.autopilot import FAR_M, GUIDED, LAND, Autopilot, Lens
from simulation.instruments import Instant
from simulation.mission import Mission, parse_mission
from simulation.renderer import Renderer
from vision import Camera, RingTarget, TargetDetector, VisionFix

MISSION = """
description = "a short landing in a calm sea"
closed_loop = true
seed = 1
start_m = [-3.0, -2.0, -2.0]
rest_s = 3.0
take_off_s = 2.0
longest_s = 120.0
[sea]
beaufort = 1
[streams]
imu = { rate_hz = 100.0 }
gps = { rate_hz = 5.0, first_s = 0.03 }
vision = { rate_hz = 10.0, first_s = 0.005, delay_s = 0.04, clock = "companion" }
[clocks.autopilot]
offset_s = 21.0
[filter.origin]
latitude_deg = 63.4394
longitude_deg = 10.3986
altitude_m = 0.0
[filter.platform]
use = true
anchor_radius_m = 2.0
[filter.landing]
search_altitude_m = 8.0
observe_s = 4.0
observe_max_s = 8.0
stale_s = 1.5
lost_s = 2.0
"""
"""Its limits of staleness are wide, since a test's machine has other work to do."""


def mission() -> Mission:
    return parse_mission(MISSION)


@pytest.fixture
def vehicle() -> Autopilot:
    return Autopilot.of(mission(), 1, Lens(lambda now: None), "filterpy")


def ask(vehicle: Autopilot, number: int, rate_hz: float) -> Any:
    m = vehicle.messages
    message = m.MAVLink_command_long_message(1, 1, 511, 0, number, 1e6 / rate_hz, 0, 0, 0, 0, 0)
    (answer,) = vehicle.receive(message, vehicle.t_s)
    return answer


def fly(vehicle: Autopilot, until_s: float) -> list[Any]:
    said = []
    while vehicle.t_s < until_s and not vehicle.end:
        vehicle.tick()
        said += vehicle.outbox
        vehicle.outbox.clear()
    return said


def names(messages: list[Any]) -> set[str]:
    return {m.get_type() for m in messages}


def test_nothing_is_left_to_compile_when_time_begins() -> None:
    pytest.importorskip("numba")
    world = Autopilot.of(mission(), 1, Lens(lambda now: None), "compiled")
    other = Autopilot.of(mission(), 1, Lens(lambda now: None), "compiled")
    assert not world._advance.signatures
    world.warm_up()
    (signature,) = world._advance.signatures
    for vehicle in (world, other):
        for number in (105, 24, 30):
            ask(vehicle, number, 50.0)
    said = [[str(m) for m in fly(vehicle, 4.0)] for vehicle in (world, other)]
    assert world._advance.signatures == [signature]
    assert said[0] == said[1]
    assert len(said[0]) > 100


def test_nothing_is_streamed_until_it_is_asked_for(vehicle: Autopilot) -> None:
    assert fly(vehicle, 0.4) == []
    assert ask(vehicle, 105, 50.0).result == 0
    assert ask(vehicle, 230, 5.0).result == 2  # ESTIMATOR_STATUS is not to be had
    said = fly(vehicle, 1.4)
    assert names(said) == {"HIGHRES_IMU"}
    assert len(said) == pytest.approx(50, abs=3)


def test_what_is_streamed_becomes_the_events_that_were_drawn(vehicle: Autopilot) -> None:
    for number, rate in ((105, 100.0), (24, 5.0), (29, 10.0), (30, 10.0), (245, 5.0)):
        ask(vehicle, number, rate)
    said = fly(vehicle, 3.0)
    reader, stream = FrameReader(), SensorStream()
    packer = vehicle.messages.MAVLink(None, 1, 1)
    events = []
    for message in said:
        stamp = getattr(message, "time_usec", 0) * 1000 or getattr(message, "time_boot_ms", 0) * 1_000_000
        for frame in reader.datagram(bytes(message.pack(packer))):
            events += stream.take(frame.name, frame.row, 1_795_000_000_000_000_000 + stamp)
    drawn = {(type(e), e.stamp_ns // 1000): e for e in vehicle.instruments.given() if hasattr(e, "stamp_ns")}
    seen = 0
    for event in events:
        twin = drawn.get((type(event), event.stamp_ns // 1000))
        match event, twin:
            case Imu(), Imu():
                np.testing.assert_allclose(event.specific_force_mps2, twin.specific_force_mps2, atol=1e-5)
                np.testing.assert_allclose(
                    event.angular_velocity_radps, twin.angular_velocity_radps, atol=1e-6
                )
            case GpsPosition(), GpsPosition():
                assert event.latitude_rad == pytest.approx(twin.latitude_rad, abs=1e-9)
                assert event.altitude_m == pytest.approx(twin.altitude_m, abs=1e-3)
            case GpsVelocity(), GpsVelocity():
                np.testing.assert_allclose(event.velocity_ned_mps[:2], twin.velocity_ned_mps[:2], atol=0.011)
            case _:
                continue
        seen += 1
    assert seen > 150
    assert any(isinstance(e, Barometer) and abs(e.pressure_pa - 101_325.0) < 500.0 for e in events)


def test_it_takes_off_changes_to_guided_and_flies_what_it_is_sent(vehicle: Autopilot) -> None:
    m = vehicle.messages
    ask(vehicle, 245, 50.0)
    said = fly(vehicle, 5.2)
    assert {x.landed_state for x in said} == {1, 3, 2}
    assert vehicle.mode == GUIDED
    for _ in range(150):
        message = m.MAVLink_set_position_target_local_ned_message(
            0, 1, 1, 1, 2503, 0, 0, 0, 1.0, -0.5, 0.0, 0, 0, 0, 0.3, 0
        )
        vehicle.receive(message, vehicle.t_s)
        vehicle.tick()
    truth = vehicle.flown().truth[-1]
    np.testing.assert_allclose(truth[3:6], [1.0, -0.5, 0.0], atol=0.3)
    fly(vehicle, vehicle.t_s + 3.0)  # nothing more comes: it hovers
    assert float(np.linalg.norm(vehicle.flown().truth[-1][3:6])) < 0.4


def test_in_land_it_goes_to_the_target_that_it_is_told_of_and_disarms(vehicle: Autopilot) -> None:
    m = vehicle.messages
    fly(vehicle, 5.2)
    vehicle.receive(m.MAVLink_command_long_message(1, 1, 176, 0, 1, LAND, 0, 0, 0, 0, 0), vehicle.t_s)
    far = None
    while not vehicle.end and vehicle.t_s < 60.0:
        moment = vehicle.still()
        body_frame = moment.R_nb.T @ (moment.deck_m - moment.position_m)
        vehicle.receive(landing_target(m, body_frame, round(1e6 * vehicle.t_s)), vehicle.t_s)
        if far is None:
            far = float(np.hypot(*(moment.deck_m - moment.position_m)[:2]))
        vehicle.tick()
    flown = vehicle.flown()
    assert vehicle.end == "landed"
    assert flown.contact is not None
    assert far is not None
    assert far > FAR_M
    assert flown.contact.miss_m < 0.3


def test_a_target_in_another_frame_or_without_distance_is_ignored(vehicle: Autopilot) -> None:
    told = landing_target(vehicle.messages, np.array([0.0, 0.0, 5.0]), 1)
    for name, value in (("frame", 8), ("distance", 0.0), ("position_valid", 0)):
        wrong = landing_target(vehicle.messages, np.array([0.0, 0.0, 5.0]), 1)
        setattr(wrong, name, value)
        vehicle.receive(wrong, 0.0)
    assert vehicle.targets == 0
    vehicle.receive(told, 0.0)
    assert vehicle.targets == 1


def test_the_picture_shows_the_deck_where_it_is() -> None:
    camera, target = Camera.preset("rpi-v2-640x480"), RingTarget.recommended()
    pictures = Pictures(Renderer(camera, target), mission().drawn, np.random.default_rng(1))
    place = np.array([0.3, -0.2, -4.0])
    now = Instant(
        0.0, place, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]), np.eye(3), np.zeros(3), np.zeros(3),
        np.array([0.0, 0.0, 0.1]), np.array([0.0, 0.0, 1.0]),
    )  # fmt: skip
    data = pictures.render(now)
    assert data is not None
    from deckfix.pipeline import decode
    from estimation.frames import R_CB_NOMINAL

    picture = decode(data)
    assert picture is not None
    found = TargetDetector(camera, target, engine="numpy").detect(picture, R_CB_NOMINAL.T)
    assert isinstance(found, VisionFix)
    np.testing.assert_allclose(R_CB_NOMINAL.T @ found.position_cam_m, [-0.3, 0.2, 4.1], atol=0.02)


def test_the_files_for_the_companion_fit_together(tmp_path: Path) -> None:
    path = write_flight_files(mission(), tmp_path / "files", force=False)
    made = load_flight_file(path)
    assert made.camera is not None
    assert made.target is not None
    assert made.config.platform.use
    with pytest.raises(ValueError, match="exists already"):
        write_flight_files(mission(), tmp_path / "files", force=False)


def test_a_camera_port_in_use_is_one_line() -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        with pytest.raises(InputError, match="give another --camera-port"):
            serve(mission(), 1, Ports(14550, taken.getsockname()[1]), "filterpy")


def test_a_scenario_that_is_not_flown_in_closed_loop_cannot_be_served(
    capsys: pytest.CaptureFixture[str],
) -> None:
    assert main(["simulate", "landing_2026_06", "--serve"]) == 1
    assert "mission 'landing_2026_06' is unknown" in capsys.readouterr().err


@pytest.mark.nightly
def test_vehicle_and_companion_land_together_in_two_processes(tmp_path: Path) -> None:
    port, camera = _free(socket.SOCK_DGRAM), _free(socket.SOCK_STREAM)
    (tmp_path / "short.toml").write_text(MISSION)
    environment = {**os.environ, "OPENBLAS_NUM_THREADS": "1"}

    def start(*arguments: str) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [sys.executable, "-m", "deckfix.cli", *arguments], cwd=tmp_path, env=environment, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        )  # fmt: skip

    world = start(
        "simulate", "short.toml", "--serve", "--flight-files", "files", "-o", "truth.mcap",
        "--mavlink-port", str(port), "--camera-port", str(camera),
    )  # fmt: skip
    until = time.monotonic() + 60.0
    while not (tmp_path / "files" / "flight.toml").exists() and time.monotonic() < until:
        time.sleep(0.1)
    time.sleep(3.0)
    companion = start(
        "onboard", "--mavlink", f"udpin:127.0.0.1:{port}", "--guide", "--record", "onboard.mcap",
        "--camera", f"http://127.0.0.1:{camera}/camera.mjpg", "--config", "files/flight.toml", "--wait", "60",
    )  # fmt: skip
    try:
        said, _ = world.communicate(timeout=280.0)
        companion.terminate()
        companions, _ = companion.communicate(timeout=30.0)
    finally:
        for process in (world, companion):
            process.kill()
    assert ": landed after" in said, said + companions
    assert companion.returncode == 0, companions
    touch = open_flight(tmp_path / "truth.mcap").metadata["deckfix.simulation"]
    assert float(touch["contact_miss_m"]) < mission().config.landing.r_land_m
    assert float(touch["contact_speed_mps"]) < 0.8
    assert main(["replay", str(tmp_path / "onboard.mcap"), "--check"]) == 0


def _free(kind: socket.SocketKind) -> int:
    with socket.socket(socket.AF_INET, kind) as wire:
        wire.bind(("127.0.0.1", 0))
        return int(wire.getsockname()[1])


def test_the_autopilots_attitude_is_near_the_truth(vehicle: Autopilot) -> None:
    ask(vehicle, 30, 20.0)
    (last,) = fly(vehicle, 4.0)[-1:]
    R = vehicle.still().R_nb
    assert last.yaw == pytest.approx(math.atan2(R[1, 0], R[0, 0]), abs=0.15)
    assert last.roll == pytest.approx(math.atan2(R[2, 1], R[2, 2]), abs=0.02)

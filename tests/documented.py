"""What a reader of the documentation has: small files under the names that the pages use."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

import cv2
import log_bytes as lb
import numpy as np
from imaged_flight import CAMERA, PLAN, TARGET, imaged_flight, write_flight
from small_flight import BOOT, small_log, small_recording

from logs.recording import Recording
from logs.stamps import gps_to_utc_ns
from logs.writer import FlightWriter
from simulation.flight import parse_scenario, simulate

START_US, SECONDS = 50_000_000, 5.0
"""The autopilot's logs begin so long after its start, so that a video at 52.3 s falls into them."""

ROCKING = f"""
description = "a hover with rocking above the deck"
{PLAN}
hover_s = 9.0
descent_s = 3.0
[rock]
start_s = 7.5
duration_s = 8.0
tilt_deg = 6.0
period_s = 1.2
[streams]
imu = {{ rate_hz = 50.0 }}
[streams.timesync]
rate_hz = 10.0
delay_s = 0.001
delay_spread_s = 0.0005
[streams.vision]
rate_hz = 15.0
delay_s = 0.02
delay_spread_s = 0.01
[clocks.companion]
offset_s = 4071.3
[filter.platform]
use = true
[filter.vision]
latency_s = 0.05
latency_sigma_s = 0.015
angle_sigma_rad = 0.0017
floor_m = 0.003
"""

Make = Callable[[Path], None]


def dataflash(path: Path) -> None:
    path.write_bytes(lb.flight(SECONDS, start_us=START_US))


def telemetry(path: Path) -> None:
    utc_us = int(gps_to_utc_ns(np.array([2300]), np.array([0]))[0]) // 1000
    fields = {"time_unix_usec": utc_us + START_US, "time_boot_ms": START_US // 1000}
    tie = (lb.UTC_US + START_US, "SYSTEM_TIME", fields, (1, 1))
    path.write_bytes(lb.telemetry([*lb.telemetry_flight(SECONDS, start_us=START_US), tie]))


def deck_log(path: Path) -> None:
    """Write a flight over a deck that heaves, with its fixes and its truth, that rocks long enough for its latency."""
    with FlightWriter(path) as writer:
        writer.write_recording(rocking())


@lru_cache(maxsize=1)
def rocking() -> Recording:
    return simulate(parse_scenario(ROCKING)).recording()


def imaged_log(path: Path) -> None:
    write_flight(path)


def plain_log(path: Path) -> None:
    small_log(path, seconds=8.0)


def own_tables(folder: Path) -> None:
    """The tables of import.md: axes forward, left, up and velocity east, north, up."""
    recording = small_recording(8.0, truth=False)
    (imu,), (fix,) = recording.find("/imu"), recording.find("/gps/fix")
    (velocity,) = recording.find("/gps/velocity")
    turned = np.array([1.0, -1.0, -1.0])
    gyro, force = imu.data["angular_velocity"] * turned, imu.data["linear_acceleration"] * turned
    n, e, d = velocity.data["twist_twist_linear"].T
    place = [fix.data[c] for c in ("latitude", "longitude", "altitude")]
    for name, header, columns in (
        ("imu.csv", "t,gx,gy,gz,ax,ay,az", [imu.stamp_ns * 1e-9, *gyro.T, *force.T]),
        ("gps.csv", "t,lat,lon,alt,ve,vn,vu", [fix.stamp_ns * 1e-9, *place, e, n, -d]),
    ):
        np.savetxt(folder / name, np.column_stack(columns), delimiter=",", header=header, comments="")


def beacon_table(path: Path) -> None:
    rng = np.random.default_rng(2)
    t = BOOT * 1e-9 + np.arange(3.0, 7.0, 0.25)
    distance = np.linalg.norm([5.0, -10.0, 0.0]) + 0.1 * rng.normal(size=len(t))
    np.savetxt(path, np.column_stack([t, distance]), delimiter=",", header="t_s,distance_m", comments="")


def sea(path: Path, columns: str) -> None:
    t = np.arange(0.0, 150.0, 1.0 / 1.28)
    heave = 0.4 * np.sin(2.0 * np.pi * t / 5.0) + 0.2 * np.sin(2.0 * np.pi * t / 7.3 + 1.0)
    heave += 0.02 * np.random.default_rng(4).normal(size=len(t))
    table = [t, heave] if columns else [np.zeros(len(t)), 100.0 * heave, heave, heave]
    np.savetxt(path, np.column_stack(table), fmt="%.4f", delimiter=",", header=columns, comments="")


@lru_cache(maxsize=1)
def boards() -> tuple[bytes, ...]:
    """Pictures of a chessboard of 9x6 inner corners, 25 mm, from several sides."""
    px = 40
    tiles = np.indices((9, 12)).sum(axis=0) % 2
    board = np.kron(tiles[1:8, 1:11], np.ones((px, px))).astype(np.uint8) * 230 + 20
    board = cv2.copyMakeBorder(board, px, px, px, px, cv2.BORDER_CONSTANT, value=250)
    height, width = board.shape
    metres = np.array([[1.0, 0.0, -width / 2.0], [0.0, 1.0, -height / 2.0], [0.0, 0.0, 1.0]])
    metres[:2] *= 0.025 / px
    out = []
    for k in range(8):
        angle = 0.55 * np.array([np.sin(2.1 * k), np.cos(2.1 * k), 0.3 * np.sin(k)])
        R = cv2.Rodrigues(angle)[0]
        place = np.array([0.06 * np.sin(1.3 * k), 0.05 * np.cos(1.7 * k), 0.42 + 0.02 * (k % 4)])
        K = np.array([[530.0, 0.0, 319.5], [0.0, 530.0, 239.5], [0.0, 0.0, 1.0]])
        H = K @ np.column_stack([R[:, 0], R[:, 1], place]) @ metres
        picture = cv2.GaussianBlur(cv2.warpPerspective(board, H, (640, 480), borderValue=120), (0, 0), 0.8)
        done, data = cv2.imencode(".jpg", cv2.cvtColor(picture, cv2.COLOR_GRAY2BGR))
        assert done
        out.append(bytes(data))
    return tuple(out)


def board_folder(folder: Path) -> None:
    folder.mkdir()
    for k, data in enumerate(boards()):
        (folder / f"{k:02d}.jpg").write_bytes(data)


def picture_folder(folder: Path) -> None:
    folder.mkdir()
    for k, data in enumerate(imaged_flight().pictures[::30]):
        (folder / f"{k:02d}.jpg").write_bytes(data)


def video(path: Path) -> None:
    writer = cv2.VideoWriter(str(path), cv2.CAP_FFMPEG, cv2.VideoWriter_fourcc(*"mp4v"), 20.0, (320, 240))
    assert writer.isOpened()
    for data in imaged_flight().pictures[:20]:
        writer.write(cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR))
    writer.release()


def write_text(path: Path, text: str) -> None:
    path.write_text(text, encoding="utf-8")


def log_folder(folder: Path) -> None:
    folder.mkdir()
    small_log(folder / "monday.mcap", seconds=8.0)
    small_log(folder / "tuesday.mcap", seconds=8.0, seed=8)


FILES: dict[str, Make] = {
    "00000042.BIN": dataflash,
    "flight.BIN": dataflash,
    "flight.tlog": telemetry,
    "flight.mcap": deck_log,
    "bag_0.mcap": plain_log,
    "damaged.mcap": plain_log,
    "v.mp4": video,
    "camera.toml": lambda path: write_text(path, CAMERA.to_toml()),
    "target.toml": lambda path: write_text(path, TARGET.to_toml()),
    "chessboard": board_folder,
    "pictures": picture_folder,
    "overlay": Path.mkdir,
    "logs": log_folder,
    "series.csv": lambda path: sea(path, "time,heave"),
    "buoy.raw": lambda path: sea(path, ""),
    "imu.csv": lambda path: own_tables(path.parent),
    "beacon.csv": beacon_table,
}
"""Every file and folder that the documentation takes for granted, and how it is made."""


def provide(folder: Path, names: set[str], special: dict[str, Make]) -> None:
    """Make the files of these names anew in a folder."""
    for name in names & FILES.keys():
        place = folder / name
        if place.is_dir():
            shutil.rmtree(place)
        place.unlink(missing_ok=True)
        special.get(name, FILES[name])(place)

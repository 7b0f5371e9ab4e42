"""A short simulated flight over a target with a camera on board: its log, its pictures, and where the target was."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from estimation.frames import R_CB_NOMINAL, quat_to_matrix
from logs.images import TOPIC
from logs.writer import FlightWriter
from simulation.flight import SimulatedFlight, parse_scenario, simulate
from simulation.renderer import Renderer
from vision import Camera, RingTarget

CAMERA = Camera.from_fov(320, 240, np.deg2rad(62.2))
TARGET = RingTarget.recommended()
FIRST_S, RATE_HZ, COUNT = 6.5, 20.0, 60
DELAY_S = 0.03
PLAN = """
seed = 3
[sea]
beaufort = 2
[plan]
rest_s = 2.5
climb_s = 3.0
leg_s = 1.5
deck_s = 0.5
altitude_m = 5.0
start_m = [-2.0, -1.5, -1.0]
legs_m = []
yaw_rad = [0.4, 0.3]
"""
"""Up to five metres above the deck; how long it hovers there and how fast it comes down is to follow."""
SCENARIO = f"""
description = "up, and a hover above the deck"
{PLAN}
hover_s = 3.0
descent_s = 4.0
[streams]
imu = {{ rate_hz = 100.0 }}
[filter.platform]
use = true
learn_s = 0.0
[filter.imu]
gyro_noise = 3e-4
"""


@dataclass(frozen=True, slots=True)
class ImagedFlight:
    """A flight, its pictures (JPEG), when they were taken [s], and where the target was in the camera (n, 3) [m]."""

    flight: SimulatedFlight
    pictures: list[bytes]
    taken_s: NDArray[np.float64]
    true_m: NDArray[np.float64]

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """When they were taken by the autopilot's clock."""
        return self.flight.clock.stamp_ns(self.taken_s)


@lru_cache(maxsize=1)
def imaged_flight() -> ImagedFlight:
    """Return the flight; its deck is drawn level, as the detector takes it."""
    flight = simulate(parse_scenario(SCENARIO))
    draw, rng = Renderer(CAMERA, TARGET), np.random.default_rng(5)
    taken = FIRST_S + np.arange(COUNT) / RATE_HZ
    m, deck = flight.trajectory.motion(taken), flight.trajectory.platform.motion(taken)
    pictures, true = [], []
    for k in range(COUNT):
        R_nc = quat_to_matrix(m.quaternion[k]) @ R_CB_NOMINAL.T
        place = m.position_m[k] - deck.position[0][k]
        done, data = cv2.imencode(".jpg", draw.render(R_nc, place, rng), [cv2.IMWRITE_JPEG_QUALITY, 95])
        assert done
        pictures.append(bytes(data))
        true.append(-R_nc.T @ place)
    return ImagedFlight(flight, pictures, taken, np.array(true))


def write_flight(
    path: Path, *, images: bool = True, carried: bool = True, damaged: tuple[int, ...] = ()
) -> Path:
    """Write the flight without vision fixes; ``images`` on the autopilot's clock, some of them ``damaged``; camera and
    target are ``carried`` along.
    """
    made = imaged_flight()
    recording = made.flight.recording()
    recording.series = [s for s in recording.series if s.topic != "/vision/fix"]
    if carried:
        for name, one in (("camera.toml", CAMERA), ("target.toml", TARGET)):
            recording.attachments[name] = ("application/toml", one.to_toml().encode())
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
        for k, data in enumerate(made.pictures if images else ()):
            arrival = made.flight.place.utc_ns + round((made.taken_s[k] + DELAY_S) * 1e9)
            data = data[: len(data) // 50] if k in damaged else data
            writer.write_message(
                TOPIC, {"format": "jpeg", "data": data},
                arrival_ns=arrival, stamp_ns=int(made.stamps_ns[k]), clock="autopilot",
            )  # fmt: skip
    return path

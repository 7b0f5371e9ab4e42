"""The pipeline: an image becomes a fix where it stands in the order of arrival, and its log replays without it."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from deckfix.pipeline import DetectorSettings, ImageEvent, Pipeline, Step
from estimation.estimator import LandingEstimator
from estimation.events import AUTOPILOT, Event, VisionFix
from estimation.frames import R_CB_NOMINAL, quat_to_matrix
from logs import FlightWriter, open_flight
from simulation.flight import SimulatedFlight, parse_scenario, simulate
from simulation.renderer import Renderer
from vision import Camera, NoFix, RingTarget

CAMERA = Camera.preset("rpi-v2-640x480")
TARGET = RingTarget.recommended()
SCENARIO = """
description = "up, and a hover above the deck"
seed = 3
[plan]
rest_s = 2.5
climb_s = 3.0
leg_s = 2.0
hover_s = 2.5
descent_s = 3.0
deck_s = 0.5
altitude_m = 6.0
start_m = [-3.0, -2.0, -1.0]
legs_m = []
yaw_rad = [0.4, 0.3]
[sea]
beaufort = 2
[streams]
imu = { rate_hz = 100.0 }
[filter.platform]
use = true
learn_s = 0.0
[filter.imu]
gyro_noise = 3e-4
"""


@lru_cache(maxsize=1)
def scene() -> tuple[SimulatedFlight, list[Event | ImageEvent]]:
    """Return a flight and its events, with five images a second from the hover on, 30 ms on their way."""
    flight = simulate(parse_scenario(SCENARIO))
    events: list[Event | ImageEvent] = [e for e in flight.batch if not isinstance(e, VisionFix)]
    draw = Renderer(CAMERA, TARGET)
    rng = np.random.default_rng(5)
    for t in np.arange(7.6, 9.5, 0.2):
        at = np.array([t])
        m, deck = flight.trajectory.motion(at), flight.trajectory.platform.motion(at)
        R_nc = quat_to_matrix(m.quaternion[0]) @ R_CB_NOMINAL.T
        picture = draw.render(R_nc, m.position_m[0] - deck.position[0][0], rng)
        ok, packed = cv2.imencode(".jpg", picture)
        assert ok
        stamp = int(flight.clock.stamp_ns(at)[0])
        arrival = flight.place.utc_ns + round((t + 0.03) * 1e9)
        events.append(ImageEvent(stamp, arrival, packed.tobytes(), clock=AUTOPILOT))
    events.sort(key=lambda e: e.arrival_ns)
    return flight, events


def pipeline(**settings: object) -> Pipeline:
    return Pipeline(scene()[0].scenario.config, CAMERA, TARGET, DetectorSettings(**settings))


@lru_cache(maxsize=1)
def steps() -> list[Step]:
    return pipeline().run(scene()[1])


def test_images_become_fixes_that_are_true_and_fused() -> None:
    flight, _ = scene()
    fixes = [s for s in steps() if s.event is not None and isinstance(s.event, VisionFix)]
    assert len(fixes) >= 9
    for step in fixes:
        assert isinstance(step.event, VisionFix)
        at = np.array([(step.event.stamp_ns * 1e-9) - flight.clock.offset_s])
        m, deck = flight.trajectory.motion(at), flight.trajectory.platform.motion(at)
        true = R_CB_NOMINAL @ quat_to_matrix(m.quaternion[0]).T @ (deck.position[0][0] - m.position_m[0])
        assert np.linalg.norm(np.array(step.event.position_cam_m) - true) < 0.02 * np.linalg.norm(true)
    last = [s.estimate for s in steps() if s.estimate is not None][-1]
    assert len(last.deck) == 8
    assert np.sqrt(last.deck_covariance[0, 0]) < 1.0


def test_the_fix_has_its_images_stamp_arrival_and_place() -> None:
    for event, step in zip(scene()[1], steps(), strict=True):
        if isinstance(event, ImageEvent) and step.event is not None:
            assert (step.event.stamp_ns, step.event.arrival_ns) == (event.stamp_ns, event.arrival_ns)
            assert step.detection
            assert step.detection.method in ("found", "tracked")


def test_the_attitude_and_the_expectation_are_those_of_the_images_time() -> None:
    flight, events = scene()
    made = pipeline()
    seen = 0
    for event in events:
        if isinstance(event, ImageEvent):
            rotation = made.attitude(event.stamp_ns)
            at = np.array([(event.stamp_ns * 1e-9) - flight.clock.offset_s])
            m, deck = flight.trajectory.motion(at), flight.trajectory.platform.motion(at)
            true = quat_to_matrix(m.quaternion[0])
            assert rotation is not None
            # Yaw is as good as a compass that was read for a few seconds; the tilt is better.
            assert np.linalg.norm((rotation.T @ true)[2] - [0, 0, 1]) < 0.03
            assert np.linalg.norm(rotation - true) < 0.2
            expected = made.expected(event.stamp_ns)
            if seen > 2:
                place = getattr(expected, "position_cam_m", expected)
                here = R_CB_NOMINAL @ true.T @ (deck.position[0][0] - m.position_m[0])
                assert place is not None
                assert np.linalg.norm(place - here) < 0.3
            seen += 1
        made.step(event)
    assert seen == 10


def test_a_log_of_the_fixes_replays_to_the_same_bits(tmp_path: Path) -> None:
    path = tmp_path / "f.mcap"
    with FlightWriter(path) as writer:
        for step in steps():
            if step.event is not None:
                writer.write_event(step.event)
    run = LandingEstimator(scene()[0].scenario.config).run(open_flight(path).events())
    ours = [s.estimate for s in steps() if s.estimate is not None]
    assert np.array_equal(run.t_ns, [e.t_ns for e in ours])
    assert np.array_equal(run.nominal, [e.nominal for e in ours])
    assert np.array_equal(run.sigma, [e.sigma for e in ours])
    assert np.array_equal(run.deck, [e.deck for e in ours])


@pytest.mark.parametrize(
    ("image", "reason"),
    [
        (b"", "cannot be decoded"),
        (b"\xff\xd8\xff\xe0 no picture", "cannot be decoded"),
        (np.zeros((480, 320, 3), np.uint8), "the camera has 640x480"),
        (np.zeros((480, 640), np.uint8), "is not (height, width, 3)"),
        (np.zeros((480, 640, 3), np.uint8), "no red region"),
    ],
)
def test_an_image_that_shows_nothing_changes_nothing(image: bytes | np.ndarray, reason: str) -> None:
    made, plain = pipeline(), pipeline()
    events = scene()[1][:400]
    for k, event in enumerate(events):
        if k % 100 == 50:
            step = made.step(ImageEvent(event.stamp_ns, event.arrival_ns, image, clock=AUTOPILOT))
            assert isinstance(step.detection, NoFix)
            assert reason in step.detection.reason
            assert step.event is None
            assert step.output is None
        ours, theirs = made.step(event), plain.step(event)
        assert (ours.estimate is None) == (theirs.estimate is None)
        if ours.estimate is not None and theirs.estimate is not None:
            assert np.array_equal(ours.estimate.nominal, theirs.estimate.nominal)
    assert made.counts["images"] == 4
    assert sum(n for k, n in made.counts.items() if k.startswith("no fix")) == 4


def test_without_a_camera_an_image_is_counted_and_nothing_else() -> None:
    made = Pipeline()
    step = made.step(ImageEvent(1, 2, b"x"))
    assert isinstance(step.detection, NoFix)
    assert "no camera" in step.detection.reason

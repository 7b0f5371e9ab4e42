"""Setting up a flight on board: everything that can be wrong is found before the start, in one line each."""

from __future__ import annotations

import gc
import hashlib
import signal
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from types import FrameType
from typing import Any

import numpy as np

from deckfix.camera_source import CameraSource
from deckfix.files import InputError, existing
from deckfix.flight_file import FlightFile
from deckfix.guide import Guide
from deckfix.intake import CompanionClock, Intake
from deckfix.mavlink_link import Link
from deckfix.onboard import HORIZONS_S, Onboard
from deckfix.pipeline import Pipeline
from deckfix.recorder import Recorder, log_path
from deckfix.stream_requests import StreamRequests
from deckfix.transport import open_transport
from estimation.ahead import DeckForecaster
from estimation.config import Config, ConfigError
from estimation.estimator import EngineName, LandingEstimator
from estimation.heave.model import fit
from estimation.output import Facts, with_platform
from logs.ardupilot import filter_delay
from simulation.flight import parse_scenario, simulate
from vision.camera import Camera
from vision.target import RingTarget

PUBLISHED = ("landing_target", "odometry")
_FILTERS = ("INS_GYRO_FILTER", "INS_ACCEL_FILTER")
_ASKED = (*_FILTERS, "PLND_ENABLED", "PLND_TYPE", "PLND_LAG")
_PARAMETERS_S = 2.0
_WARM_UP = """
description = "a short flight, for the compiler"
[plan]
rest_s = 2.5
climb_s = 2.0
leg_s = 1.0
hover_s = 1.0
descent_s = 2.0
deck_s = 0.5
altitude_m = 4.0
start_m = [0.0, 0.0, -1.0]
legs_m = []
yaw_rad = [0.4, 0.3]
[streams]
imu = { rate_hz = 100.0 }
[filter.platform]
use = true
"""


@dataclass(frozen=True, slots=True)
class Options:
    """What the command line asks for; see ``deckfix onboard --help``."""

    mavlink: str
    camera: str | None = None
    record: str | None = None
    publish: tuple[str, ...] = ("landing_target",)
    guide: bool = False
    system: int = 0
    key: bytes | None = None
    engine: EngineName = "auto"
    wait_s: float = 10.0


def signing_key(path: str | Path) -> bytes:
    """Return the key in a file: 64 hexadecimal digits, or a passphrase, of which it is the SHA-256 (as ground stations
    have it). Raises ``InputError``.
    """
    text = existing(path).read_bytes().strip()
    if not text:
        raise InputError(
            f"{path}: is empty; write the signing key (64 hexadecimal digits) or passphrase into it"
        )
    try:
        key = bytes.fromhex(text.decode("ascii"))
    except ValueError:
        key = b""
    return key if len(key) == 32 else hashlib.sha256(text).digest()


def prepare(options: Options, setup: FlightFile, say: Callable[[str], None]) -> Onboard:
    """Return a flight that is ready to run.

    Raises ``InputError``, ``OutputError`` or ``ConfigError`` with what is wrong and what to do.
    """
    _check(options, setup)
    # The log carries what was flown: its replay must not depend on whether the camera found anything.
    setup = replace(setup, config=with_platform(setup.config, options.camera is not None))
    clock = CompanionClock()
    path = None if options.record is None else log_path(options.record, clock())
    say("preparing the estimator and the detector (at the first start this takes a minute)")
    warm_up(setup, options.engine)
    wire = open_transport(options.mavlink)
    camera = None
    try:
        link = Link(wire, clock, lambda events: None, options.system, options.key)
        if options.camera is not None:
            assert setup.camera is not None
            camera = CameraSource(options.camera, setup.camera, clock, lambda image: None)
            camera.begin()
        say(f"waiting for the autopilot on {options.mavlink}")
        meet(link, options.mavlink, options.wait_s)
        for line in remarks(link, options):
            say(line)
        delay = filter_delay(link.vehicle.parameters) if link.vehicle.ardupilot else {}
        facts = Facts(imu_latency_s=float(delay.get("latency_s", 0.0)), vision=options.camera is not None)
        pipeline = Pipeline(
            setup.config, setup.camera, setup.target, setup.table.detector, options.engine, facts,
            ThreadPoolExecutor(1, "learning"),
        )  # fmt: skip
        recorder = None
        if path is not None:
            recorder = Recorder(
                path, pipeline.estimator, setup.attachments(), delay, setup.table.jpeg_quality
            )
            recorder.begin()
    except BaseException:
        wire.close()
        if camera is not None:
            camera.close()
        raise
    flight = Onboard(
        clock, link, pipeline, Intake(clock), camera, recorder,
        Guide(setup.config.landing) if options.guide else None, frozenset(options.publish),
        StreamRequests(setup.table.imu_rate_hz, setup.table.rangefinder or setup.config.rangefinder.use),
    )  # fmt: skip
    link.give = flight.give
    if camera is not None:
        camera.give = flight.give_image
    gc.collect()
    gc.freeze()  # what is there now stays: the collector need not look at it again in flight
    return flight


def _check(options: Options, setup: FlightFile) -> None:
    unknown = [p for p in options.publish if p not in PUBLISHED]
    if unknown:
        raise InputError(f"--publish {unknown[0]}: is unknown; use {' or '.join(PUBLISHED)}")
    if options.camera is not None and setup.camera is None:
        raise InputError(
            "no camera file; name one in the configuration ([onboard] camera) or with --calibration"
        )
    if options.camera is not None and setup.target is None:
        raise InputError("no target file; name one in the configuration ([onboard] target) or with --target")
    needs = options.guide or "landing_target" in options.publish
    if options.camera is not None and needs and setup.config.platform.use is False:
        raise ConfigError(
            "the configuration has platform.use = false: it estimates no deck; set it to true, or publish none"
        )


def warm_up(setup: FlightFile, engine: EngineName) -> None:
    """Run estimator and detector once on a simulated flight, so that nothing is compiled in the air."""
    warm_estimator(setup.config, engine)
    if setup.camera is not None and setup.target is not None:
        warm_detector(setup.camera, setup.target)


def warm_estimator(config: Config, engine: EngineName) -> None:
    """Run the estimator over a few simulated seconds, with what it does only now and then: heave and forecasts."""
    estimator = LandingEstimator(config, engine=engine, facts=Facts(vision=True))
    for event in simulate(parse_scenario(_WARM_UP)).batch:
        estimator.step(event)
    estimator.deck_forecast(DeckForecaster.at(HORIZONS_S))
    t = np.arange(0.0, 20.0, 0.05)
    fit(t, 0.2 * np.sin(t), np.full(len(t), 0.02), window_s=60.0).band_pass()


def warm_detector(camera: Camera, target: RingTarget) -> None:
    """Let the detector look at a rendered image."""
    from estimation.frames import R_CB_NOMINAL
    from simulation.renderer import Renderer
    from vision.detector import TargetDetector
    from vision.fix import NoFix

    rotation = R_CB_NOMINAL.T
    place = np.array([0.0, 0.0, -3.0 * target.diameter_m])
    picture = Renderer(camera, target).render(rotation, place, np.random.default_rng(1))
    detector = TargetDetector(camera, target)
    found = detector.detect(picture, rotation)
    if not isinstance(found, NoFix):
        detector.detect(picture, rotation, found)


def meet(link: Link, url: str, wait_s: float) -> None:
    """Wait for the autopilot's heartbeat, and ask for the parameters that matter; raises ``InputError``."""
    until, beat = link.now() + round(wait_s * 1e9), 0
    while not link.vehicle.system:
        now = link.now()
        if now > until:
            raise InputError(f"{url}: {_silence(link, wait_s)}")
        if now - beat > 500_000_000:
            beat = now
            link.heartbeat(1, 0)
        link.read(0.05)
        if link.broken:
            raise InputError(f"{url}: {link.broken}; is the autopilot running?")
    until, asked = link.now() + round(_PARAMETERS_S * 1e9), 0
    while link.now() < until and not all(name in link.vehicle.parameters for name in _ASKED):
        now = link.now()
        if now - asked > 300_000_000:
            asked = now
            link.heartbeat(1, 0)
            for name in _ASKED:
                if name not in link.vehicle.parameters:
                    link.ask_parameter(name)
        link.read(0.05)


def _silence(link: Link, wait_s: float) -> str:
    if not link.bytes_in:
        return f"nothing came within {wait_s:g} s; is the autopilot on, and does it send here?"
    if link.counts["unsigned"] or link.counts["wrong signature"]:
        return "frames come, but not signed with this key; give the autopilot's signing key"
    if link.counts["foreign system"]:
        return f"others speak, but not system {link.system}; check --system"
    if not link.frames:
        return (
            f"{link.bytes_in} bytes came within {wait_s:g} s, but no MAVLink frame; is the baud rate right "
            "(SERIALn_BAUD) and the protocol MAVLink 2 (SERIALn_PROTOCOL 2)?"
        )
    return (
        f"MAVLink came within {wait_s:g} s, but no autopilot's heartbeat; is the autopilot behind this link?"
    )


def remarks(link: Link, options: Options) -> list[str]:
    """Return what is worth knowing of the autopilot's settings before a flight."""
    out = []
    p = link.vehicle.parameters
    if link.vehicle.ardupilot and "landing_target" in options.publish:
        if p.get("PLND_ENABLED") == 0.0:
            out.append("note: PLND_ENABLED is 0, so the autopilot ignores LANDING_TARGET; set it to 1")
        elif p.get("PLND_TYPE", 1.0) != 1.0:
            out.append("note: PLND_TYPE is not 1 (MAVLink), so the autopilot ignores LANDING_TARGET")
    if link.vehicle.ardupilot and not all(name in p for name in _FILTERS):
        out.append(
            "note: the autopilot did not tell INS_GYRO_FILTER and INS_ACCEL_FILTER; their delay counts as 0"
        )
    return out


def fly(flight: Onboard, seconds: float | None = None) -> None:
    """Run a flight until SIGTERM, SIGINT or, where given, for so many seconds; the log is complete afterwards."""

    def end(number: int, frame: FrameType | None) -> None:
        flight.stop.set()

    before: dict[int, Any] = {}
    if threading.current_thread() is threading.main_thread():
        before = {n: signal.signal(n, end) for n in (signal.SIGTERM, signal.SIGINT)}
    timer = None if seconds is None else threading.Timer(seconds, flight.stop.set)
    if timer is not None:
        timer.daemon = True
        timer.start()
    try:
        flight.run()
    finally:
        flight.stop.set()
        if timer is not None:
            timer.cancel()
        if flight.camera is not None:
            flight.camera.close()
        flight.link.close()
        for number, handler in before.items():
            signal.signal(number, handler)

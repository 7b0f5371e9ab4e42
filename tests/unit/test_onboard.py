"""A flight on board against a scripted autopilot on the loopback: what is sent, what is refused, and that its log
replays to the same bits."""

from __future__ import annotations

import itertools
import math
import socket
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest
from scripted_autopilot import CONFIG, HEIGHT_M, ScriptedAutopilot

from deckfix import launch
from deckfix.check import compare_recorded
from deckfix.dashboard import line, rows
from deckfix.flight_file import FlightFile, OnboardTable
from deckfix.launch import Options, fly, prepare
from deckfix.onboard import Onboard
from deckfix.pipeline import ImageEvent, Pipeline, Step
from deckfix.replaying import replay
from estimation.config import parse_config
from estimation.estimator import LandingEstimator
from estimation.events import COMPANION, EventBatch, Kind
from estimation.frames import R_CB_NOMINAL
from logs import open_flight
from simulation.renderer import Renderer
from vision import Camera, RingTarget

CAMERA = Camera.preset("rpi-v2-640x480")
TARGET = RingTarget.recommended()
LONGEST_S = 90.0
"""A flight ends once all has been seen; a busy machine may take its time."""


def free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        return int(wire.getsockname()[1])


def picture() -> np.ndarray:
    place = np.array([0.0, 0.0, -HEIGHT_M])
    return Renderer(CAMERA, TARGET).render(R_CB_NOMINAL.T, place, np.random.default_rng(1))


def setup() -> FlightFile:
    return FlightFile(parse_config(CONFIG), OnboardTable(imu_rate_hz=50.0), CAMERA, TARGET)


def show_images(flight: Onboard, rate_hz: float = 10.0) -> None:
    """Give the flight an image at a rate, in a thread, as a camera would."""
    image = picture()

    def run() -> None:
        while not flight.stop.wait(1.0 / rate_hz):
            now = flight.clock()
            flight.give_image(ImageEvent(now - 5_000_000, now, image, clock=COMPANION))

    threading.Thread(target=run, daemon=True).start()


@dataclass
class Flown:
    flight: Onboard
    autopilot: ScriptedAutopilot
    log: Path


def attack(autopilot: ScriptedAutopilot, flight: Onboard) -> None:
    """Send what must be turned away, from the autopilot's own address where that makes it harder."""
    while flight.newest is None and not flight.stop.wait(0.05):
        pass
    send = autopilot.wire.sendto
    old = autopilot.packed(autopilot.imu(autopilot.boot_us()))
    send(old, autopilot.address)
    time.sleep(0.1)
    for _ in range(5):
        send(old, autopilot.address)  # replayed
        send(b"\xfd\xff\x00garbage" * 9, autopilot.address)
        send(bytes(60_000), autopilot.address)  # oversized
        future = autopilot.imu(autopilot.boot_us() + 3_000_000, xacc=30.0)
        send(autopilot.packed(future), autopilot.address)
        stale = autopilot.imu(autopilot.boot_us() - 20_000_000, xacc=30.0)
        send(autopilot.packed(stale), autopilot.address)
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(
                autopilot.packed(autopilot.imu(autopilot.boot_us(), xacc=30.0)), autopilot.address
            )
        foreign = autopilot.messages.MAVLink(None, 9, 1)
        send(bytes(autopilot.imu(autopilot.boot_us(), xacc=30.0).pack(foreign)), autopilot.address)
        answer = autopilot.messages.MAVLink_timesync_message(123, 456)
        send(autopilot.packed(answer), autopilot.address)  # to a question that nobody asked
        time.sleep(0.03)
    send(autopilot.packed(autopilot.imu(autopilot.boot_us() + 1, xacc=math.nan)), autopilot.address)
    question = autopilot.messages.MAVLink_timesync_message(0, 987_654_321)
    send(autopilot.packed(question), autopilot.address)
    while not flight.stop.wait(0.1):
        told = len(autopilot.heard("LANDING_TARGET"))
        if told > 60 and len(flight.latencies_ms) > 20 and flight.counts["estimates"] > 150:
            flight.stop.wait(1.0)
            flight.stop.set()


@pytest.fixture(scope="module")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Flown]:
    port, log = free_port(), tmp_path_factory.mktemp("flights") / "flight.mcap"
    patch = pytest.MonkeyPatch()
    patch.setattr(launch, "warm_estimator", lambda config, engine: None)
    said: list[str] = []
    with ScriptedAutopilot(port) as autopilot:
        options = Options(
            f"udpin:127.0.0.1:{port}",
            record=str(log),
            publish=("landing_target", "odometry"),
            engine="filterpy",
        )
        flight = prepare(options, setup(), said.append)
        show_images(flight)
        threading.Thread(target=attack, args=(autopilot, flight), daemon=True).start()
        fly(flight, LONGEST_S)
        patch.undo()
        yield Flown(flight, autopilot, log)


def test_the_autopilot_is_told_where_the_deck_is_as_it_wants_to_be_told(flown: Flown) -> None:
    told = [(t, m) for t, m in flown.autopilot.got if m.get_type() == "LANDING_TARGET"]
    assert len(told) > 20
    for _, m in told:
        assert (m.frame, m.position_valid, m.type) == (12, 1, 2)
        assert m.distance == pytest.approx(math.sqrt(m.x**2 + m.y**2 + m.z**2), rel=1e-6)
        assert m.x / m.z == pytest.approx(-math.tan(m.angle_y), abs=1e-6)
        assert m.y / m.z == pytest.approx(math.tan(m.angle_x), abs=1e-6)
        np.testing.assert_allclose([m.x, m.y, m.z], [0.0, 0.0, HEIGHT_M], atol=0.15)
    times = [m.time_usec for _, m in told]
    assert all(b > a for a, b in itertools.pairwise(times))
    assert all(raw[0] == 0xFD for raw in flown.autopilot.raw)  # MAVLink 2: the other cannot carry x, y, z
    # ArduPilot's estimator needs gaps below half a second; single ones are left to a busy machine.
    gaps = np.diff([t for t, _ in told])
    assert len(told) / (told[-1][0] - told[0][0]) >= 10.0
    assert float(np.percentile(gaps, 95)) < 0.5


def test_odometry_holds_the_estimate_and_its_covariance(flown: Flown) -> None:
    told = flown.autopilot.heard("ODOMETRY")[-1]
    assert (told.frame_id, told.child_frame_id) == (1, 12)
    np.testing.assert_allclose([told.x, told.y, told.z], [0.0, 0.0, -HEIGHT_M], atol=3.0)
    np.testing.assert_allclose(told.q, [1.0, 0.0, 0.0, 0.0], atol=0.3)
    assert told.pose_covariance[0] > 0.0
    assert told.velocity_covariance[0] > 0.0
    assert math.isnan(told.velocity_covariance[20])


def test_the_log_replays_to_the_published_estimates_bit_for_bit(flown: Flown) -> None:
    log = open_flight(flown.log)
    assert log.complete
    assert log.problems == []
    compared = compare_recorded(replay(log, engine="filterpy"), log)
    assert compared is not None
    differing, count = compared
    assert differing == []
    assert count > 4 * flown.flight.counts["estimates"] > 200
    assert {"config.toml", "camera.toml", "target.toml"} <= set(log.attachments)


def test_a_changed_estimate_in_the_log_is_found(flown: Flown, tmp_path: Path) -> None:
    log = open_flight(flown.log)
    result = replay(log, engine="filterpy")
    result.run.sigma[100, 0] = np.nextafter(result.run.sigma[100, 0], 1.0)
    compared = compare_recorded(result, log)
    assert compared is not None
    assert compared[0] == ["/estimate/state"]


def test_what_must_be_turned_away_is_counted_and_moves_nothing(flown: Flown) -> None:
    link = flown.flight.link
    assert link.counts["foreign system"] >= 5
    assert link.counts["foreign address"] >= 5
    assert link.counts["garbage bytes"] > 5 * 60_000
    assert link.counts["timesync of others"] >= 5
    away = link.sensors.counts_turned_away
    assert away["future"] >= 5
    assert away["old"] >= 5
    assert away["repeated"] >= 5
    # Of all that, only the sample with NaN reached the estimator, which refused it: without it the flight is the same.
    batch = open_flight(flown.log).events()
    samples = batch.rows[batch.rows["kind"] == Kind.IMU]
    finite = np.isfinite(samples["value"]).all(axis=1)
    assert np.count_nonzero(~finite) == 1
    assert np.abs(samples["value"][finite][:, 3]).max() < 1.0
    bad = (batch.rows["kind"] == Kind.IMU) & ~np.isfinite(batch.rows["value"]).all(axis=1)
    config = flown.flight.pipeline.config
    facts = flown.flight.pipeline.facts
    with_it = LandingEstimator(config, engine="filterpy", facts=facts).run(batch)
    rest = EventBatch(batch.rows[~bad], batch.sensors, batch.clocks)
    without = LandingEstimator(config, engine="filterpy", facts=facts).run(rest)
    assert np.array_equal(with_it.nominal, without.nominal)


def test_clocks_are_compared_both_ways(flown: Flown) -> None:
    asked = [t for t, m in flown.autopilot.got if m.get_type() == "TIMESYNC" and m.tc1 == 0]
    assert 4.0 <= (len(asked) - 1) / (asked[-1] - asked[0]) <= 10.0
    (answer,) = [m for m in flown.autopilot.heard("TIMESYNC") if m.ts1 == 987_654_321]
    assert answer.tc1 > 0
    (clock,) = [c for c in flown.flight.status.clocks if c.clock == "companion"]
    assert str(clock.status) == "locked"


def test_streams_are_asked_for_and_the_filters_delay_is_known(flown: Flown) -> None:
    asked = {int(m.param1): m.param2 for m in flown.autopilot.heard("COMMAND_LONG") if m.command == 511}
    assert asked[105] == pytest.approx(20_000.0)
    assert {24, 29, 30, 245} <= asked.keys()
    assert flown.flight.pipeline.facts.imu_latency_s == pytest.approx(math.sqrt(2.0) / (2.0 * math.pi * 20.0))


def test_health_goes_out_on_heartbeat_and_text(flown: Flown) -> None:
    beats = flown.autopilot.heard("HEARTBEAT")
    assert {m.type for m in beats} == {18}
    assert beats[-2].system_status == 4
    assert beats[-2].custom_mode == 0
    said = [m.text for m in flown.autopilot.heard("STATUSTEXT")]
    assert "deckfix: no estimate: over" in said


def test_the_terminal_shows_the_flight(flown: Flown) -> None:
    status = flown.flight.status
    assert status is not None
    shown = dict(rows(status))
    assert {
        "health",
        "autopilot",
        "P_rel",
        "deck",
        "clock companion",
        "rates",
        "latency",
        "drops",
    } <= shown.keys()
    assert "P_rel" in line(status)
    assert "\n" not in line(status)


def test_latency_is_measured_and_logged(flown: Flown) -> None:
    assert len(flown.flight.latencies_ms) > 5
    log = open_flight(flown.log)
    said = [str(m.decoded.msg) for m in log.messages(["/log"])]
    assert any(s.startswith("latency frame to LANDING_TARGET: median") for s in said)


def test_a_lost_link_stops_what_is_sent_and_is_survived(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(launch, "warm_estimator", lambda config, engine: None)
    port = free_port()
    with ScriptedAutopilot(port) as autopilot:
        flight = prepare(Options(f"udpin:127.0.0.1:{port}", engine="filterpy"), setup(), lambda text: None)
        show_images(flight)
        thread = threading.Thread(target=fly, args=(flight, LONGEST_S))
        thread.start()
        try:
            wait(lambda: len(autopilot.heard("LANDING_TARGET")) > 5)
            autopilot.silent = True
            wait(lambda: flight.status is not None and "autopilot lost" in flight.status.words)
            count = len(autopilot.heard("LANDING_TARGET"))
            time.sleep(0.5)
            assert len(autopilot.heard("LANDING_TARGET")) == count
            assert flight.status is not None
            assert flight.status.state == 5
            autopilot.silent = False
            wait(lambda: len(autopilot.heard("LANDING_TARGET")) > count + 5)
        finally:
            flight.stop.set()
            thread.join(5.0)
    assert not thread.is_alive()


def test_what_fails_at_the_end_leaves_the_log_closed(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What was being learned beside the estimates may fail only when it is waited for."""

    def finish(pipeline: Pipeline) -> Step:
        raise ArithmeticError("no such sea")

    monkeypatch.setattr(launch, "warm_estimator", lambda config, engine: None)
    monkeypatch.setattr(Pipeline, "finish", finish)
    port, log = free_port(), tmp_path / "flight.mcap"
    with ScriptedAutopilot(port):
        options = Options(f"udpin:127.0.0.1:{port}", record=str(log), engine="filterpy")
        flight = prepare(options, setup(), lambda text: None)
        fly(flight, 1.0)
    said = [str(m.decoded.msg) for m in open_flight(log).messages(["/log"])]
    assert any("internal error: ArithmeticError: no such sea" in s for s in said)
    assert any("latency" in s for s in said[-1:])


def wait(condition: object, seconds: float = 40.0) -> None:
    assert callable(condition)
    until = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < until, "did not happen in time"
        time.sleep(0.02)

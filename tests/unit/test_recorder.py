"""The recorder and the queues: a slow or full disk costs data, which is counted, and never an estimate."""

from __future__ import annotations

import math
import time
from pathlib import Path

import numpy as np
import pytest
from small_flight import small_events

from deckfix import recorder as module
from deckfix.check import compare_recorded
from deckfix.files import OutputError
from deckfix.intake import MOST_EVENTS, CompanionClock, Intake
from deckfix.pipeline import ImageEvent, Pipeline
from deckfix.recorder import Recorder, log_path
from deckfix.replaying import CONFIG_NAME, replay
from estimation.config import Config, dump_config
from estimation.events import COMPANION, Imu, VisionFix
from estimation.modes import Decision, Mode, Reason
from estimation.output import with_platform
from logs import open_flight
from logs.errors import LogError
from logs.writer import FlightWriter

UTC_NS = 1_795_000_000_000_000_000


def image(arrival_ns: int, side: int = 64) -> ImageEvent:
    return ImageEvent(arrival_ns, arrival_ns, np.zeros((side, side, 3), np.uint8), clock=COMPANION)


def begun(path: Path) -> tuple[Recorder, Pipeline]:
    """Begin a log with the configuration that is flown: without a camera, whatever fixes may come."""
    config = with_platform(Config(), False)
    pipeline = Pipeline(config, engine="filterpy")
    own = {CONFIG_NAME: ("application/toml", dump_config(config).encode())}
    made = Recorder(path, pipeline.estimator, own)
    made.begin()
    return made, pipeline


def test_a_folder_gets_a_file_named_by_the_time_and_nothing_is_overwritten(tmp_path: Path) -> None:
    made = log_path(tmp_path / "flights", UTC_NS)
    assert made == tmp_path / "flights" / "20261118-110640.mcap"
    made.write_bytes(b"a flight")
    with pytest.raises(OutputError, match="exists already"):
        log_path(tmp_path / "flights", UTC_NS)
    with pytest.raises(OutputError, match="is a file"):
        log_path(_file(tmp_path), UTC_NS)


def _file(folder: Path) -> Path:
    path = folder / "file"
    path.write_text("x")
    return path


def test_a_slow_disk_delays_nobody_and_costs_images_first(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    write = FlightWriter.write_series

    def slow(self: FlightWriter, *series: object) -> None:
        time.sleep(0.5)
        write(self, *series)  # type: ignore[arg-type]

    monkeypatch.setattr(FlightWriter, "write_series", slow)
    monkeypatch.setattr(module, "MOST_IMAGE_BYTES", 100_000)
    monkeypatch.setattr(module, "PERIOD_S", 0.02)
    made, pipeline = begun(tmp_path / "f.mcap")
    begin = time.monotonic()
    events = small_events(1.0)
    for k, event in enumerate(events):
        made.step(pipeline.step(event))
        if k % 5 == 0:
            made.image(image(event.arrival_ns))
    assert time.monotonic() - begin < 5.0
    assert made.drops["images"] > 0
    assert made.drops["steps"] == 0
    made.close()
    assert made.failed == ""
    log = open_flight(tmp_path / "f.mcap")
    assert len(log.events()) == len(events)


def test_a_full_disk_is_said_and_the_flight_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    made, pipeline = begun(tmp_path / "f.mcap")

    def full(self: FlightWriter, *series: object) -> None:
        raise LogError(self.path, "cannot be written (No space left on device)", "free space") from OSError()

    monkeypatch.setattr(FlightWriter, "write_series", full)
    monkeypatch.setattr(module, "PERIOD_S", 0.02)
    events = small_events(1.0)
    made.step(pipeline.step(events[0]))
    until = time.monotonic() + 5.0
    while not made.failed and time.monotonic() < until:
        time.sleep(0.01)
    made.step(pipeline.step(events[1]))
    assert "No space left" in made.failed
    assert made.drops["steps"] == 1
    made.close()


def test_the_queue_gives_what_came_in_the_order_of_arrivals_all_different() -> None:
    intake = Intake(lambda: UTC_NS)  # a clock that stands still
    intake.put([Imu(k, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for k in range(5)])
    intake.put_image(image(0))
    taken = [intake.get(0.0) for _ in range(6)]
    arrivals = [t.arrival_ns for t in taken if t is not None]
    assert arrivals == sorted(set(arrivals))
    assert len(arrivals) == 6
    assert intake.get(0.0) is None


def test_the_queue_is_bounded_and_keeps_the_newest_image() -> None:
    intake = Intake(CompanionClock())
    for k in range(3):
        intake.put_image(image(k, side=8 + k))
    intake.put([Imu(k, 0, (0.0, 0.0, 0.0), (0.0, 0.0, 0.0)) for k in range(MOST_EVENTS + 10)])
    assert intake.drops["images"] == 2
    assert intake.drops["events"] == 11
    first = intake.get(0.0)
    assert isinstance(first, ImageEvent)
    assert isinstance(first.image, np.ndarray)
    assert first.image.shape[0] == 10


def test_a_fix_before_the_clocks_were_compared_is_recorded_and_replays(tmp_path: Path) -> None:
    made, pipeline = begun(tmp_path / "f.mcap")
    events = small_events(2.0)
    first = events[0].arrival_ns
    early = VisionFix(first, first, (0.0, 0.0, 5.0), None, clock=COMPANION)
    for event in (*events[:1], early, *events[1:]):
        made.step(pipeline.step(event))
    made.step(pipeline.finish())
    made.close()
    assert made.failed == ""
    assert made.drops.total() == 0
    log = open_flight(tmp_path / "f.mcap")
    assert len(log.series("/vision/fix")[0]) == 1
    compared = compare_recorded(replay(log, engine="filterpy"), log)
    assert compared is not None
    assert compared[0] == []


def test_what_cannot_be_stored_is_left_out_and_the_rest_is_written(tmp_path: Path) -> None:
    made, pipeline = begun(tmp_path / "f.mcap")
    events = small_events(1.0)
    made.step(pipeline.step(events[0]))
    made.say(-5, 20, "from before 1970")
    made.close()
    assert made.failed == ""
    assert made.drops["texts"] == 1
    assert len(open_flight(tmp_path / "f.mcap").events()) == 1


def test_a_decision_that_cannot_be_stored_costs_no_estimate(tmp_path: Path) -> None:
    """They are written together, but what is wrong with the one is not counted on the other."""
    made, pipeline = begun(tmp_path / "f.mcap")
    steps = [pipeline.step(event) for event in small_events(3.0)]
    nan = np.full(3, np.nan)
    decision = Decision(Mode.IDLE, Reason.NOT_READY, nan, 0.0, 0.1, nan, math.nan, math.nan)
    for step in steps:
        made.step(step)
    last = steps[-1].event
    assert last is not None
    made.decision(last.stamp_ns, -5, decision)
    made.close()
    assert made.failed == ""
    assert made.drops == {"decisions": 1}
    estimates = open_flight(tmp_path / "f.mcap").series("/estimate/odometry")
    assert sum(len(s) for s in estimates) == sum(s.estimate is not None for s in steps) > 0

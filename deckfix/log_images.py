"""The images of a log, looked at off line: every frame by itself, in as many processes as there are cores.

In flight each image is looked at with what the filter knew just then (``deckfix.pipeline``), and the fix is recorded.
Where only the images are recorded, what a frame shows must not depend on which process looks at it, or when: it is
searched whole, without a prior, with the attitude of a first pass of the filter over the log without vision, at the
time of its content. The fixes then take their images' places in the order of arrival, as in flight.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec
import numpy as np
from numpy.typing import NDArray

from deckfix.files import InputError
from deckfix.parallel import WorkerLost, Workers
from deckfix.pipeline import (
    UNDECODABLE,
    VISION_ENGINES,
    DetectorSettings,
    ImageEvent,
    body_to_camera,
    fix_event,
    look_at,
)
from deckfix.reference import Trajectory, quaternion_column
from deckfix.video_import import CAMERA_NAME, TARGET_NAME
from estimation.clockbank import ClockBank
from estimation.config import Config
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import AUTOPILOT, EventBatch, Kind, TimeSync, unpack
from estimation.frames import Array, quat_to_matrix
from estimation.output import Facts, Run, with_facts
from logs.events import as_logged
from logs.images import camera_info, images
from logs.images import count as count_images
from vision.camera import Camera
from vision.detector import TargetDetector
from vision.fix import NoFix
from vision.fix import VisionFix as Fix
from vision.target import RingTarget

if TYPE_CHECKING:
    from estimation.events import VisionFix
    from logs.reader import Flight

Times = NDArray[np.int64]

BLOCK = 24
"""Frames that a process is given at a time, at least."""
ATTITUDE_RATE_HZ = 100.0
"""Rate of the first pass's estimates, between which the attitude is interpolated."""
RATE_NS = 20_000_000
"""The body's rate is the mean of the inertial samples this close to the image."""


@dataclass(frozen=True, slots=True)
class ImagesTold:
    """What became of a log's images.

    ``source`` of the fixes: ``images``, ``recorded`` (fixes that the log holds) or ``none``, with ``why`` (``lacking``:
    they could not be looked at). ``frames``
    were in the log, ``undecodable`` of them damaged; ``no_fix`` counts the reasons. ``fixes`` are the events, in the
    order of arrival; ``sensors`` are the names of those sensors whose recorded fixes they replace.
    """

    source: str
    frames: int
    undecodable: int = 0
    no_fix: dict[str, int] = field(default_factory=dict)
    fixes: EventBatch | None = None
    sensors: tuple[str, ...] = ()
    why: str = ""
    lacking: bool = False

    def block(self) -> dict[str, object]:
        """Return the summary's ``vision``."""
        out: dict[str, object] = {"source": self.source, "frames": self.frames}
        if self.source == "images":
            out |= {"fixes": len(self.fixes or ()), "undecodable": self.undecodable, "no_fix": self.no_fix}
        elif self.why:
            out["reason"] = self.why
        return out

    def sentence(self) -> str:
        """Return what became of the images, for a person."""
        if self.source == "images":
            damaged = f", {self.undecodable} cannot be decoded" if self.undecodable else ""
            return f"{len(self.fixes or ())} of {self.frames} images gave a fix{damaged}"
        if self.source == "recorded":
            return f"the {self.frames} images were not looked at: the log holds fixes already (--images does)"
        return f"the {self.frames} images were not looked at: {self.why}"

    def replace_in(self, batch: EventBatch) -> EventBatch:
        """Return the log's events with these fixes in place of the recorded ones of the same camera."""
        if self.fixes is None:
            return batch
        named = [batch.sensors.index(s) for s in self.sensors if s in batch.sensors]
        old = (batch.rows["kind"] == int(Kind.VISION)) & np.isin(batch.rows["sensor"], named)
        rest = EventBatch(batch.rows[~old], batch.sensors, batch.clocks, batch.timesync_reference)
        return EventBatch.concatenate([rest, self.fixes]) if len(self.fixes) else rest


@dataclass(frozen=True, slots=True)
class _Sight:
    """An image without its pixels, and what is known of its moment: camera to NED, the body's rate."""

    stamp_ns: int
    arrival_ns: int
    clock: str
    sensor: str
    R_nc: Array | None = None
    rate_radps: Array | None = None


@dataclass(frozen=True, slots=True)
class _Task:
    """A block of frames that follow each other in the log, and what looks at them."""

    path: Path
    sights: tuple[_Sight, ...]
    camera: Camera
    target: RingTarget
    settings: DetectorSettings
    R_cb: Array
    engine: str


def images_told(
    flight: Flight,
    batch: EventBatch,
    config: Config,
    known: Facts,
    engine: EngineName = "auto",
    *,
    wanted: bool | None = None,
    jobs: int | None = None,
) -> ImagesTold | None:
    """Return what a log's images show, or None where it has none and none are ``wanted``.

    ``wanted`` True looks at them even where the log holds the fixes already, False never does, None where it holds
    neither fixes nor estimates (whoever made these had the images).
    Raises ``InputError`` where they are wanted and cannot be looked at, or camera or target are damaged.
    """
    frames = count_images(flight)
    if not frames and not wanted:
        return None
    recorded = bool(np.any(batch.rows["kind"] == int(Kind.VISION)))
    if wanted is False or (wanted is None and recorded):
        return ImagesTold("recorded" if recorded else "none", frames, why="" if recorded else "not asked for")
    if wanted is None and "/estimate/odometry" in flight.topics:
        return ImagesTold("none", frames, why="the log holds estimates without fixes (--images does)")
    camera, target = camera_of(flight), target_of(flight)
    missing = [n for n, v in (("images", frames), ("camera", camera), ("target", target)) if not v]
    if missing and wanted:
        raise InputError(
            f"{flight.path}: holds no {' and no '.join(missing)}; add what is missing: deckfix import {flight.path} "
            "--video V --camera C.toml --target T.toml -o G.mcap"
        )
    if camera is None or target is None:
        return ImagesTold("none", frames, why=f"the log holds no {' and no '.join(missing)}", lacking=True)
    R_cb = body_to_camera(config)
    sights = list(_sights(flight, batch, config, known, engine))
    how = (camera, target, DetectorSettings(), R_cb, VISION_ENGINES[engine])
    tasks = [_Task(Path(flight.path), block, *how) for block in _blocks(sights)]
    return _told(sights, _looked_at(tasks, jobs))


def camera_of(flight: Flight) -> Camera | None:
    """Return the camera that a log carries, or that its camera_info tells; raises ``InputError`` for a damaged one."""
    own = flight.attachments.get(CAMERA_NAME)
    try:
        if own is not None:
            return Camera.from_toml(own[1].decode("utf-8", errors="replace"))
        told = camera_info(flight)
        return None if told is None else Camera.from_camera_info(told)
    except ValueError as error:
        raise InputError(f"{flight.path}: its camera: {error}; {_AGAIN}") from None


def target_of(flight: Flight) -> RingTarget | None:
    """Return the target that a log carries; raises ``InputError`` for a damaged one."""
    own = flight.attachments.get(TARGET_NAME)
    try:
        return None if own is None else RingTarget.from_toml(own[1].decode("utf-8", errors="replace"))
    except ValueError as error:
        raise InputError(f"{flight.path}: its target: {error}; {_AGAIN}") from None


_AGAIN = "give a sound one: deckfix import F.mcap --camera C.toml --target T.toml -o G.mcap"


def look(task: _Task) -> list[Fix | NoFix]:
    """Return what each frame of a block shows."""
    from logs.reader import open_flight

    settings = msgspec.structs.asdict(task.settings)
    detector = TargetDetector(task.camera, task.target, R_cb=task.R_cb, engine=task.engine, **settings)
    first, last = task.sights[0].arrival_ns, task.sights[-1].arrival_ns
    stream = images(open_flight(task.path), first, last + 1)
    return [
        look_at(detector, image.data, sight.R_nc, None, sight.rate_radps)
        for sight, image in zip(task.sights, stream, strict=True)
    ]


def _blocks(sights: list[_Sight]) -> Iterator[tuple[_Sight, ...]]:
    """Yield blocks; images of equal arrival stay together, since arrivals are what a block is read by."""
    begin = 0
    for k in range(1, len(sights) + 1):
        apart = k == len(sights) or sights[k].arrival_ns != sights[k - 1].arrival_ns
        if apart and (k - begin >= BLOCK or k == len(sights)):
            yield tuple(sights[begin:k])
            begin = k


def _looked_at(tasks: list[_Task], jobs: int | None) -> list[Fix | NoFix]:
    """Return what each frame shows, in the order of the tasks."""
    from os import cpu_count

    found: dict[int, list[Fix | NoFix]] = {}
    with Workers(min(jobs or cpu_count() or 1, max(1, len(tasks)))) as workers:
        for index, answer in workers.each(look, tasks):
            if isinstance(answer, WorkerLost):
                raise InputError(f"{tasks[index].path}: its images cannot be looked at: {answer}")
            found[index] = answer
    return [shown for index in range(len(tasks)) for shown in found[index]]


def _told(sights: list[_Sight], shown: list[Fix | NoFix]) -> ImagesTold:
    reasons: Counter[str] = Counter()
    events: list[VisionFix] = []
    for sight, one in zip(sights, shown, strict=True):
        if isinstance(one, NoFix):
            reasons[one.reason] += 1
        else:
            image = ImageEvent(sight.stamp_ns, sight.arrival_ns, b"", sight.sensor, sight.clock)
            events.append(as_logged(fix_event(image, one)))  # type: ignore[arg-type]
    undecodable = reasons.pop(UNDECODABLE, 0)
    sensors = tuple(sorted({s.sensor for s in sights}))
    ordered = dict(sorted(reasons.items(), key=lambda r: (-r[1], r[0])))
    return ImagesTold("images", len(sights), undecodable, ordered, EventBatch.from_events(events), sensors)


# -- the moment of each image --------------------------------------------------------------------------------------


def _sights(
    flight: Flight, batch: EventBatch, config: Config, known: Facts, engine: EngineName
) -> Iterator[_Sight]:
    """Yield the images with the attitude and the rate that the first pass gives for their content."""
    seen = [_Sight(i.stamp_ns, i.arrival_ns, i.clock, i.sensor) for i in images(flight)]
    times = _content_times(seen, batch, with_facts(config, known).vision.latency_s)
    run = _first_pass(batch, config, known, engine)
    attitude = Trajectory(None, None, quaternion_column(run.t_ns, run.quaternion))
    there = np.array([t is not None for t in times], bool)
    at = np.array([t or 0 for t in times], np.int64)
    q = attitude.quaternion_at(at)
    q[~there] = np.nan
    rate = _rates(at, batch, run)
    R_cb = body_to_camera(config)
    for k, one in enumerate(seen):
        if not np.isfinite(q[k]).all():
            yield one
            continue
        R_nc = quat_to_matrix(q[k]) @ R_cb.T
        yield _Sight(one.stamp_ns, one.arrival_ns, one.clock, one.sensor, R_nc, rate[k])


def _first_pass(batch: EventBatch, config: Config, known: Facts, engine: EngineName) -> Run:
    """Return the estimates from everything but vision, dense enough for the attitude between them."""
    c = msgspec.structs.replace
    alone = c(
        config,
        platform=c(config.platform, use=False),
        filter=c(config.filter, output_rate_hz=ATTITUDE_RATE_HZ),
    )
    rows = batch.rows[batch.rows["kind"] != int(Kind.VISION)]
    rest = EventBatch(rows, batch.sensors, batch.clocks, batch.timesync_reference)
    return LandingEstimator(alone, engine, known).run(rest)


def _content_times(seen: list[_Sight], batch: EventBatch, latency_s: float) -> list[int | None]:
    """Return when each image's content was true on the inertial clock, as known at its arrival; None where unknown."""
    bank = ClockBank(AUTOPILOT)
    home = batch.clocks.index(AUTOPILOT) if AUTOPILOT in batch.clocks else -1
    kind = batch.rows["kind"]
    telling = np.flatnonzero(
        (batch.rows["clock"] != home) | (kind == int(Kind.TIMESYNC)) | (kind == int(Kind.GPS_POSITION))
    )
    arrivals = batch.rows["arrival_ns"][telling]
    out: list[int | None] = []
    begin, age_ns = 0, round(latency_s * 1e9)
    for image in seen:
        end = max(begin, int(np.searchsorted(arrivals, image.arrival_ns, side="right")))
        for k in telling[begin:end]:
            event = unpack(batch.rows[k], batch.sensors, batch.clocks, batch.timesync_reference)
            if isinstance(event, TimeSync):
                bank.exchange(event)
            else:
                bank.observe(event.clock, event.stamp_ns, event.arrival_ns)
        begin = end
        bank.observe(image.clock, image.stamp_ns, image.arrival_ns)
        reading = bank.look(image.clock, image.stamp_ns)
        out.append(None if reading is None else reading.time_ns - age_ns)
    return out


def _rates(at_ns: Times, batch: EventBatch, run: Run) -> Array:
    """Return the body's angular velocity (n, 3) [rad/s] about some times, less the gyro's bias there."""
    rows = batch.rows[batch.rows["kind"] == int(Kind.IMU)]
    rows = rows[np.isfinite(rows["value"][:, :3]).all(axis=1)]
    rows = rows[np.argsort(rows["stamp_ns"], kind="stable")]
    first = np.searchsorted(rows["stamp_ns"], at_ns - RATE_NS)
    last = np.searchsorted(rows["stamp_ns"], at_ns + RATE_NS, side="right")
    out = np.zeros((len(at_ns), 3))
    for k, (a, b) in enumerate(zip(first.tolist(), last.tolist(), strict=True)):
        if b > a and len(run.t_ns):
            near = min(max(int(np.searchsorted(run.t_ns, at_ns[k])), 0), len(run.t_ns) - 1)
            out[k] = rows["value"][a:b, :3].mean(axis=0) - run.gyro_bias[near]
    return out

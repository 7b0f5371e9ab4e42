"""A mission flown on what its camera sees: pictures are rendered as the flight goes on, and looked at by the pipeline.

Each picture is rendered at its exposure, with a mounting error as the description allows it, and compressed as a camera
does it, in a thread of its own; when its message arrives, ``Pipeline.step`` looks at it, as on board. The fixes found
take the places of their pictures in the flight's log.
"""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from deckfix.pipeline import ImageEvent, Pipeline
from deckfix.video_import import CAMERA_NAME, TARGET_NAME
from estimation.config import ConfigError
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import EventBatch, VisionFix
from estimation.frames import Array
from estimation.modes import Decision
from estimation.output import Estimate
from logs.images import TOPIC
from logs.writer import FlightWriter
from simulation.exposure import expose, renderer_of
from simulation.instruments import Instant, Instruments
from simulation.mission import Mission
from simulation.mission_log import mission_recording
from simulation.renderer import Renderer
from simulation.sensors import CLOCKS
from simulation.world import Flown, facts_of, fly

KEPT_HZ = 2.0
"""Pictures a second that the log keeps: all of them are looked at."""
_UNDRAWN = ("camera_freeze", "false_target")


@dataclass(slots=True)
class Companion:
    """The camera and the computer of one flight: told the moment of each picture, takes the messages.

    ``kept`` are the pictures for the log, as the pipeline got them.
    """

    mission: Mission
    pipeline: Pipeline
    renderer: Renderer
    rng: np.random.Generator
    workers: ThreadPoolExecutor
    mount_rad: Array
    kept: list[ImageEvent] = field(default_factory=list)
    _exposed: dict[float, Future[bytes | None]] = field(default_factory=dict)
    _kept_s: float = -np.inf

    def __call__(self, now: Instant) -> bool:
        """Expose a picture."""
        vision = self.mission.drawn.vision
        self._exposed[now.t_s] = self.workers.submit(
            expose, self.renderer, vision, now, self.rng, self.mount_rad
        )
        return True

    @property
    def estimator(self) -> LandingEstimator:
        """The pipeline's."""
        return self.pipeline.estimator

    def take(self, instruments: Instruments, t_s: float) -> Estimate | None:
        """Take what has arrived by a time, pictures included, and return the newest estimate if one came."""
        numbers = instruments.arrived(t_s)
        batch = EventBatch(instruments.rows[numbers], instruments.names, CLOCKS)
        newest = None
        for number, event in zip(numbers.tolist(), batch, strict=True):
            if not isinstance(event, VisionFix):
                step = self.pipeline.step(event)
            else:
                data = self._exposed.pop(float(instruments.content_s[number])).result()
                if data is None:
                    instruments.settle(number, None)
                    continue
                image = ImageEvent(event.stamp_ns, event.arrival_ns, data, event.sensor, event.clock)
                self._keep(image, t_s)
                step = self.pipeline.step(image)
                instruments.settle(number, step.event if isinstance(step.event, VisionFix) else None)
            newest = step.estimate or newest
        return newest

    def _keep(self, image: ImageEvent, t_s: float) -> None:
        if t_s - self._kept_s >= 1.0 / KEPT_HZ - 1e-6:
            self._kept_s = t_s
            self.kept.append(image)


def fly_rendered(
    mission: Mission,
    seed: int | None = None,
    *,
    engine: EngineName = "auto",
    watch: Callable[[float, Decision | None], None] | None = None,
) -> tuple[Flown, Companion]:
    """Fly a mission on rendered pictures; return the flight, and what looked at them.

    The same mission, seed, engine and versions give the same flight. Raises ``ConfigError`` for a mission whose mishaps
    falsify fixes: here they come from pictures.
    """
    for mishap in mission.mishaps:
        if mishap.kind in _UNDRAWN:
            raise ConfigError(f"mishap {mishap.kind!r}: falsifies fixes, but here pictures are looked at")
    number = mission.seed if seed is None else seed
    rng = np.random.default_rng([number, 79])
    mount = mission.drawn.vision.mount_sigma_rad * rng.standard_normal(3)
    renderer = renderer_of(mission)
    pipeline = Pipeline(
        mission.config, renderer.camera, renderer.target, engine=engine, facts=facts_of(mission)
    )
    with ThreadPoolExecutor(1, "camera") as workers:
        companion = Companion(mission, pipeline, renderer, rng, workers, mount)
        flown = fly(mission, number, engine=engine, camera=companion, computer=companion, watch=watch)
    return flown, companion


def write_rendered(path: Path, flown: Flown, companion: Companion) -> None:
    """Write the log of a flight on rendered pictures: as ``mission_recording``, with the camera, the target and some of
    the pictures.
    """
    pipeline = companion.pipeline
    assert pipeline.camera is not None and pipeline.target is not None
    recording = mission_recording(flown)
    for name, one in ((CAMERA_NAME, pipeline.camera), (TARGET_NAME, pipeline.target)):
        recording.attachments[name] = ("application/toml", one.to_toml().encode())
    with FlightWriter(path, force=True) as writer:
        writer.write_recording(recording)
        for image in companion.kept:
            writer.write_message(
                TOPIC, {"format": "jpeg", "data": image.image},
                arrival_ns=image.arrival_ns, stamp_ns=image.stamp_ns, clock=image.clock,
            )  # fmt: skip

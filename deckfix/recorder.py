"""The flight's log, written beside the estimator: whatever the disk does, no estimate waits for it.

What the pipeline took and gave is put into a bounded queue and written twice a second by a thread of its own, so that a
killed process loses at most a second. Where the disk is too slow, images are dropped first, and then all of a batch;
what was dropped is counted. A log that cannot be written any more is given up, and said to be.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from deckfix._version import __version__
from deckfix.estimate_log import SOFTWARE, estimate_series
from deckfix.files import OutputError, check_output, output_folder
from deckfix.forecasts import forecasts
from deckfix.pipeline import ImageEvent, Step
from estimation.estimator import LandingEstimator
from estimation.events import AUTOPILOT, COMPANION, EVENT_DTYPE, EventBatch, Names, pack
from estimation.modes import Decision
from estimation.output import RECORD_DTYPE, Estimate, Run
from estimation.state import BA0, BG0, P0, Q0, V0
from logs.errors import LogError
from logs.estimates import landing_series
from logs.events import series_of_batch
from logs.recording import Series
from logs.sensors import Times, log_series
from logs.writer import FlightWriter

PERIOD_S = 0.4
MOST_STEPS = 20_000
MOST_IMAGE_BYTES = 64 << 20
"""What may wait for the disk: some minute of steps, some seconds of images."""
DEBUG, INFO, WARN, ERROR = 10, 20, 30, 40


def log_path(record: str | Path, utc_ns: int) -> Path:
    """Return the file to record to: the one that is named, or one named by the time in the folder that is.

    Raises ``OutputError`` where it exists or cannot be written.
    """
    given = Path(record)
    if given.suffix == ".mcap":
        return check_output(given, force=False)
    folder = output_folder(given)
    stem = datetime.fromtimestamp(utc_ns * 1e-9, UTC).strftime("%Y%m%d-%H%M%S")
    return check_output(folder / f"{stem}.mcap", force=False)


@dataclass(slots=True)
class Recorder:
    """Writes one flight's log: ``begin``, then ``step``, ``image`` and ``decision`` from the estimator's thread,
    ``say`` from any, and ``close``.

    ``drops`` counts what was not written; ``failed`` says why nothing is written any more. ``imu_metadata`` is what the
    channel of the inertial sensor carries (its latency).
    """

    path: Path
    estimator: LandingEstimator
    attachments: Mapping[str, tuple[str, bytes]]
    imu_metadata: Mapping[str, str] = field(default_factory=dict)
    jpeg_quality: int = 80
    drops: Counter[str] = field(default_factory=Counter)
    written: int = 0
    failed: str = ""
    _writer: FlightWriter | None = None
    _steps: deque[Step] = field(default_factory=deque)
    _images: deque[ImageEvent] = field(default_factory=deque)
    _image_bytes: int = 0
    _decisions: deque[tuple[int, int, Decision]] = field(default_factory=deque)
    _texts: deque[tuple[int, str, int, str]] = field(default_factory=deque)
    _lock: threading.Lock = field(default_factory=threading.Lock)
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None
    _names: Names = field(default_factory=Names)

    def begin(self) -> None:
        """Create the file and start to write; raises ``OutputError`` where it cannot be created."""
        try:
            self._writer = FlightWriter(self.path)
            self._writer.set_clocks({COMPANION: 0})
            for name, (media_type, data) in self.attachments.items():
                self._writer.add_attachment(name, media_type, data)
            engine = self.estimator.engine_name
            self._writer.add_metadata(SOFTWARE, {"software": f"deckfix {__version__}", "engine": engine})
            self._writer.flush()
        except LogError as error:
            raise OutputError(str(error)) from None
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    # -- what is put in --------------------------------------------------------------------------------------------

    def step(self, step: Step) -> None:
        """Take what the pipeline took and gave."""
        if self._full(len(self._steps) >= MOST_STEPS, "steps"):
            return
        self._steps.append(step)

    def image(self, image: ImageEvent) -> None:
        """Take an image."""
        size = _size(image)
        if self._full(self._image_bytes + size > MOST_IMAGE_BYTES, "images"):
            return
        with self._lock:
            self._image_bytes += size
        self._images.append(image)

    def decision(self, t_ns: int, arrival_ns: int, decision: Decision) -> None:
        """Take what the landing decided, at a time of the inertial clock."""
        if not self._full(len(self._decisions) >= MOST_STEPS, "decisions"):
            self._decisions.append((t_ns, arrival_ns, decision))

    def say(self, arrival_ns: int, level: int, text: str, who: str = "deckfix") -> None:
        """Take a sentence for ``/log``."""
        if not self._full(len(self._texts) >= MOST_STEPS, "texts"):
            self._texts.append((arrival_ns, who, level, text))

    def _full(self, full: bool, what: str) -> bool:
        if full or self.failed or self._writer is None:
            self.drops[what] += 1
            return True
        return False

    def close(self, timeout_s: float = 10.0) -> None:
        """Write what waits, and complete the file; closing twice does nothing."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(timeout_s)
            if self._thread.is_alive():
                self.failed = f"{self.path}: the disk did not take the rest within {timeout_s:g} s"
                return
            self._thread = None
        if self._writer is not None:
            try:
                self._writer.close()
            except LogError as error:
                self.failed = self.failed or str(error)
            self._writer = None

    # -- the writing thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        while not self._stop.wait(PERIOD_S):
            self._write()
        self._write()

    def _write(self) -> None:
        """Write all that waits, in one go."""
        writer = self._writer
        if writer is None or self.failed:
            return
        try:
            steps = [self._steps.popleft() for _ in range(len(self._steps))]
            for _ in range(len(self._images)):
                self._write_image(writer, self._images.popleft())
            # The first message of a clock fixes its constant, which the estimates of that clock need.
            self._put(writer, sensors=self._sensors(steps))
            offset = writer.clock_offsets_ns.get(AUTOPILOT)
            if offset is not None:
                run = run_of(steps, self.estimator)
                told = estimate_series(run, offset, forecasts([]))
                self._put(writer, estimates=told, decisions=self._decided())
            self._put(writer, texts=self._said())
            writer.flush()
            self.written += len(steps)
        except LogError as error:
            self.failed = str(error)

    def _put(self, writer: FlightWriter, **series: list[Series]) -> None:
        """Write series, in one chunk; what cannot be stored is counted and left out, a disk's error passed on."""
        named = [(what, one) for what, some in series.items() for one in some]
        try:
            writer.write_series(*(one for _, one in named))
        except LogError as error:
            if isinstance(error.__cause__, OSError):
                raise
            if len(named) == 1:
                self.drops[named[0][0]] += len(named[0][1])
                return
            for what, one in named:
                self._put(writer, **{what: [one]})

    def _sensors(self, steps: list[Step]) -> list[Series]:
        events = [s.event for s in steps if s.event is not None]
        if not events:
            return []
        rows = np.array([pack(e, self._names) for e in events], dtype=EVENT_DTYPE)
        series = series_of_batch(EventBatch(rows, tuple(self._names.sensors), tuple(self._names.clocks)))
        for one in series:
            if one.topic == "/imu":
                one.metadata.update(self.imu_metadata)
        return series

    def _write_image(self, writer: FlightWriter, image: ImageEvent) -> None:
        with self._lock:
            self._image_bytes -= _size(image)
        data = image.image if isinstance(image.image, bytes) else _jpeg(image.image, self.jpeg_quality)
        writer.write_message(
            "/camera/image/compressed", {"format": "jpeg", "data": data},
            arrival_ns=image.arrival_ns, stamp_ns=image.stamp_ns, clock=image.clock,
        )  # fmt: skip

    def _decided(self) -> list[Series]:
        taken = [self._decisions.popleft() for _ in range(len(self._decisions))]
        if not taken:
            return []
        stamp = np.array([t for t, _, _ in taken], np.int64)
        return landing_series(stamp, np.array([a for _, a, _ in taken], np.int64), [d for _, _, d in taken])

    def _said(self) -> list[Series]:
        taken = [self._texts.popleft() for _ in range(len(self._texts))]
        made = []
        for who in dict.fromkeys(w for _, w, _, _ in taken):
            own = [t for t in taken if t[1] == who]
            at = np.array([t[0] for t in own], np.int64)
            made += log_series(Times(at, at, COMPANION), who, [t[2] for t in own], [t[3] for t in own])
        return made


def run_of(steps: list[Step], estimator: LandingEstimator) -> Run:
    """Return what single steps led to as columns, as ``LandingEstimator.run`` gives it for a batch."""
    estimates = [s.estimate for s in steps if s.estimate is not None]
    records = [s.output.records for s in steps if s.output is not None and len(s.output.records)]
    x = _stacked(estimates, "nominal")
    none: dict[Any, int] = {}
    return Run(
        engine=estimator.engine_name,
        t_ns=np.array([e.t_ns for e in estimates], np.int64),
        position_m=x[:, P0 : P0 + 3], velocity_mps=x[:, V0 : V0 + 3], quaternion=x[:, Q0 : Q0 + 4],
        covariance=_stacked(estimates, "covariance"),
        gyro_bias=x[:, BG0 : BG0 + 3], accel_bias=x[:, BA0 : BA0 + 3],
        nominal=x, sigma=_stacked(estimates, "sigma"),
        state_names=estimator.layout.names, state_units=estimator.layout.units,
        deck=_stacked(estimates, "deck"), deck_covariance=_stacked(estimates, "deck_covariance"),
        heave=[], clocks=[],
        records=np.concatenate(records) if records else np.empty(0, RECORD_DTYPE),
        sensors=estimator.sensors, notes=[], imu_outcomes=none, origin=None, declination_rad=None, missing="",
    )  # fmt: skip


def _stacked(estimates: list[Estimate], name: str) -> NDArray[np.float64]:
    if not estimates:
        return np.empty((0, 64))
    return np.stack([getattr(e, name) for e in estimates])


def _size(image: ImageEvent) -> int:
    return image.image.nbytes if isinstance(image.image, np.ndarray) else len(image.image)


def _jpeg(picture: NDArray[np.uint8], quality: int) -> bytes:
    import cv2

    done, data = cv2.imencode(".jpg", picture, [cv2.IMWRITE_JPEG_QUALITY, quality])
    return bytes(data) if done else b""

"""The pipeline: events and images in, in the order of their arrival; estimates, fixes and records out.

An image is looked at where it stands in the order of arrival: with the attitude and the expectation that the
estimates up to there give. The fix that it leads to takes the image's place, with the image's stamp and arrival, and
goes to the estimator like any other event. A log that holds the fix therefore replays without the image, bit for bit;
the image is only looked at again where somebody asks for that.

Every event is stepped as a log gives it back (``logs.events.as_logged``). Nothing here reads a clock, a file or a
global: the same events give the same bits, live and in replay.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Iterable
from concurrent.futures import Executor
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimation.config import Config
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import CAMERA, Event, Imu, VisionFix
from estimation.frames import (
    R_CB_NOMINAL,
    Array,
    euler_to_quat,
    quat_exp,
    quat_multiply,
    quat_to_matrix,
)
from estimation.output import Estimate, Facts, Output
from estimation.state import BG0, CL0
from logs.events import as_logged
from vision.camera import Camera
from vision.detector import TargetDetector
from vision.fix import NoFix
from vision.fix import VisionFix as Fix
from vision.target import RingTarget

Picture = NDArray[np.uint8]

MEMORY_NS = 1_500_000_000
"""How long estimates are kept to look up the attitude of an image."""
AHEAD_NS = 200_000_000
"""An image later than the last estimate by more than this has no attitude."""
PRIOR_NS = 500_000_000
"""Age up to which the last fix is where the target is looked for first."""
PRIOR_SHARE = 0.1
"""1-sigma of the expected place, as a share of the distance, above which the filter's expectation is no prior."""
RATE_NS = 20_000_000
"""The body's rate is the mean of the inertial samples this close to the image."""

VISION_ENGINES = {"auto": "auto", "compiled": "compiled", "filterpy": "numpy"}
"""The detector's engine beside the filter's: reference with reference, compiled with compiled."""

UNDECODABLE = "the image cannot be decoded"
"""The reason of an image that is damaged, or of a format that is not known."""


class DetectorSettings(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """How images are looked at: arguments of ``vision.TargetDetector``.

    The filter carries the attitude's error of a fix, so that the detector is told of none.
    """

    method: str = "rings"
    deck_tilt_sigma_rad: float = 0.0
    focal_sigma: float = 0.0
    principal_point_sigma_px: float = 0.0
    min_share: float = 0.55


@dataclass(frozen=True, slots=True)
class ImageEvent:
    """An image as it arrived: encoded (JPEG, PNG) bytes, or pixels (height, width, 3) uint8 BGR.

    ``stamp_ns`` is the capture's, in ``clock``; for a rolling shutter that of the middle row.
    """

    stamp_ns: int
    arrival_ns: int
    image: bytes | Picture
    sensor: str = "vision"
    clock: str = CAMERA


@dataclass(slots=True)
class Step:
    """What one event led to.

    ``event`` is what the estimator was given (None: an image without a fix) and ``output`` what it made of it;
    ``detection`` is what an image showed.
    """

    event: Event | None
    output: Output | None
    detection: Fix | NoFix | None = None

    @property
    def estimate(self) -> Estimate | None:
        """The estimate that came out, if one did."""
        return None if self.output is None else self.output.estimate


@dataclass(slots=True)
class Pipeline:
    """Vision and estimator as one: ``step(event)``.

    ``camera`` and ``target`` are needed for images; without them an image is counted and has no fix. ``executor`` is
    where the estimator may learn the platform's motion (``LandingEstimator``). Raises
    ``ConfigError`` for an engine that is not there, ``ValueError`` naming a detector setting that cannot be used.
    """

    config: Config = field(default_factory=Config)
    camera: Camera | None = None
    target: RingTarget | None = None
    settings: DetectorSettings = field(default_factory=DetectorSettings)
    engine: EngineName = "auto"
    facts: Facts = field(default_factory=Facts)
    executor: Executor | None = None
    estimator: LandingEstimator = field(init=False)
    counts: Counter[str] = field(default_factory=Counter)
    """Images, fixes, and images without a fix by reason."""
    _detector: TargetDetector | None = None
    _R_cb: Array = field(init=False)
    _lever_m: Array = field(init=False)
    _estimates: deque[Estimate] = field(default_factory=deque)
    _rates: deque[tuple[int, Array]] = field(default_factory=deque)
    _last: tuple[int, Fix] | None = None

    def __post_init__(self) -> None:
        """Build the estimator and the detector."""
        self.estimator = LandingEstimator(
            self.config, engine=self.engine, facts=self.facts, executor=self.executor
        )
        self._R_cb = body_to_camera(self.config)
        self._lever_m = np.array(self.config.vision.lever_arm_m)
        if self.camera is not None and self.target is not None:
            s = msgspec.structs.asdict(self.settings)
            self._detector = TargetDetector(
                self.camera, self.target, R_cb=self._R_cb, engine=VISION_ENGINES[self.engine], **s
            )

    def step(self, event: Event | ImageEvent) -> Step:
        """Take one event or image, in the order of arrival."""
        if not isinstance(event, ImageEvent):
            return self._estimate(as_logged(event))
        self.counts["images"] += 1
        time_ns = self._content_ns(event)
        found = self._look(event.image, time_ns)
        if isinstance(found, NoFix):
            self.counts[f"no fix: {found.reason}"] += 1
            return Step(None, None, found)
        self.counts["fixes"] += 1
        if time_ns is not None:
            self._last = time_ns, found
        step = self._estimate(as_logged(fix_event(event, found)))
        step.detection = found
        return step

    def run(self, events: Iterable[Event | ImageEvent]) -> list[Step]:
        """Take events in the order of arrival and return every step."""
        return [self.step(event) for event in events]

    def finish(self) -> Step:
        """Settle what is still in the estimator's window: the records that a replay's end has, too."""
        return Step(None, self.estimator.settled())

    def expected(self, time_ns: int | None) -> Fix | Array | None:
        """Return where the target should be in the camera at an inertial time: P^c [m], or a fix moved there.

        None where neither the filter nor a recent fix tells.
        """
        recent = None
        if self._last is not None and time_ns is not None and abs(time_ns - self._last[0]) <= PRIOR_NS:
            recent = self._last[1]
        place = self._predicted(time_ns)
        if place is None:
            return recent
        return place if recent is None else replace(recent, position_cam_m=place)

    def attitude(self, time_ns: int | None) -> Array | None:
        """Return the rotation (3, 3) of body to NED at an inertial time, or None where it is not known."""
        near = self._nearest(time_ns)
        if near is None or time_ns is None:
            return None
        rate = self._rate(time_ns, near.nominal)
        turned = quat_multiply(near.quaternion, quat_exp(rate * (time_ns - near.t_ns) * 1e-9))
        return quat_to_matrix(turned)

    # -- the estimator's side ----------------------------------------------------------------------------------

    def _estimate(self, event: Event) -> Step:
        if isinstance(event, Imu):
            rate = np.array(event.angular_velocity_radps)
            if np.isfinite(rate).all():
                self._rates.append((event.stamp_ns, rate))
                while self._rates[0][0] < event.stamp_ns - MEMORY_NS or len(self._rates) > 2000:
                    self._rates.popleft()
        output = self.estimator.step(event)
        if output.estimate is not None:
            if self._estimates and output.estimate.t_ns <= self._estimates[-1].t_ns:
                self._estimates.clear()  # the inertial clock went back
            self._estimates.append(output.estimate)
            while self._estimates[0].t_ns < output.estimate.t_ns - MEMORY_NS:
                self._estimates.popleft()
        return Step(event, output)

    def _content_ns(self, event: ImageEvent) -> int | None:
        """Return when the image's content was true, on the inertial clock."""
        stamp = self.estimator.inertial_time_ns(event.clock, event.stamp_ns)
        if stamp is None:
            return None
        age_s = self.estimator.config.vision.latency_s
        if self.estimator.config.platform.use is True and self._estimates:
            age_s += float(self._estimates[-1].nominal[CL0])
        return stamp - round(age_s * 1e9)

    def _nearest(self, time_ns: int | None) -> Estimate | None:
        """Return the estimate from which the state at a time is best extrapolated."""
        if time_ns is None or not self._estimates:
            return None
        if not self._estimates[0].t_ns <= time_ns <= self._estimates[-1].t_ns + AHEAD_NS:
            return None
        for estimate in reversed(self._estimates):
            if estimate.t_ns <= time_ns:
                return estimate
        return None

    def _rate(self, time_ns: int, nominal: Array) -> Array:
        """Return the body's angular velocity [rad/s] about a time, less the gyro's bias."""
        near = [r for t, r in self._rates if abs(t - time_ns) <= RATE_NS]
        if not near:
            near = [r for _, r in list(self._rates)[-1:]]
        mean: Array = np.mean(near, axis=0) - nominal[BG0 : BG0 + 3] if near else np.zeros(3)
        return mean

    def _predicted(self, time_ns: int | None) -> Array | None:
        near = self._nearest(time_ns)
        if near is None or time_ns is None or not len(near.deck):
            return None
        dt = (time_ns - near.t_ns) * 1e-9
        relative = near.deck[:3] + near.deck[3:6] * dt
        rotation = self.attitude(time_ns)
        assert rotation is not None
        place: Array = self._R_cb @ (rotation.T @ -relative - self._lever_m)
        sigma = float(np.sqrt(np.trace(near.deck_covariance[:3, :3])))
        return place if sigma < PRIOR_SHARE * float(np.linalg.norm(place)) else None

    # -- the image's side --------------------------------------------------------------------------------------

    def _look(self, image: bytes | Picture, time_ns: int | None) -> Fix | NoFix:
        if self._detector is None:
            return NoFix("no camera and target are configured")
        rotation = self.attitude(time_ns)
        rate = None
        near = self._nearest(time_ns)
        if near is not None and time_ns is not None:
            rate = self._rate(time_ns, near.nominal)
        R_nc = None if rotation is None else rotation @ self._R_cb.T
        return look_at(self._detector, image, R_nc, self.expected(time_ns), rate)


def look_at(
    detector: TargetDetector,
    image: bytes | Picture,
    R_nc: Array | None,
    expected: Fix | Array | None = None,
    rate_radps: Array | None = None,
) -> Fix | NoFix:
    """Return what a detector finds in an image, encoded or not; one that is no image of its camera has no fix."""
    picture = decode(image) if isinstance(image, bytes | bytearray | memoryview) else image
    if picture is None:
        return NoFix(UNDECODABLE)
    try:
        return detector.detect(picture, R_nc, expected, rate_radps)
    except ValueError as error:
        return NoFix(str(error))


def body_to_camera(config: Config) -> Array:
    """Return the rotation (3, 3) of body to camera as it is mounted."""
    mount = quat_to_matrix(euler_to_quat(*config.vision.mount_rpy_rad))
    rotation: Array = R_CB_NOMINAL @ mount.T
    return rotation


def decode(data: bytes) -> Picture | None:
    """Return the pixels of an encoded image, BGR, or None where it cannot be decoded."""
    import cv2

    packed = np.frombuffer(data, dtype=np.uint8)
    if not packed.size:
        return None
    try:
        picture = cv2.imdecode(packed, cv2.IMREAD_COLOR)
    except cv2.error:
        return None
    return None if picture is None else np.ascontiguousarray(picture, dtype=np.uint8)


def fix_event(image: ImageEvent, fix: Fix) -> VisionFix:
    """Return the event of a fix: it has the stamp and the arrival of its image."""
    p, c = fix.position_cam_m, fix.covariance_m2
    covariance = tuple(float(c[i, j]) for i in range(3) for j in range(i, 3))
    return VisionFix(
        image.stamp_ns,
        image.arrival_ns,
        (float(p[0]), float(p[1]), float(p[2])),
        covariance,  # type: ignore[arg-type]
        image.sensor,
        image.clock,
    )

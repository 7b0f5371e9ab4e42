"""The camera, through OpenCV: a device's number, a file, a URL or a GStreamer pipeline; each image with a stamp.

A camera that cannot be opened is an error at the start. One that goes away in flight is opened again, every two
seconds, for ever; meanwhile there are no images, and the age of the last one says so.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from deckfix.files import InputError
from deckfix.intake import CompanionClock
from deckfix.pipeline import ImageEvent, Picture
from estimation.events import COMPANION
from vision.camera import Camera

AGAIN_S = 2.0
PATIENCE_MS = 2000
_OPEN_MS = 5000
_OLDEST_NS = 500_000_000
_PIPELINE = " ! "


def open_capture(source: str, size: tuple[int, int] | None = None) -> Any:
    """Return OpenCV's capture of a source: a number, a file, a URL, or a pipeline with ``!`` in it.

    ``size`` (width, height) is asked of a device. Raises ``InputError`` with what is wrong and what to do.
    """
    import cv2

    if source.isdigit():
        return _device(source, size)
    if _PIPELINE in source:
        if "GStreamer:                   YES" not in cv2.getBuildInformation():
            raise InputError(
                f"{source}: this OpenCV has no GStreamer; install one that has, or give a device or a URL"
            )
        capture = cv2.VideoCapture(source, cv2.CAP_GSTREAMER)
    else:
        network = "://" in source
        if not network and not Path(source).exists():
            raise InputError(
                f"{source}: no such camera or file; give a device's number, a file, a URL or a pipeline"
            )
        # One thread: with several, FFmpeg holds a frame back for each.
        settings = [cv2.CAP_PROP_N_THREADS, 1]
        if network:
            settings += [
                cv2.CAP_PROP_OPEN_TIMEOUT_MSEC,
                _OPEN_MS,
                cv2.CAP_PROP_READ_TIMEOUT_MSEC,
                PATIENCE_MS,
            ]
        capture = cv2.VideoCapture(source, cv2.CAP_FFMPEG, settings)
    if not capture.isOpened():
        raise InputError(f"{source}: gives no video; is the camera (or its server) running?")
    return capture


def _device(source: str, size: tuple[int, int] | None) -> Any:
    import cv2

    if not Path(f"/dev/video{source}").exists():
        raise InputError(
            f"camera {source}: /dev/video{source} is not there; check the cable, or give another"
        )
    capture = cv2.VideoCapture(int(source), cv2.CAP_V4L2)
    if not capture.isOpened():
        raise InputError(f"camera {source}: cannot be opened; is another program using it?")
    capture.set(cv2.CAP_PROP_BUFFERSIZE, 1)
    if size is not None:
        capture.set(cv2.CAP_PROP_FRAME_WIDTH, size[0])
        capture.set(cv2.CAP_PROP_FRAME_HEIGHT, size[1])
    return capture


@dataclass(slots=True)
class CameraSource:
    """Reads images in a thread of its own and gives each to ``give``.

    An image is stamped with its capture where the driver tells when that was, else with its arrival: how old it was
    then is the camera latency, which the estimator carries. ``last_ns`` is the arrival of the last image.
    """

    source: str
    camera: Camera
    clock: CompanionClock
    give: Callable[[ImageEvent], None]
    last_ns: int = 0
    images: int = 0
    lost: int = 0
    wrong_size: int = 0
    _capture: Any = None
    _interval_s: float = 0.0
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    def begin(self) -> None:
        """Open the camera, take an image, and go on in a thread; raises ``InputError``."""
        self._open()
        done, picture = self._capture.read()
        if not done:
            self._capture.release()
            raise InputError(f"{self.source}: opens, but gives no image; check the camera")
        height, width = picture.shape[:2]
        if (width, height) != (self.camera.width, self.camera.height):
            self._capture.release()
            raise InputError(
                f"{self.source}: gives {width} x {height} pixels, the camera file is for "
                f"{self.camera.width} x {self.camera.height}; give the calibration of this camera and mode"
            )
        self._thread = threading.Thread(target=self._run, name="camera", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop reading; waits for an image that is being read for a moment only."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)

    def _open(self) -> None:
        self._capture = open_capture(self.source, (self.camera.width, self.camera.height))
        file = not self.source.isdigit() and "://" not in self.source and _PIPELINE not in self.source
        rate = float(self._capture.get(5)) if file else 0.0  # CAP_PROP_FPS
        self._interval_s = 1.0 / rate if 1.0 <= rate <= 1000.0 else (0.05 if file else 0.0)

    def _run(self) -> None:
        due = time.monotonic()
        while not self._stop.is_set():
            if self._capture is None:
                self._again()
                continue
            if self._interval_s:  # a file, played at its rate
                due = max(due + self._interval_s, time.monotonic() - self._interval_s)
                if self._stop.wait(max(0.0, due - time.monotonic())):
                    break
            done, picture = self._capture.read()
            now = self.clock()
            if not done or picture is None:
                self.lost += 1
                self._capture.release()
                self._capture = None
                continue
            self._take(picture, now)
        if self._capture is not None:
            self._capture.release()

    def _take(self, picture: Picture, now: int) -> None:
        self.last_ns = now
        if picture.shape[:2] != (self.camera.height, self.camera.width):
            self.wrong_size += 1
            return
        self.images += 1
        picture = np.ascontiguousarray(picture)
        self.give(ImageEvent(self._stamp(now), now, picture, clock=COMPANION))

    def _stamp(self, now: int) -> int:
        """Return when the image was captured: V4L2 tells it on the system's monotonic clock."""
        if not self.source.isdigit():
            return now
        told = self.clock.of_monotonic(round(float(self._capture.get(0)) * 1e6))  # CAP_PROP_POS_MSEC
        return told if now - _OLDEST_NS <= told <= now else now

    def _again(self) -> None:
        if self._stop.wait(AGAIN_S):
            return
        try:
            self._open()
        except InputError:
            self._capture = None

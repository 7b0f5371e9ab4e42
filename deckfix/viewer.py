"""Live topics for Foxglove, served on the loopback unless told otherwise; a viewer that is slow misses messages."""

from __future__ import annotations

import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from deckfix.files import InputError
from estimation.frames import quat_to_matrix

if TYPE_CHECKING:
    from deckfix.onboard import Onboard, Status

PERIOD_S = 0.1
IMAGE_PERIODS = 2
BACKLOG = 64
"""Messages that wait for one viewer; beyond it the oldest is dropped."""


@dataclass(slots=True)
class Viewer:
    """A server for viewers, and the thread that tells it what is new."""

    server: Any
    context: Any
    host: str
    _channels: dict[str, Any] = field(default_factory=dict)
    _stop: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    @classmethod
    def listen(cls, address: str) -> Viewer:
        """Return a server at HOST:PORT; raises ``InputError`` where there can be none."""
        try:
            import foxglove
        except ImportError:
            raise InputError("--foxglove: needs foxglove-sdk; pip install 'deckfix[live]'") from None
        host, colon, port = address.rpartition(":")
        if not colon or not host or not port.isdigit() or int(port) > 65535:
            raise InputError(f"--foxglove {address}: host or port is missing; write it like 127.0.0.1:8765")
        context = foxglove.Context()
        try:
            server = foxglove.start_server(
                name="deckfix", host=host, port=int(port), context=context, message_backlog_size=BACKLOG
            )
        except Exception as error:
            raise InputError(
                f"--foxglove {address}: cannot listen there ({error}); choose another port"
            ) from None
        return cls(server, context, host)

    @property
    def url(self) -> str:
        """What a viewer connects to."""
        return f"ws://{self.host}:{self.server.port}"

    @staticmethod
    def layout_path() -> Path:
        """Return the layout that shows these topics."""
        return Path(__file__).with_name("foxglove_layout.json")

    def begin(self, flight: Onboard) -> None:
        """Serve a flight from now on."""
        self._thread = threading.Thread(target=self._run, args=(flight,), name="viewer", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop serving."""
        self._stop.set()
        if self._thread is not None:
            self._thread.join(1.0)
        self.server.stop()

    def _run(self, flight: Onboard) -> None:
        seen, count = 0, 0
        while not self._stop.wait(PERIOD_S):
            count += 1
            status, newest = flight.status, flight.newest
            if newest is not None and newest.arrival_ns != seen:
                seen = newest.arrival_ns
                self._json("/deckfix/estimate", estimate_fields(newest), seen)
            if status is not None:
                self._json("/deckfix/status", status_fields(status), status.at_ns)
            image = flight.last_image
            if image is not None and count % IMAGE_PERIODS == 0:
                self._image(image.image, image.arrival_ns)

    def _json(self, topic: str, fields: dict[str, Any], at_ns: int) -> None:
        import foxglove

        if topic not in self._channels:
            self._channels[topic] = foxglove.Channel(topic, message_encoding="json", context=self.context)
        if self._channels[topic].has_sinks():
            self._channels[topic].log(fields, log_time=at_ns)

    def _image(self, image: Any, at_ns: int) -> None:
        import cv2
        from foxglove.channels import CompressedImageChannel
        from foxglove.messages import CompressedImage, Timestamp

        topic = "/camera/image/compressed"
        if topic not in self._channels:
            self._channels[topic] = CompressedImageChannel(topic, context=self.context)
        if not self._channels[topic].has_sinks():
            return
        data = image if isinstance(image, bytes) else bytes(cv2.imencode(".jpg", image)[1])
        stamp = Timestamp(at_ns // 1_000_000_000, at_ns % 1_000_000_000)
        message = CompressedImage(timestamp=stamp, frame_id="camera", data=data, format="jpeg")
        self._channels[topic].log(message, log_time=at_ns)


def estimate_fields(newest: Any) -> dict[str, Any]:
    """Return an estimate as the viewer shows it: metres, degrees; NED; heave up."""
    e = newest.estimate
    R = quat_to_matrix(e.quaternion)
    out: dict[str, Any] = {
        "t_s": e.t_ns * 1e-9,
        "position_m": _axes(e.position_m),
        "velocity_mps": _axes(e.velocity_mps),
        "roll_deg": float(np.degrees(np.arctan2(R[2, 1], R[2, 2]))),
        "pitch_deg": float(np.degrees(-np.arcsin(np.clip(R[2, 0], -1.0, 1.0)))),
        "yaw_deg": float(np.degrees(np.arctan2(R[1, 0], R[0, 0]))),
    }
    if len(e.deck):
        sigma = np.sqrt(np.diag(e.deck_covariance))
        out["relative_m"], out["relative_sigma_m"] = _axes(e.deck[:3]), _axes(sigma[:3])
        out["relative_velocity_mps"] = _axes(e.deck[3:6])
        out["deck"] = {
            "height_m": float(e.deck[6]), "height_sigma_m": float(sigma[6]),
            "rate_mps": float(e.deck[7]), "rate_sigma_mps": float(sigma[7]),
        }  # fmt: skip
    return out


def status_fields(status: Status) -> dict[str, Any]:
    """Return a status as the viewer shows it."""
    return {
        "health": status.words, "mode": status.mode, "armed": status.armed, "guidance": status.guidance,
        "landing_target": status.publishing or "sent",
        "latency_ms": {"median": _number(status.latency_ms[0]), "p95": _number(status.latency_ms[1])},
        "rates_hz": status.rates_hz, "drops": status.drops, "turned_away": status.turned_away,
        "clocks": [
            {"clock": c.clock, "offset_ms": c.offset_ns * 1e-6, "sigma_ms": _number(c.sigma_ns * 1e-6),
             "skew_ppm": _number(c.skew_ppm), "status": str(c.status)}
            for c in status.clocks
        ],
    }  # fmt: skip


def _axes(v: Any) -> dict[str, float]:
    return {"n": float(v[0]), "e": float(v[1]), "d": float(v[2])}


def _number(v: float) -> float | None:
    return float(v) if np.isfinite(v) else None

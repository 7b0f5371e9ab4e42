"""``deckfix simulate --serve``: a mission's vehicle in real time, with its MAVLink on UDP and its camera as MJPEG.

Both are on the loopback alone. Time begins when a companion asks for streams, so that the two can be started in either
order; a machine that is too slow for real time is told so.
"""

from __future__ import annotations

import http.server
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from deckfix.files import InputError, check_output, output_file, output_folder
from estimation.config import Config, dump_config
from estimation.estimator import EngineName
from simulation.autopilot import ASK_TIME_S, HEARTBEAT_S, Autopilot, Lens
from simulation.exposure import CAMERA, expose, renderer_of
from simulation.instruments import Instant
from simulation.mission import Mission
from simulation.renderer import Renderer
from simulation.world import TICK_S, Flown
from vision.camera import Camera
from vision.target import RingTarget

HOST = "127.0.0.1"
PICTURE_DELAY_S = 0.05
"""From the exposure of a picture to its sending."""
LATEST_S = 3.0
"""A simulation this far behind real time is given up."""
_BOUNDARY = b"picture"


@dataclass(frozen=True, slots=True)
class Ports:
    """Where the vehicle is: MAVLink is sent to ``mavlink`` (UDP), pictures are served at ``camera`` (HTTP; 0: any)."""

    mavlink: int = 14550
    camera: int = 8090


@dataclass(slots=True)
class Pictures:
    """Renders the newest moment, and keeps the newest picture for whoever watches."""

    renderer: Renderer
    config: Config
    rng: np.random.Generator
    moments: deque[tuple[float, Instant]] = field(default_factory=lambda: deque(maxlen=2))
    newest: tuple[int, bytes] = (0, b"")
    skipped: int = 0
    stop: threading.Event = field(default_factory=threading.Event)
    _there: threading.Condition = field(default_factory=threading.Condition)
    _wanted: threading.Event = field(default_factory=threading.Event)

    def take(self, due: float, now: Instant) -> None:
        """Take a moment whose picture is to go out at a time of the monotonic clock [s]."""
        self.skipped += len(self.moments) == self.moments.maxlen
        self.moments.append((due, now))
        self._wanted.set()

    def run(self) -> None:
        """Render until ``stop``."""
        while not self.stop.is_set():
            if not self.moments:
                self._wanted.wait(0.1)
                self._wanted.clear()
                continue
            due, now = self.moments.popleft()
            picture = self.render(now)
            if picture is None:
                continue
            self.stop.wait(max(0.0, due - time.monotonic()))
            with self._there:
                self.newest = self.newest[0] + 1, picture
                self._there.notify_all()

    def render(self, now: Instant) -> bytes | None:
        """Return a moment's picture as JPEG, or None where the camera is not above the deck."""
        return expose(self.renderer, self.config.vision, now, self.rng, np.zeros(3))

    def after(self, number: int, timeout_s: float) -> tuple[int, bytes]:
        """Return the newest picture once its number is higher than ``number``, or the last one after a time."""
        with self._there:
            if self.newest[0] <= number:
                self._there.wait(timeout_s)
            return self.newest


class _Server(http.server.ThreadingHTTPServer):
    daemon_threads = True
    pictures: Pictures


class _Handler(http.server.BaseHTTPRequestHandler):
    server: _Server

    def log_message(self, format: str, *arguments: object) -> None:
        """Say nothing."""

    def do_GET(self) -> None:
        """Send pictures for as long as somebody watches."""
        pictures, number = self.server.pictures, 0
        self.send_response(200)
        self.send_header("Content-Type", f"multipart/x-mixed-replace; boundary={_BOUNDARY.decode()}")
        self.end_headers()
        try:
            while not pictures.stop.is_set():
                after, data = pictures.after(number, 0.5)
                if not data:
                    continue
                number = after  # the last picture again where there is no new one
                head = b"--%s\r\nContent-Type: image/jpeg\r\nContent-Length: %d\r\n\r\n" % (
                    _BOUNDARY,
                    len(data),
                )
                self.wfile.write(head + data + b"\r\n")
                self.wfile.flush()
        except OSError:
            return


@dataclass(slots=True)
class Served:
    """A vehicle being served; ``run`` flies it to its end."""

    vehicle: Autopilot
    pictures: Pictures
    wire: socket.socket
    http: _Server
    address: tuple[str, int]
    stop: threading.Event = field(default_factory=threading.Event)
    _begin: float | None = None
    _protocol: Any = None
    _parser: Any = None

    @property
    def camera_url(self) -> str:
        """Where the pictures are."""
        return f"http://{HOST}:{self.http.server_port}/camera.mjpg"

    def run(self) -> Flown:
        """Fly in real time until the mission ends or ``stop`` is set; raises ``InputError`` where that is too slow."""
        m = self.vehicle.messages
        self.vehicle.warm_up()
        self._protocol, self._parser = m.MAVLink(None, 1, 1), m.MAVLink(None, 1, 1)
        # OpenCV opens a camera only once it has seen a picture: the view from where the vehicle stands.
        still = self.pictures.render(self.vehicle.still())
        if still is not None:
            self.pictures.newest = 1, still
        threads = [
            threading.Thread(target=self.pictures.run, name="pictures", daemon=True),
            threading.Thread(target=self.http.serve_forever, name="camera", daemon=True),
        ]
        for thread in threads:
            thread.start()
        beat = ask = 0.0
        try:
            while not self.stop.is_set() and not self.vehicle.end:
                now = time.monotonic()
                self._listen(now)
                if now >= beat:
                    beat = now + HEARTBEAT_S
                    self._send(self.vehicle.heartbeat())
                if self._begin is None:
                    if self.vehicle.asked:
                        self._begin = now
                    self.stop.wait(0.01)
                    continue
                if now >= ask:
                    ask = now + ASK_TIME_S
                    self._send(m.MAVLink_timesync_message(0, self.vehicle.clock_ns(now - self._begin)))
                self._tick(now - self._begin)
        finally:
            self.close()
        return self.vehicle.flown()

    def picture(self, now: Instant) -> None:
        """Pass a moment on, to be sent as a picture a fixed time after it."""
        if self._begin is not None:
            self.pictures.take(self._begin + now.t_s + PICTURE_DELAY_S, now)

    def close(self) -> None:
        """End all that runs."""
        self.pictures.stop.set()
        self.http.shutdown()
        self.http.server_close()
        self.wire.close()

    def _tick(self, now_s: float) -> None:
        ahead = self.vehicle.t_s + TICK_S - now_s
        if ahead > 0.0:
            time.sleep(min(ahead, 0.002))
            return
        if ahead < -LATEST_S:
            raise InputError(
                f"the simulation fell {-ahead:.1f} s behind real time; use a faster or idle machine"
            )
        self.vehicle.tick()
        for message in self.vehicle.outbox:
            self._send(message)
        self.vehicle.outbox.clear()

    def _send(self, message: Any) -> None:
        packet = bytes(message.pack(self._protocol))
        self._protocol.seq = (self._protocol.seq + 1) % 256
        try:
            self.wire.sendto(packet, self.address)
        except OSError:
            return  # nobody listens yet

    def _listen(self, now: float) -> None:
        while True:
            try:
                data, _ = self.wire.recvfrom(65535)
            except OSError:
                return
            for message in self._parser.parse_buffer(data) or []:
                if self._begin is None and message.get_type() == "TIMESYNC":
                    continue  # its clock does not run yet
                at = 0.0 if self._begin is None else now - self._begin
                for answer in self.vehicle.receive(message, at):
                    self._send(answer)


def serve(mission: Mission, seed: int | None, ports: Ports, engine: EngineName = "auto") -> Served:
    """Return a mission's vehicle, ready to run; raises ``InputError`` where a port is taken."""
    renderer = renderer_of(mission)
    number = mission.seed if seed is None else seed
    pictures = Pictures(renderer, mission.drawn, np.random.default_rng([number, 78]))
    lens = Lens(lambda now: None)
    vehicle = Autopilot.of(mission, number, lens, engine)
    try:
        server = _Server((HOST, ports.camera), _Handler)
    except OSError as error:
        raise InputError(
            f"camera port {ports.camera}: {error.strerror}; give another --camera-port"
        ) from None
    server.pictures = pictures
    wire = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    wire.bind((HOST, 0))
    wire.setblocking(False)
    made = Served(vehicle, pictures, wire, server, (HOST, ports.mavlink))
    lens.take = made.picture
    return made


def flight_config(mission: Mission) -> Config:
    """Return the configuration of a companion of this vehicle: what the mission's filter is told, with this camera."""
    vision = msgspec.structs.replace(
        mission.config.vision, latency_s=PICTURE_DELAY_S, latency_sigma_s=0.5 * PICTURE_DELAY_S
    )
    return msgspec.structs.replace(mission.config, vision=vision)


def write_flight_files(mission: Mission, folder: str | Path, *, force: bool) -> Path:
    """Write flight.toml, camera.toml and target.toml of a companion to a folder; return the first's path."""
    place = output_folder(folder)
    own = '[onboard]\ncamera = "camera.toml"\ntarget = "target.toml"\n\n'
    texts = {
        "camera.toml": Camera.preset(CAMERA).to_toml(),
        "target.toml": RingTarget.recommended(mission.target_m).to_toml(),
        "flight.toml": own + dump_config(flight_config(mission)),
    }
    for name in texts:
        check_output(place / name, force=force)
    for name, text in texts.items():
        with output_file(place / name, force=force) as partial:
            partial.write_text(text, encoding="utf-8")
    return place / "flight.toml"


def serve_command(
    scenario: str, output: str | None, *, seed: int | None, ports: Ports, files: str | None, force: bool,
    say: Callable[[str], None],
) -> str:  # fmt: skip
    """Serve a mission to its end, and return what there is to say."""
    from logs.writer import FlightWriter
    from simulation.mission import load_mission
    from simulation.mission_log import mission_recording

    if output is not None:
        check_output(output, force=force)
    mission = load_mission(scenario)
    config = "flight.toml" if files is None else str(write_flight_files(mission, files, force=force))
    served = serve(mission, seed, ports)
    say(
        f"waiting for: deckfix onboard --mavlink udpin:{HOST}:{ports.mavlink} --camera {served.camera_url} "
        f"--config {config} --guide"
    )
    flown = served.run()
    said = f"{mission.description}: {flown.end or 'stopped'} after {served.vehicle.t_s:.1f} s"
    if flown.contact is not None:
        touch = flown.contact
        said += f", contact at {touch.speed_mps:.2f} m/s, {touch.miss_m:.2f} m from the target's centre"
    said += f" ({served.vehicle.set_points} set-points, {served.vehicle.targets} LANDING_TARGET)"
    if output is not None:
        with output_file(output, force=force) as partial, FlightWriter(partial, force=True) as writer:
            writer.write_recording(mission_recording(flown))
        said += f"\nwrote {output}"
    return said

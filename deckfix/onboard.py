"""The estimator on board, beside an autopilot: the same pipeline as in replay, fed by a link and a camera.

Three threads meet in two places only. The link's thread and the camera's put what arrives into the ``Intake``, whose
order is the order of the log; this module's main loop takes it out and steps the pipeline; and the duties (heartbeat,
clock exchanges, LANDING_TARGET between two fixes, requests of streams) read the newest estimate, which is replaced
whole. The recorder, the viewer and the terminal have threads of their own and are never waited for.
"""

from __future__ import annotations

import threading
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from deckfix.camera_source import CameraSource
from deckfix.guide import RATE_HZ as GUIDE_HZ
from deckfix.guide import Guide, set_point
from deckfix.health import Health, Problem
from deckfix.intake import CompanionClock, Intake
from deckfix.landing_target import RATE_HZ, Newest, landing_target, odometry, target_in_body, why_not
from deckfix.load import Load
from deckfix.mavlink_link import LAND, Link
from deckfix.pipeline import ImageEvent, Pipeline, Step
from deckfix.recorder import ERROR, INFO, WARN, Recorder
from deckfix.stream_requests import StreamRequests
from estimation.ahead import DeckForecaster
from estimation.clockbank import ClockSummary
from estimation.events import Event, Imu, Kind, TimeSync
from estimation.modes import Mode
from estimation.state import BG0

TIMESYNC_S = 0.15
"""Between two clock exchanges: some 7 Hz."""
HEARTBEAT_S = 1.0
HEALTH_S = 0.2
REQUESTS_S = 2.0
SUMMARY_S = 10.0
TICK_S = 0.005
IMU_GONE_NS = 500_000_000
IMAGE_GONE_NS = 1_000_000_000
SYNC_GONE_NS = 5_000_000_000
DROPS_SHOWN_NS = 5_000_000_000
HORIZONS_S = np.arange(0.0, 8.01, 0.1)
"""How far ahead the deck is forecast for the guidance."""
_LEVELS = (ERROR, ERROR, ERROR, ERROR, WARN, INFO, INFO, INFO)
DO_SET_MODE = 176
_CUSTOM_MODE = 1.0


@dataclass(frozen=True, slots=True)
class Status:
    """What is shown of a moment: replaced whole, read from any thread.

    ``latency_ms`` are the median and the 95th percentile from an image's arrival to the LANDING_TARGET that holds it,
    over the last thousand; NaN where there was none.
    """

    at_ns: int
    words: str
    state: int
    newest: Newest | None
    publishing: str
    guidance: str
    clocks: tuple[ClockSummary, ...]
    latency_ms: tuple[float, float]
    rates_hz: dict[str, float]
    drops: dict[str, int]
    turned_away: dict[str, int]
    log: str
    mode: str
    armed: bool
    link_alive: bool


@dataclass(slots=True)
class Onboard:
    """One flight on board. ``run`` returns when ``stop`` is set; nothing that goes wrong in between ends it."""

    clock: CompanionClock
    link: Link
    pipeline: Pipeline
    intake: Intake
    camera: CameraSource | None = None
    recorder: Recorder | None = None
    guide: Guide | None = None
    publish: frozenset[str] = frozenset({"landing_target"})
    requests: StreamRequests = field(default_factory=StreamRequests)
    stop: threading.Event = field(default_factory=threading.Event)
    health: Health = field(default_factory=Health)
    newest: Newest | None = None
    status: Status | None = None
    last_image: ImageEvent | None = None
    counts: Counter[str] = field(default_factory=Counter)
    latencies_ms: deque[float] = field(default_factory=lambda: deque(maxlen=1000))
    load: Load = field(default_factory=Load)
    _open: bool = False
    _imu_ns: int = 0
    _sync_ns: int = 0
    _began_ns: int = 0
    _pending_ns: int = 0
    _target_ns: int = 0
    _target_us: int = 0
    _decided_ns: int = 0
    _landed: bool = False
    _resets: int = 0
    _not_publishing: str = "no estimate"
    _clocks: tuple[ClockSummary, ...] = ()
    _rated: tuple[int, Counter[str]] = (0, Counter())
    _rates: dict[str, float] = field(default_factory=dict)
    _dropped: tuple[int, int] = (0, 0)
    _sending: threading.Lock = field(default_factory=threading.Lock)
    _forecaster: DeckForecaster = field(default_factory=lambda: DeckForecaster.at(HORIZONS_S))

    # -- what comes in ---------------------------------------------------------------------------------------------

    def give(self, events: Sequence[Event]) -> None:
        """Take events from the link's thread."""
        if not self._open:
            return
        self.intake.put(events)
        for event in events:
            if isinstance(event, Imu):
                self._imu_ns = self.clock()
            elif isinstance(event, TimeSync):
                self._sync_ns = self.clock()

    def give_image(self, image: ImageEvent) -> None:
        """Take an image from the camera's thread."""
        if self._open:
            self.intake.put_image(image)

    # -- the main loop ---------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Estimate until ``stop`` is set."""
        self._open, self._began_ns, self.load = True, self.clock(), Load()
        threads = [
            threading.Thread(target=self._read, name="link", daemon=True),
            threading.Thread(target=self._duties, name="duties", daemon=True),
        ]
        for thread in threads:
            thread.start()
        while not self.stop.is_set():
            self._look_after_guidance()
            item = self.intake.get(0.02)
            if item is None:
                continue
            try:
                self._take(item)
            except Exception as error:
                self._failed(error)
        self._open = False
        for thread in threads:
            thread.join(1.0)
        self._finish()

    def _take(self, item: Event | ImageEvent) -> None:
        if isinstance(item, ImageEvent):
            self.last_image = item
            if self.recorder is not None:
                self.recorder.image(item)
        step = self.pipeline.step(item)
        self.counts["images" if isinstance(item, ImageEvent) else "events"] += 1
        if self.recorder is not None and step.output is not None:
            self.recorder.step(step)
        if isinstance(item, ImageEvent):
            if step.event is not None:
                self.counts["fixes"] += 1
                self._pending_ns = item.arrival_ns
        elif step.estimate is not None:
            self._estimated(step, item.arrival_ns)

    def _estimated(self, step: Step, arrival_ns: int) -> None:
        e = step.estimate
        assert e is not None
        self.counts["estimates"] += 1
        seen = self.pipeline.estimator.last_fused_ns(Kind.VISION)
        before = self.newest
        if before is not None and e.t_ns <= before.estimate.t_ns:
            before, self._resets = None, self._resets + 1  # the inertial clock went back
        last_seen = None if before is None else before.seen_ns
        gyro = step.event.angular_velocity_radps if isinstance(step.event, Imu) else (0.0, 0.0, 0.0)
        rate = np.array(gyro) - e.nominal[BG0 : BG0 + 3]
        self.newest = Newest(e, arrival_ns, rate, seen if seen is not None else last_seen)
        if seen is not None and (last_seen is None or seen > last_seen):
            self.counts["fused fixes"] += 1
            if self._pending_ns and self._send_target():
                self.latencies_ms.append((self.clock() - self._pending_ns) * 1e-6)
            self._pending_ns = 0
        if "odometry" in self.publish and self.counts["estimates"] % 4 == 0:
            self.link.send(odometry(self.link.messages, self.newest, self.clock() // 1000, self._resets))
        if self.counts["estimates"] % 50 == 0:
            self._clocks = tuple(self.pipeline.estimator.clocks(e.t_ns))
        self._guide(arrival_ns)

    def _failed(self, error: Exception) -> None:
        """Go on after what must not happen: one input is lost, not the flight."""
        self.counts["internal errors"] += 1
        if self.recorder is not None and self.counts["internal errors"] <= 20:
            self.recorder.say(self.clock(), ERROR, f"internal error: {type(error).__name__}: {error}")

    def _finish(self) -> None:
        if self.guide is not None:
            self.guide.engaged = False
        self.link.heartbeat(6, int(self.health.now))  # MAV_STATE_POWEROFF
        self._update_status(self.clock())
        if self.recorder is not None:
            try:
                self.recorder.step(self.pipeline.finish())
            except Exception as error:
                self._failed(error)
            self.recorder.say(self.clock(), INFO, self.latency_words())
            self.recorder.close()
        if self.pipeline.executor is not None:
            self.pipeline.executor.shutdown()

    # -- guidance --------------------------------------------------------------------------------------------------

    def _look_after_guidance(self) -> None:
        if self.guide is None:
            return
        was = self.guide.engaged
        self.guide.look(self.link.vehicle, self.newest, self.clock(), self.link.alive)
        if was != self.guide.engaged:
            self._landed = False
            text = "guiding" if self.guide.engaged else f"not guiding: {self.guide.why}"
            self._tell(5 if self.guide.engaged else 4, f"deckfix: {text}")

    def _guide(self, now_ns: int) -> None:
        guide = self.guide
        if guide is None or self.newest is None:
            return
        self._look_after_guidance()
        if not guide.engaged or now_ns - self._decided_ns < round(0.9e9 / GUIDE_HZ):
            return
        self._decided_ns = now_ns
        forecast = self.pipeline.estimator.deck_forecast(self._forecaster)
        vehicle = self.link.vehicle
        before = guide.progress
        decision = guide.decide(self.newest, self.clock(), forecast, vehicle.on_ground)
        if decision is None:
            return
        if self.recorder is not None:
            self.recorder.decision(self.newest.estimate.t_ns, now_ns, decision)
        if (before.mode, before.reason) != (decision.mode, decision.reason):
            self._tell(6, f"deckfix: {decision.mode.name} {decision.reason}")
        message = set_point(self.link.messages, vehicle, decision, self.newest.estimate.t_ns // 1_000_000)
        if message is not None:
            self.link.send(message)
        elif decision.mode is Mode.LANDED and not self._landed:
            # On the deck: the autopilot's own mode cuts the motors.
            self._landed = True
            self.link.command(DO_SET_MODE, _CUSTOM_MODE, float(LAND))

    # -- duties ----------------------------------------------------------------------------------------------------

    def _read(self) -> None:
        while not self.stop.is_set():
            self.link.read(0.05)

    def _duties(self) -> None:
        due = dict.fromkeys(("target", "sync", "beat", "health", "requests", "summary"), 0)
        every = {
            "target": 1.0 / RATE_HZ, "sync": TIMESYNC_S, "beat": HEARTBEAT_S, "health": HEALTH_S,
            "requests": REQUESTS_S, "summary": SUMMARY_S,
        }  # fmt: skip
        due["summary"] = self._began_ns + round(SUMMARY_S * 1e9)
        while not self.stop.wait(TICK_S):
            now = self.clock()
            for name, at in due.items():
                if now >= at:
                    due[name] = max(at, now - round(every[name] * 1e9)) + round(every[name] * 1e9)
                    try:
                        self._do(name, now)
                    except Exception as error:
                        self._failed(error)

    def _do(self, name: str, now: int) -> None:
        match name:
            case "target":
                # A fix has just been told of: the next one follows in time.
                if now - self._target_ns > round(0.8e9 / RATE_HZ):
                    self._send_target()
            case "sync":
                self.link.ask_time()
            case "beat":
                self.link.heartbeat(self.health.state, int(self.health.now))
            case "health":
                self._look_after_health(now)
            case "requests":
                self.requests.check(self.link, now)
            case _:
                if self.recorder is not None:
                    self.recorder.say(now, INFO, f"{self.latency_words()}; {self.load.words}")

    def _send_target(self) -> bool:
        """Tell the autopilot where the deck is, if that is known; return whether it was sent."""
        if "landing_target" not in self.publish:
            return False
        with self._sending:
            now, newest = self.clock(), self.newest
            self._not_publishing = why_not(newest, now, self.pipeline.config.landing)
            if self._not_publishing or newest is None or not self.link.alive:
                return False
            self._target_ns, self._target_us = now, max(now // 1000, self._target_us + 1)
            place = target_in_body(newest, now)
            return self.link.send(landing_target(self.link.messages, place, self._target_us))

    def _look_after_health(self, now: int) -> None:
        for severity, text in self.health.update(self._problems(now), now):
            self._tell(severity, text)
        if self.recorder is not None:
            while self.link.texts:
                at, severity, text = self.link.texts.popleft()
                self.recorder.say(at, _LEVELS[severity & 7], text, "autopilot")
        self._update_status(now)

    def _tell(self, severity: int, text: str) -> None:
        self.link.say(severity, text)
        if self.recorder is not None:
            self.recorder.say(self.clock(), _LEVELS[severity & 7], text)

    def _problems(self, now: int) -> Problem:
        p = Problem(0)
        if not self.link.alive:
            p |= Problem.LINK
        if now - self._imu_ns > IMU_GONE_NS:
            p |= Problem.IMU
        if now - max(self._sync_ns, self._began_ns) > SYNC_GONE_NS:
            p |= Problem.CLOCK
        if self.camera is not None and now - max(self.camera.last_ns, self._began_ns) > IMAGE_GONE_NS:
            p |= Problem.CAMERA
        newest, c = self.newest, self.pipeline.config.landing
        if newest is None or newest.age_s(now) > max(c.stale_s, 0.5):
            p |= Problem.ESTIMATE
        if newest is None or newest.seen_age_s(now) > c.lost_s:
            p |= Problem.TARGET
        if self.recorder is not None and (self.recorder.failed or self.recorder.drops.total()):
            p |= Problem.LOG
        dropped = self.intake.drops["events"] + self.counts["internal errors"]
        if dropped > self._dropped[1]:
            self._dropped = now, dropped
        if self._dropped[0] and now - self._dropped[0] < DROPS_SHOWN_NS:
            p |= Problem.OVERLOAD
        return p

    def latency_words(self) -> str:
        """Return the latency so far in a sentence."""
        taken = list(self.latencies_ms)
        if not taken:
            return "latency frame to LANDING_TARGET: none yet"
        middle, high = np.percentile(taken, [50, 95])
        return (
            f"latency frame to LANDING_TARGET: median {middle:.1f} ms, p95 {high:.1f} ms, largest {max(taken):.1f} ms, "
            f"n {len(taken)}"
        )

    def _update_status(self, now: int) -> None:
        newest, vehicle = self.newest, self.link.vehicle
        begun, before = self._rated
        counts = Counter(self.counts)
        counts["landing target"] = self.link.sent["LANDING_TARGET"]
        span = (now - begun) * 1e-9
        if span >= 1.0:
            if begun:
                self._rates = {name: (counts[name] - before[name]) / span for name in counts}
            self._rated = now, counts
        taken = list(self.latencies_ms)
        drops = Counter(self.intake.drops)
        if self.recorder is not None:
            drops.update({f"log {name}": n for name, n in self.recorder.drops.items()})
        self.status = Status(
            now, self.health.words, self.health.state, newest, self._not_publishing,
            "" if self.guide is None else self.guide.words, self._clocks,
            (float(np.median(taken)), float(np.percentile(taken, 95))) if taken else (np.nan, np.nan),
            dict(self._rates), dict(drops),
            {**self.link.counts, **self.link.sensors.counts_turned_away},
            "" if self.recorder is None else self.recorder.failed or str(self.recorder.path),
            vehicle.mode_name, vehicle.armed, self.link.alive,
        )  # fmt: skip

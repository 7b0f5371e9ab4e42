"""The world in which a landing is flown: the vehicle flies on its estimates, they come from its sensors, and these
from what the vehicle, the sea and the deck really do.

Every 20 ms what has arrived is fed to the estimator, the landing modes decide, and the autopilot gets a velocity to
fly; in between the vehicle is integrated at 400 Hz. A mission and a seed give the same flight to the last bit, with one
engine and one set of versions.
"""

from __future__ import annotations

import copy
import math
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from estimation.ahead import DeckForecaster
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import AUTOPILOT, EventBatch, Kind
from estimation.frames import Array, normal_gravity, quat_conjugate, quat_multiply, quat_to_matrix
from estimation.landing import step
from estimation.landing_config import LandingConfig
from estimation.modes import Decision, Mode, Progress, Reason, Situation
from estimation.output import Estimate, Facts
from simulation import vehicle as body
from simulation.fixes import View
from simulation.flight import place_of, waves_of, wind_speed_mps
from simulation.instruments import Instant, Instruments, Seeing
from simulation.mishaps import afflict, clock_error_ns
from simulation.mission import Mission
from simulation.platform import Platform
from simulation.sea import Sea
from simulation.sensors import Place
from simulation.wind import Turbulence

TICK_S = 0.02
STEPS = round(TICK_S * body.STEP_HZ)
HORIZONS_S = np.arange(0.0, 8.01, 0.1)
LEGS_LOADED_S = 1.0
"""The landing detector speaks after so long with weight on the legs while a descent is wanted, as autopilots' do."""
SETPOINT_TIMEOUT_S = 0.5
"""Without a set-point for so long the autopilot stops and hovers on its own estimate."""
AFTER_LANDING_S = 2.0
DECK_RATE_HZ = 100.0
_DECK_CHUNK_S = 10.0

Guidance = Callable[[Progress, Situation, LandingConfig], tuple[Progress, Decision]]


class Computer(Protocol):
    """What estimates on board, in place of an estimator alone."""

    @property
    def estimator(self) -> LandingEstimator:
        """The estimator that is fed."""

    def take(self, instruments: Instruments, t_s: float) -> Estimate | None:
        """Take what has arrived by a time, and return the newest estimate if one came."""


@dataclass(frozen=True, slots=True)
class Filter:
    """An estimator that gets every message as it is."""

    estimator: LandingEstimator

    def take(self, instruments: Instruments, t_s: float) -> Estimate | None:
        """Take what has arrived by a time, and return the newest estimate if one came."""
        batch = instruments.until(t_s)
        return self.estimator.feed(batch).estimate if len(batch) else None


@dataclass(frozen=True, slots=True)
class Contact:
    """The first touch of the deck: time, speed into the deck along its normal, place from its centre (2,), and whether
    the vehicle was on its way down to it, rather than somewhere else or on its way up.
    """

    t_s: float
    speed_mps: float
    offset_m: Array
    descending: bool

    @property
    def miss_m(self) -> float:
        """Horizontal distance from the target's centre."""
        return float(np.hypot(self.offset_m[0], self.offset_m[1]))


@dataclass(frozen=True, slots=True)
class Flown:
    """A flight that was flown: what arrived, what was decided, and what is true.

    ``t_s`` (n,) every 20 ms with ``truth`` (n, 16) and ``deck`` (n, 12), rows as in ``simulation.vehicle``; decisions
    were made at ``decided_s``. ``end`` says how it ended: ``landed``, ``given up``, ``in the water`` or ``time is up``.
    """

    mission: Mission
    seed: int
    place: Place
    instruments: Instruments
    t_s: Array
    truth: Array
    deck: Array
    decided_s: Array
    decisions: list[Decision]
    contact: Contact | None
    end: str

    @property
    def batch(self) -> EventBatch:
        """What arrived."""
        return self.instruments.given()

    @property
    def transitions(self) -> list[tuple[float, Mode, Reason]]:
        """When which mode was entered, and why, the beginnings of descents included."""
        out: list[tuple[float, Mode, Reason]] = []
        for t, d in zip(self.decided_s.tolist(), self.decisions, strict=True):
            if not out or out[-1][1:] != (d.mode, d.reason):
                out.append((t, d.mode, d.reason))
        return out


def fly(
    mission: Mission,
    seed: int | None = None,
    *,
    engine: EngineName = "auto",
    guidance: Guidance = step,
    camera: Seeing | None = None,
    computer: Computer | None = None,
    watch: Callable[[float, Decision | None], None] | None = None,
) -> Flown:
    """Fly a mission: the same for the same mission and seed (None: the mission's own).

    ``guidance`` decides (the landing modes); ``camera`` is told the moment of each picture, in place of fixes drawn
    from the description, and ``computer`` takes the messages (None: an estimator alone);
    ``watch`` is told the time and the last decision at every tick.
    """
    world = World(mission, mission.seed if seed is None else seed, engine, guidance, camera, computer)
    while not world.end:
        world.tick()
        if watch is not None:
            watch(world.t_s, world.decisions[-1] if world.decisions else None)
    return world.flown()


def facts_of(mission: Mission) -> Facts:
    """Return what the autopilot of a mission tells of its sensors."""
    return Facts(imu_latency_s=mission.drawn.imu.latency_s or 0.0, vision=True)


@dataclass(slots=True)
class World:
    """A mission as it is flown, tick by tick, until ``end`` says how it ended."""

    mission: Mission
    seed: int
    engine: EngineName
    guidance: Guidance
    camera: Seeing | None
    computer: Computer | None = None
    t_s: float = 0.0
    end: str = ""
    decisions: list[Decision] = field(default_factory=list)
    _decided: list[float] = field(default_factory=list)
    _progress: Progress = field(default_factory=Progress)
    _estimate: Estimate | None = None
    _seen_ns: int | None = None
    _corrected_ns: int = -1
    _told_s: float = 0.0
    _contact: Contact | None = None
    _ended_s: float | None = None
    _ticks: int = 0
    _kept: list[tuple[float, Array, Array]] = field(default_factory=list)
    _deck_rows: Array = field(default_factory=lambda: np.empty((0, body.DECK_SIZE)))
    _deck_begin: int = 0
    place: Place = field(init=False)
    platform: Platform = field(init=False)
    instruments: Instruments = field(init=False)
    _computer: Computer = field(init=False)
    _landing: LandingConfig = field(init=False)
    _air: Turbulence = field(init=False)
    _forecaster: DeckForecaster = field(init=False)
    _advance: Callable[..., None] = field(init=False)
    _p: Array = field(init=False)
    _x: Array = field(init=False)
    _own: Array = field(init=False)
    _set: Array = field(init=False)
    _truth: Array = field(init=False)
    _trail: Array = field(init=False)
    _past: Array = field(init=False)
    _touch: Array = field(init=False)
    _deck: Array = field(init=False)

    def __post_init__(self) -> None:
        m = self.mission
        # The fourth has no user: what the others draw depends on their number.
        sea_rng, air_rng, sensing, _, luck = np.random.default_rng(self.seed).spawn(5)
        self.place = place_of(m.site, m.drawn)
        self.platform = Platform.draw(m.raft, Sea.draw(waves_of(m.sea), sea_rng), sea_rng)
        speed = wind_speed_mps(m.wind, m.sea)
        self._air = Turbulence(speed, math.radians(m.wind.direction_deg), air_rng)
        view = View.of_target(m.target_m)
        self.instruments = Instruments.draw(
            m.drawn, m.streams, m.clocks, self.place, m.longest_s, sensing, self.camera, view
        )
        afflict(self.instruments, m.mishaps, luck)
        self._landing = m.config.landing
        if self.computer is None:
            self._computer = Filter(LandingEstimator(m.config, engine=self.engine, facts=facts_of(m)))
        else:
            self._computer = self.computer
        self._forecaster = DeckForecaster.at(HORIZONS_S)
        self._advance = body.advance if self.engine == "filterpy" else body.compiled()
        gravity = normal_gravity(float(self.place.origin[0]), float(self.place.origin[2]))
        self._p = body.pack(m.airframe, gravity, m.deck_m)
        self._x, self._own = np.zeros(body.STATE_SIZE), np.zeros(body.OWN_SIZE)
        half = 0.5 * m.start_yaw_rad
        self._x[:3] = m.start_m
        self._x[body.QUAT], self._x[body.QUAT + 3] = math.cos(half), math.sin(half)
        self._x[body.DRIVE] = gravity
        self._own[body.EST_QUAT : body.EST_QUAT + 4] = self._x[body.QUAT : body.QUAT + 4]
        self._set = np.zeros(body.SET_SIZE)
        self._set[body.SET_YAW], self._set[body.SET_TILT], self._set[body.SET_MOTORS] = (
            m.start_yaw_rad,
            0.2,
            1.0,
        )
        self._truth, self._trail = np.zeros((STEPS, body.TRUTH_SIZE)), np.zeros((STEPS, 7))
        self._past = np.tile(self._own[:7], (2 * STEPS, 1))
        self._touch = np.full(4, -1.0)
        self._deck = self._deck_now()

    def warm_up(self) -> None:
        """Advance copies by a tick, so that nothing is compiled once time runs; the world stays as it is."""
        moving = [a.copy() for a in (self._x, self._own, self._set)]
        written = [a.copy() for a in (self._truth, self._trail, self._touch)]
        self._advance(*moving, np.zeros(3), self._deck, True, self._p, *written)

    def tick(self) -> None:
        """Go on by one tick: the vehicle, its sensors, the estimator, the decision."""
        m = self.mission
        held = self.t_s < m.rest_s
        self._deck = self._deck_now()
        height = float(self._deck[0, 2] - self._x[2])
        wind = self._air.step(height, TICK_S)
        self._advance(
            self._x,
            self._own,
            self._set,
            wind,
            self._deck,
            held,
            self._p,
            self._truth,
            self._trail,
            self._touch,
        )
        self._past = np.vstack([self._past[STEPS:], self._trail])
        self._kept.append((self.t_s, self._truth[0].copy(), self._deck[0].copy()))
        if self._contact is None and self._touch[0] >= 0.0:
            at = self.t_s + self._touch[0] / body.STEP_HZ
            p = self._progress
            descending = p.mode is Mode.LANDING and p.descent_ns is not None
            self._contact = Contact(at, float(self._touch[1]), self._touch[2:4].copy(), descending)
        self.instruments.sense(self._moment, self.t_s + TICK_S)
        self._ticks += 1
        self.t_s = self._ticks * TICK_S
        self._take_in()
        self._decide()
        self._judge()

    def branch(self, guidance: Guidance) -> World:
        """Return a flight that is the same up to now and goes on under other guidance, on the same sea and sensors.

        Raises ``ValueError`` where mishaps or a computer of its own remember what was.
        """
        if self.mission.mishaps or self.computer is not None:
            raise ValueError("mission: a flight with mishaps or a computer of its own cannot be branched")
        made = copy.deepcopy(self)
        made.guidance = guidance
        return made

    @property
    def landing_mode(self) -> Mode:
        """What the landing is at."""
        return self._progress.mode

    # -- the truth -------------------------------------------------------------------------------------------------

    def _deck_now(self) -> Array:
        """Return the deck's rows at the steps of this tick and the one after them (STEPS + 1, 12)."""
        first = self._ticks * STEPS - self._deck_begin
        if first + STEPS + 1 > len(self._deck_rows):
            self._deck_begin = self._ticks * STEPS
            t0 = self._deck_begin / body.STEP_HZ
            coarse = t0 + np.arange(0.0, _DECK_CHUNK_S + 2.0 / DECK_RATE_HZ, 1.0 / DECK_RATE_HZ)
            motion = self.platform.motion(coarse)
            length = np.linalg.norm(motion.normal[0], axis=1, keepdims=True)
            # The derivative of a unit vector; slopes are small, so that the length's own change does not count.
            columns = np.hstack(
                [motion.position[0], motion.position[1], motion.normal[0] / length, motion.normal[1] / length]
            )
            fine = t0 + np.arange(round(_DECK_CHUNK_S * body.STEP_HZ) + 1) / body.STEP_HZ
            self._deck_rows = np.stack([np.interp(fine, coarse, c) for c in columns.T], axis=1)
            first = 0
        return self._deck_rows[first : first + STEPS + 1]

    def _moment(self, t_s: float) -> Instant:
        """Return the truth at a time of the last tick."""
        at = min(max((t_s - self.t_s) * body.STEP_HZ, 0.0), float(STEPS))
        k = min(int(at + 1e-6), STEPS - 1)
        share = min(1.0, max(0.0, at - k))
        row = self._truth[k]
        after = self._truth[k + 1] if k + 1 < STEPS else np.concatenate([self._x[:13], row[13:]])
        # Never a view: a picture of this moment is exposed while the vehicle goes on.
        mixed = row + share * (after - row) if share > 1e-6 else row.copy()
        deck = self._deck[k] + share * (self._deck[k + 1] - self._deck[k])
        q = mixed[6:10] / np.linalg.norm(mixed[6:10])
        return Instant(
            t_s, mixed[:3], mixed[3:6], q, quat_to_matrix(q), mixed[10:13], mixed[13:16], deck[:3], deck[6:9]
        )

    # -- estimate and decision -------------------------------------------------------------------------------------

    def _take_in(self) -> None:
        estimate = self._computer.take(self.instruments, self.t_s)
        if estimate is not None:
            self._estimate = estimate
        seen = self._computer.estimator.last_fused_ns(Kind.VISION)
        if seen is not None:
            self._seen_ns = seen
        self._correct()

    def _correct(self) -> None:
        """Set the autopilot's velocity and attitude to the estimate, carried on to now by its own inertial sensor."""
        e = self._estimate
        if e is None or e.t_ns == self._corrected_ns:
            return
        age = (self._now_ns() - e.t_ns) * 1e-9
        back = round(age * body.STEP_HZ)
        if not 0 <= back <= len(self._past):
            return
        self._corrected_ns = e.t_ns
        then = self._own[:7] if back == 0 else self._past[-back]
        velocity = e.velocity_mps - then[:3]
        turn = quat_multiply(e.quaternion, quat_conjugate(then[3:7]))
        self._own[:3] += velocity
        self._past[:, :3] += velocity
        left = np.stack([quat_multiply(turn, unit) for unit in np.eye(4)])
        self._own[3:7] = self._own[3:7] @ left
        self._past[:, 3:7] = self._past[:, 3:7] @ left

    def _now_ns(self) -> int:
        shown = int(self.instruments.stamp_ns(AUTOPILOT, np.array([self.t_s]))[0])
        return shown + clock_error_ns(self.mission.mishaps, self.t_s)

    def _decide(self) -> None:
        m = self.mission
        if self.t_s < m.rest_s:
            return
        taking_off = self.t_s < m.rest_s + m.take_off_s
        if taking_off or any(x.kind == "link_loss" and x.on(self.t_s) for x in m.mishaps):
            self._command(np.array([0.0, 0.0, -1.5]) if taking_off else None, None)
            return
        now = self._now_ns()
        age = math.inf if self._seen_ns is None else max(0.0, (now - self._seen_ns) * 1e-9)
        situation = Situation(
            now, self._estimate, age, self._computer.estimator.deck_forecast(self._forecaster),
            bool(self._own[body.LOADED] > LEGS_LOADED_S),
        )  # fmt: skip
        self._progress, decision = self.guidance(self._progress, situation, self._landing)
        self.decisions.append(decision)
        self._decided.append(self.t_s)
        self._command(decision.velocity_mps, decision)

    def _command(self, velocity: Array | None, decision: Decision | None) -> None:
        if velocity is None:
            if self.t_s - self._told_s > SETPOINT_TIMEOUT_S:
                self._set[:3] = 0.0
            return
        self._told_s = self.t_s
        self._set[:3] = velocity
        if decision is not None and decision.mode is not Mode.IDLE:
            self._set[body.SET_YAW], self._set[body.SET_TILT] = decision.yaw_rad, decision.max_tilt_rad
            self._set[body.SET_MOTORS] = float(decision.mode is not Mode.LANDED)

    def _judge(self) -> None:
        """Tell whether the flight is over."""
        p = self._progress
        why = ""
        if p.mode is Mode.LANDED:
            why = "landed"
        elif p.mode is Mode.ABORT and p.reason is Reason.GIVEN_UP:
            why = "given up"
        if self._x[2] > 0.5 and self._contact is None:
            self.end = "in the water"
        elif why:
            self._ended_s = self.t_s if self._ended_s is None else self._ended_s
            if self.t_s - self._ended_s >= AFTER_LANDING_S:
                self.end = why
        elif self.t_s >= self.mission.longest_s - TICK_S:
            self.end = "time is up"

    def flown(self) -> Flown:
        """Return the flight so far."""
        t, truth, deck = zip(*self._kept, strict=True)
        return Flown(
            self.mission, self.seed, self.place, self.instruments, np.array(t), np.array(truth), np.array(deck),
            np.array(self._decided), self.decisions, self._contact, self.end,
        )  # fmt: skip

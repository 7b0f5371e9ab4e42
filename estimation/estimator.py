"""The estimator: events in, estimates and fusion records out.

``step`` takes one event, ``run`` a whole batch; both go through the same code and give the same bits. No clock,
file or socket is touched: time is what the events say. Without an executor of the caller's no thread is either.
"""

from __future__ import annotations

from concurrent.futures import Executor
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from estimation.ahead import DeckForecast, DeckForecaster
from estimation.alignment import Aligner
from estimation.band import BAND_PARAMETERS
from estimation.beside import LearnerBeside
from estimation.clockbank import ClockSummary
from estimation.config import Config, ConfigError
from estimation.deck import HEAVE, has_form, prior_motion
from estimation.events import Event, EventBatch, Kind
from estimation.filter import Model
from estimation.frames import Array
from estimation.heave.model import HeaveModel
from estimation.history import Engine, History
from estimation.intake import Intake, latencies_s
from estimation.learning import MotionLearner
from estimation.ledger import Ledger
from estimation.outcome import Outcome
from estimation.output import Facts, Output, Run, columns_of, estimate_at, with_facts
from estimation.parameters import Site, pack_parameters
from estimation.rows import (
    AGE_NS,
    HEAVE_MODEL,
    KIND,
    LATE,
    OUTCOME,
    PENDING,
    T_NS,
    Estimates,
    FilterState,
    Int,
    Rows,
)
from estimation.state import BG0, PLATFORM_HEAVE, Layout
from estimation.tape import Tape

EngineName = Literal["auto", "filterpy", "compiled"]

REWIND_SPAN_NS = 200_000_000
REWIND_COUNT = 20
"""An inertial clock has gone back when this many samples over this span all are too old."""

LOOK_AHEAD, FARTHEST = 32, 1024
"""Events that a batch is looked through at a time, and how many at most where none of them comes late."""
TAKE_UP_NS = 600_000_000
"""How long after its fixes are final a heave model is taken up by the filter."""
NEVER = int(np.iinfo(np.int64).max)


@dataclass(slots=True)
class LandingEstimator:
    """State estimation of the vehicle (and, as it is switched on, of the platform) from events.

    ``engine`` is ``"compiled"`` (needs numba), ``"filterpy"`` (the reference, and the one for sensors added with
    ``add_sensor``) or ``"auto"``. ``facts`` are used where the configuration leaves a value open. With ``smooth`` the
    events are kept, so that ``smoothed`` can go back over them. With an ``executor`` of one worker the platform's
    motion is learned there, while estimates go on: what is learned is waited for only once it is to be taken up, and
    all comes out the same to the last bit.
    """

    config: Config = field(default_factory=Config)
    engine: EngineName = "auto"
    facts: Facts = field(default_factory=Facts)
    smooth: bool = False
    executor: Executor | None = None
    layout: Layout = field(init=False)
    engine_name: str = field(init=False)
    _history: History = field(init=False)
    _engine: Engine | None = None
    _aligner: Aligner = field(init=False)
    _intake: Intake = field(init=False)
    _site: Site | None = None
    _consumed: int = 0
    _models: dict[str, Model] = field(default_factory=dict)
    _period_ns: int = field(init=False)
    _past: list[tuple[int, int]] = field(default_factory=list)
    _estimates: list[Estimates] = field(default_factory=list)
    _ledger: Ledger = field(default_factory=Ledger)
    _learning: LearnerBeside | None = None
    _heave: list[tuple[int, HeaveModel]] = field(default_factory=list)
    _utc_s: float = 0.0

    def __post_init__(self) -> None:
        """Raise ``ConfigError`` for an engine that is not there."""
        c = self.config = with_facts(self.config, self.facts)
        self.layout = Layout.of(c)
        self.engine_name = _choose(self.engine)
        self._history = History(int(c.filter.window_s * 1e9), tape=Tape() if self.smooth else None)
        self._period_ns = round(1e9 / c.filter.output_rate_hz) if c.filter.output_rate_hz else 0
        self._intake = Intake(np.round(latencies_s(c, self.facts) * 1e9))
        if c.platform.use is True and c.platform.learn_s > 0.0:
            learner = MotionLearner(
                c.platform.learn_s,
                c.platform.learn_window_s,
                prior_motion(c.platform),
                c.imu.accel_noise,
                c.imu.gyro_noise,
            )
            self._learning = LearnerBeside(learner, self.executor)
        self._new_aligner()

    @property
    def heave_model(self) -> HeaveModel | None:
        """The last heave model that was learned, or None."""
        return self._learning.learner.model if self._learning is not None else None

    @property
    def motion(self) -> Array:
        """The parameters of the platform's motion (22,) as learned by now (``platform.motion``)."""
        known = None if self._learning is None else self._learning.learner.parameters
        return prior_motion(self.config.platform) if known is None else known.copy()

    @property
    def ready(self) -> bool:
        """True once estimates come out."""
        return self._engine is not None

    @property
    def sensors(self) -> tuple[str, ...]:
        """The names that the records' sensor indices mean."""
        return tuple(self._intake.names.sensors)

    @property
    def origin(self) -> Array | None:
        """Latitude [rad], longitude [rad] and altitude [m] of the NED origin; None before the start."""
        return None if self._site is None else np.array(self._site.origin)

    def clocks(self, at_ns: int) -> list[ClockSummary]:
        """Return every other clock against the inertial one, at a time of that clock."""
        return self._intake.clocks.summary(at_ns)

    def inertial_time_ns(self, clock: str, stamp_ns: int) -> int | None:
        """Return a stamp of a clock on the inertial clock, as known by now; None where nothing connects them.

        Latency is not corrected, and nothing of the estimator's state changes.
        """
        reading = self._intake.clocks.look(clock, stamp_ns)
        return None if reading is None else reading.time_ns

    def add_sensor(self, name: str, model: Model, latency_s: float = 0.0) -> None:
        """Take measurements of a sensor of the user's (events ``UserMeasurement`` with this name).

        ``model(value, nominal, layout)`` returns innovation (m,), Jacobian (m, n) and covariance (m, m), m from 1 to
        3; ``estimation.consistency.check_jacobian`` tests it. Raises ``ConfigError`` with the compiled engine.
        """
        if self.engine_name != "filterpy":
            raise ConfigError(
                f"sensor {name!r}: needs engine='filterpy'; the compiled engine has no user models"
            )
        self._models[name] = model
        self._intake.latency_of[name] = latency_s

    def step(self, event: Event) -> Output:
        """Take one event, in the order of arrival."""
        if self._engine is None:
            self._take(self._intake.single(event))
        else:
            self._take_one(event)
        return self._output()

    def feed(self, batch: EventBatch) -> Output:
        """Take the events of a batch, in its order, as ``step`` would one by one; the last estimate is given out."""
        self._take(self._intake.batch(batch))
        return self._output()

    def run(self, batch: EventBatch) -> Run:
        """Take a batch, in its order, to its end, and return all that it led to."""
        self._take(self._intake.batch(batch))
        self.finish()
        return self._as_run(*self._collect())

    def last_fused_ns(self, kind: Kind) -> int | None:
        """Return the time of the newest content of this kind that is in the estimate, or None.

        Only what is still in the window counts: older than ``filter.window_s`` is None.
        """
        h = self._history
        kinds, outcome = h.rows.kind[: h.done], h.rows.outcome[: h.done]
        found = np.flatnonzero((kinds == kind) & (outcome >= 0) & (outcome <= Outcome.DOWNWEIGHTED))
        return int(h.rows.t_ns[found[-1]]) if len(found) else None

    def deck_forecast(self, forecaster: DeckForecaster) -> DeckForecast | None:
        """Return the deck ahead of the newest estimate, or None before the start and where the platform is off.

        It tells a sea as learned once the filter has taken it up in its form.
        """
        if self._engine is None or self.layout.offsets[PLATFORM_HEAVE] < 0:
            return None
        s = self._engine.state
        band, known = s.motion[HEAVE : HEAVE + BAND_PARAMETERS], self.config.platform.motion
        learned = has_form(band) and (
            known is None or tuple(band) != tuple(known[HEAVE : HEAVE + BAND_PARAMETERS])
        )
        return forecaster.forecast(int(s.clock[0]), s.x, s.P, s.motion, learned, self.layout.offsets)

    def finish(self) -> None:
        """Settle what is still in the window; measurements that no inertial sample followed were in the future."""
        h = self._history
        if self._engine is None:
            self._not_ready(h.size)
            return
        self._advance()
        self._take_up(NEVER)
        self._ledger.keep(h.settle(everything=True))
        rest = h.first(h.size)
        rest.outcome[rest.outcome != Outcome.REJECTED_DUPLICATE] = Outcome.REJECTED_FUTURE
        self._ledger.keep(rest)
        h.drop(h.size)

    def smoothed(self, run: Run) -> Run:
        """Return a finished run with its estimates replaced by smoothed ones, from what came before and after each.

        They begin where the filter does, up to a window before its first estimate came out. Raises ``ValueError``
        where the estimator was not told to ``smooth``.
        """
        if self._history.tape is None:
            raise ValueError("nothing was kept to be smoothed; make the estimator with smooth=True")
        if self._site is None:
            return run
        from estimation.smoother import smooth

        p = pack_parameters(self.config, self._site)
        return replace(run, **columns_of(smooth(self._history.tape, self.layout, p, self._period_ns)))

    def settled(self) -> Output:
        """Settle what is still in the window, as ``finish`` does, and return what came of it."""
        self.finish()
        return self._output()

    # -- intake ------------------------------------------------------------------------------------------------

    def _take(self, r: Rows) -> None:
        if len(r) and self._utc_s == 0.0:
            self._utc_s = float(r.arrival_ns[0]) * 1e-9
            self._aligner.utc_s = self._utc_s
        bad = r.outcome != PENDING
        self._ledger.reject(r.take(np.flatnonzero(bad)))
        self._feed(r.take(np.flatnonzero(~bad)))

    def _take_one(self, event: Event) -> None:
        """Take one event while the filter runs: what ``_take`` does, without columns of one entry."""
        row = self._intake.row(event)
        if row is None:
            return
        if row.ints[0, OUTCOME] != PENDING:
            self._ledger.reject(row)
            return
        t = int(row.ints[0, T_NS])
        h, imu = self._history, row.ints[0, KIND] == Kind.IMU
        newest = h.newest_ns
        assert newest is not None
        far = max(h.window_ns, int(self.config.imu.gap_s * 1e9)) if imu else h.window_ns
        if not newest - h.window_ns <= t <= newest + far:
            self._feed(row)
            return
        late = t < newest or (imu and t == newest)
        row.ints[0, LATE], row.ints[0, AGE_NS] = late, newest - t
        if imu:
            h.newest_ns = max(newest, t)
            self._past.clear()
        if len(h.insert(row)):
            self._ledger.reject(row, Outcome.REJECTED_DUPLICATE)
        if not late:
            self._advance()

    def _feed(self, r: Rows) -> None:
        """Take well-formed rows in the order of arrival."""
        h, n, i = self._history, len(r), 0
        window = h.window_ns
        gap = max(window, int(self.config.imu.gap_s * 1e9))
        is_imu = r.kind == Kind.IMU
        ahead = LOOK_AHEAD
        while i < n:
            if self._engine is None:
                self._feed_before_start(r.take(slice(i, i + 1)))
                i += 1
                continue
            assert h.newest_ns is not None
            t = r.t_ns[i : i + ahead]
            imu_here = is_imu[i : i + ahead]
            imu_t = np.where(imu_here, t, np.iinfo(np.int64).min)
            newest = np.maximum.accumulate(np.concatenate(([h.newest_ns], imu_t)))[:-1]
            r.age_ns[i : i + len(t)] = newest - t
            too_old = t < newest - window
            late = (t < newest) | (imu_here & (t == newest))
            jump = imu_here & (t > newest + gap)
            stop = np.flatnonzero((late & ~too_old) | (too_old & imu_here) | jump)
            b = int(stop[0]) if len(stop) else len(t)
            # What is learned on the way is to be taken up between.
            ahead = LOOK_AHEAD if len(stop) or self._learning is not None else min(2 * ahead, FARTHEST)
            if b > 0:
                self._insert(r.take(slice(i, i + b)), newest[:b], too_old[:b])
                self._advance()
                i += b
                continue
            if jump[0]:
                self._restart(f"no inertial sample for {(t[0] - newest[0]) * 1e-9:.1f} s")
                continue
            if too_old[0]:
                if self._clock_went_back(int(t[0])):
                    continue
                self._ledger.reject(r.take(slice(i, i + 1)), Outcome.REJECTED_TOO_OLD)
                i += 1
                continue
            # A run of late events: put all in place, rewind once, when the next inertial sample comes.
            more = np.flatnonzero(~(late & ~too_old))
            e = int(more[0]) if len(more) else len(t)
            group = r.take(slice(i, i + e))
            group.late[:] = 1
            self._insert(group, newest[:e], too_old[:e])
            i += e

    def _insert(self, rows: Rows, newest: Int, too_old: NDArray[np.bool_]) -> None:
        """Put rows in the history, less those outside its window."""
        h = self._history
        future = (rows.t_ns > newest + h.window_ns) & (rows.kind != Kind.IMU)
        for mask, outcome in ((too_old, Outcome.REJECTED_TOO_OLD), (future, Outcome.REJECTED_FUTURE)):
            if mask.any():
                self._ledger.reject(rows.take(np.flatnonzero(mask)), outcome)
        good = ~(too_old | future)
        rows = rows if good.all() else rows.take(np.flatnonzero(good))
        imu = rows.kind == Kind.IMU
        if imu.any():
            top = int(rows.t_ns[imu].max())
            h.newest_ns = top if h.newest_ns is None else max(h.newest_ns, top)
            self._past.clear()
        repeated = h.insert(rows)
        if len(repeated):
            self._ledger.reject(
                rows.take(np.flatnonzero(np.isin(rows.id, repeated))), Outcome.REJECTED_DUPLICATE
            )

    def _advance(self) -> None:
        h = self._history
        assert self._engine is not None
        room = int(np.count_nonzero(h.rows.kind[h.done : h.size] == Kind.IMU))
        if room == 0:
            return
        assert h.newest_ns is not None
        self._take_up(h.newest_ns - h.window_ns - TAKE_UP_NS)
        out = Estimates.empty(room, self.layout)
        h.advance(self._engine, out, self._period_ns)
        if out.count:
            self._estimates.append(out.filled())
        settled = h.settle()
        self._ledger.keep(settled)
        if self._learning is not None and len(settled):
            self._learning.give(settled)

    def _take_up(self, until_ns: int) -> None:
        """Let the filter take up what was learned of the platform's motion by a time, and what is there: a fixed time
        after its fixes were final, so that neither the order of arrival nor the size of a batch shows."""
        if self._learning is None:
            return
        for due_ns, model, changed in self._learning.results(until_ns):
            self._heave.append((due_ns, model))
            for chain, parameters in changed.items():
                row = Rows.empty(1)
                row.t_ns[0] = due_ns + self._history.window_ns + TAKE_UP_NS
                row.kind[0] = HEAVE_MODEL
                row.stamp_ns[0] = due_ns
                row.own[0, :3] = parameters[0], chain, parameters[BAND_PARAMETERS]
                row.value[0] = parameters[1:BAND_PARAMETERS]
                row.id[0] = -1
                self._history.insert(row)

    def _feed_before_start(self, row: Rows) -> None:
        h = self._history
        t = int(row.t_ns[0])
        newest = t if h.newest_ns is None else h.newest_ns
        imu = int(row.kind[0]) == Kind.IMU
        old = np.array([h.newest_ns is not None and t < newest - h.window_ns])
        if imu and old[0] and self._clock_went_back(t):
            old[:] = False
            newest = t
        row.age_ns[0] = newest - t
        if h.newest_ns is None and not imu:
            self._ledger.reject(row, Outcome.REJECTED_NOT_READY)
            return
        self._insert(row, np.array([newest]), old)
        if not imu or h.newest_ns is None:
            return
        horizon = h.newest_ns - h.window_ns
        stop = int(np.searchsorted(h.rows.t_ns[: h.size], horizon, side="right"))
        if stop <= self._consumed:
            return
        started = self._aligner.consume(h.rows, self._consumed, stop)
        if started is None:
            self._consumed = 0
            self._not_ready(stop)
            return
        at, aligned = started
        self._consumed = 0
        self._site = aligned.site
        self._engine = self._start(aligned.state)
        self._ledger.note(int(aligned.state.clock[0]), f"initialised {aligned.note}")
        self._not_ready(at)
        h.begin(self._engine, 0)
        h.emitted_ns = max(h.emitted_ns, h.newest_ns - 1)
        self._advance()

    def _start(self, state: FilterState) -> Engine:
        assert self._site is not None
        p = pack_parameters(self.config, self._site)
        if self.engine_name == "compiled":
            from estimation.compiled import CompiledEngine

            return CompiledEngine.start(p, self.layout, state)
        from estimation.filter import FilterPyEngine

        users = {self._intake.names.sensor(name): model for name, model in self._models.items()}
        return FilterPyEngine.start(p, self.layout, state, users)

    def _new_aligner(self) -> None:
        declination = self.config.magnetometer.declination_deg
        known = self.facts.declination_rad if declination is None else np.radians(declination)
        self._aligner = Aligner(self.config, self.layout, 64, known, self._utc_s, self._site)

    def _restart(self, why: str) -> None:
        """Settle all, and align anew with what is known of the site and the gyro."""
        h = self._history
        t = h.newest_ns or 0
        self.finish()
        bias = None if self._engine is None else self._engine.state.x[BG0 : BG0 + 3].copy()
        self._ledger.note(t, f"{why}: aligning again")
        h.checkpoints.clear()
        self._engine = None
        self._consumed = 0
        self._new_aligner()
        self._aligner.gyro_bias = bias
        h.newest_ns = None
        if self._learning is not None:
            self._learning.begin_anew()

    def _clock_went_back(self, t: int) -> bool:
        """Note an inertial sample that is too old; return True, having restarted, when the clock itself went back."""
        if self._past and t < self._past[-1][0]:
            self._past.clear()
        self._past.append((t, 0))
        if len(self._past) < REWIND_COUNT or t - self._past[0][0] < REWIND_SPAN_NS:
            return False
        newest = self._history.newest_ns or t
        self._past.clear()
        self._restart(f"the inertial clock went back by {(newest - t) * 1e-9:.1f} s")
        self._history.emitted_ns = t
        return True

    # -- results -----------------------------------------------------------------------------------------------

    def _not_ready(self, count: int) -> None:
        """Forget the first rows of the history, which came before the filter was ready."""
        rows = self._history.first(count)
        rows.outcome[:] = np.where(rows.kind == Kind.IMU, Outcome.FUSED, Outcome.REJECTED_NOT_READY)
        self._ledger.reject(rows)
        self._history.drop(count)

    def _output(self) -> Output:
        estimate = (
            estimate_at(self._estimates[-1], self._estimates[-1].count - 1) if self._estimates else None
        )
        self._estimates.clear()
        self._heave.clear()  # a run's only: one is a megabyte
        return Output(estimate, self._ledger.take_records(self._intake.names), self._ledger.take_notes())

    def _collect(self) -> tuple[Estimates, NDArray[np.void], list[tuple[int, str]]]:
        estimates = Estimates.concatenate(self._estimates, self.layout)
        records = self._ledger.take_records(self._intake.names)
        notes = self._ledger.take_notes()
        self._estimates.clear()
        return estimates, records, notes

    def _as_run(self, e: Estimates, records: NDArray[np.void], notes: list[tuple[int, str]]) -> Run:
        records = records[np.lexsort((records["sensor"], records["t_ns"]))]
        return Run(
            **columns_of(e),
            engine=self.engine_name,
            state_names=self.layout.names,
            state_units=self.layout.units,
            heave=list(self._heave),
            clocks=self._intake.clocks.summary(int(e.t_ns[-1]) if len(e.t_ns) else 0),
            records=records,
            sensors=tuple(self._intake.names.sensors),
            notes=notes,
            imu_outcomes=dict(self._ledger.imu_outcomes),
            origin=self._site.origin if self._site else None,
            declination_rad=self._site.declination_rad if self._site else None,
            missing="" if self._engine is not None else self._aligner.missing,
        )


def _choose(engine: EngineName) -> str:
    """Return the engine to use; raises ``ConfigError``."""
    import importlib.util

    if engine not in ("auto", "filterpy", "compiled"):
        raise ConfigError(f"engine {engine!r} is unknown; use auto, filterpy or compiled")
    numba = importlib.util.find_spec("numba") is not None
    if engine == "compiled" and not numba:
        raise ConfigError("engine 'compiled' needs numba; install deckfix[fast] or use engine 'filterpy'")
    return "compiled" if engine != "filterpy" and numba else "filterpy"

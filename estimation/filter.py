"""The reference engine: an error-state EKF on ``filterpy.kalman.ExtendedKalmanFilter``.

Between updates the filter's ``x`` is the error state and zero; the nominal state beside it is what moves. This is
the engine that is easy to read, and the one that takes sensors defined by the user; ``estimation.compiled`` does
the same in compiled code.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from estimation import models, update
from estimation.algebra import inverse
from estimation.camera_age import noise_taken_out, noise_told, tells_age, weigh
from estimation.deck import HEAVE, deck_output, no_steps, seen_place, take_up
from estimation.frames import Array
from estimation.outcome import Outcome
from estimation.relinearise import moved_far, relinearise
from estimation.rows import (
    HEAVE_MODEL,
    SEEN_CORRECTED,
    SEEN_DOUBT,
    SEEN_LEVEL,
    SEEN_MOVED,
    SEEN_PLACE,
    Estimates,
    FilterState,
    Rows,
)
from estimation.state import ATTITUDE, CAMERA_LATENCY, P0, PL0, PO0, V0, Layout, plus
from estimation.trail import EMITS, RESET_KIND, RESET_SIZE, Trail
from estimation.watch import LET_GO, let_go, unexplained

if TYPE_CHECKING:
    from filterpy.kalman import ExtendedKalmanFilter

IMU = 0
USER = 9

Model = Callable[[Array, Array, Layout], tuple[Array, Array, Array]]
"""(value, nominal state, layout) -> innovation (m,), Jacobian (m, n), covariance (m, m); m is 1 to 3."""


@dataclass(slots=True)
class FilterPyEngine:
    """Processes rows in order with filterpy's EKF.

    ``p`` is the parameter vector, ``users`` maps a sensor's index to the user's model; what happens is written to
    ``trail`` where it is on; ``steps`` remembers what the deck's chains do over a step.
    """

    p: Array
    layout: Layout
    state: FilterState
    users: Mapping[int, Model]
    ekf: ExtendedKalmanFilter
    trail: Trail
    steps: tuple[Array, Array] = field(default_factory=no_steps)

    @classmethod
    def start(
        cls, p: Array, layout: Layout, state: FilterState, users: Mapping[int, Model] | None = None
    ) -> FilterPyEngine:
        """Return an engine at a state; imports filterpy."""
        return cls(p, layout, state, users or {}, _ekf(layout.size), Trail.off(layout))

    def save(self) -> FilterState:
        """Return a checkpoint."""
        return self.state.copy()

    def load(self, saved: FilterState) -> None:
        """Go back to a checkpoint."""
        self.state = saved.copy()

    def advance(
        self, rows: Rows, start: int, stop: int, out: Estimates, emit_after_ns: int, period_ns: int
    ) -> None:
        """Process the rows start..stop in order; the last must be an inertial sample.

        An estimate is written for each inertial sample later than ``emit_after_ns`` that begins a new period
        (every one for ``period_ns`` 0).
        """
        s = self.state
        following = start
        for i in range(start, stop):
            if following <= i:
                following = i
                while rows.kind[following] != IMU:
                    following += 1
            t_imu, imu = int(rows.t_ns[following]), rows.value[following]
            t = int(rows.t_ns[i])
            self._propagate(t, t_imu, imu)
            if rows.kind[i] == HEAVE_MODEL:
                rows.outcome[i] = Outcome.FUSED
                before = (int(rows.stamp_ns[i]) - int(s.clock[2])) * 1e-9 < s.scatter[3]
                if before and rows.own[i, 1] == HEAVE:
                    continue
                chain = self.trail.chain[self.trail.count[0]] if self.trail.on else np.empty((0, 0))
                take_up(rows.value[i], rows.own[i], s.x, s.P, s.motion, self.layout.offsets, chain)
                continue
            if i < following:
                gyro = update.interpolate(s.imu, int(s.clock[1]), imu, t_imu, t)[:3]
                x, P, held = s.x, s.P, s.x[P0 : V0 + 3].copy()
                self._fuse(rows, i, gyro, (t_imu - int(s.clock[1])) * 1e-9)
                s.moved[:3] += s.x[P0 : P0 + 3] - held[:3]
                s.moved[3:] += (s.x[V0 : V0 + 3] - held[3:]) ** 2
                if self.trail.on:
                    self._record(rows, i, x, P)
                if rows.reset[i] == LET_GO:
                    self._let_go(rows, i)
                continue
            update.scatter_update(s.scatter, s.imu, imu, (t - int(s.clock[1])) * 1e-9)
            new_period = period_ns == 0 or t // period_ns != int(s.clock[1]) // period_ns
            s.clock[1] = t
            s.imu = imu.copy()
            if t > emit_after_ns and new_period:
                self._write(out, t)
                if self.trail.on:
                    self.trail.reach(t, s.x, s.P, s.motion)
                    self.trail.marks[self.trail.count[0] - 1, EMITS] = 1
            following = i + 1

    def _propagate(self, t: int, t_imu: int, imu: Array) -> None:
        s = self.state
        total = t - int(s.clock[0])
        if total <= 0:
            return
        n = self.layout.size
        steps = max(1, math.ceil(total * 1e-9 / update.MAX_STEP_S))
        extra = update.extra_noise(s.scatter, (t_imu - int(s.clock[1])) * 1e-9, self.p)
        F, Q = np.empty((n, n)), np.empty((n, n))
        a = int(s.clock[0])
        dt = total * 1e-9 / steps
        for k in range(steps):
            middle = a + total * ((k + 0.5) / steps)
            mean = update.interpolate(s.imu, int(s.clock[1]), imu, t_imu, middle)
            s.x = models.transition(
                s.x, mean[:3], mean[3:], dt, extra, self.p, self.layout.offsets, F, Q, s.motion, *self.steps
            )
            self.ekf.P = s.P
            self.ekf.F = F
            self.ekf.Q = Q
            self.ekf.predict()
            s.P = 0.5 * (self.ekf.P + self.ekf.P.T)
            if self.trail.on:
                k = self.trail.count[0]
                self.trail.chain[k] = F @ self.trail.chain[k]
        s.clock[0] = t

    def _fuse(self, rows: Rows, i: int, gyro: Array, interval_s: float) -> None:
        s, n, kind = self.state, self.layout.size, int(rows.kind[i])
        r, H, R = np.zeros(3), np.zeros((3, n)), np.zeros((3, 3))
        if kind == USER:
            user = self.users.get(int(rows.sensor[i]))
            m = models.UNUSABLE_NOW
            if user is not None:
                ru, Hu, Ru = user(rows.value[i], s.x, self.layout)
                m = len(ru)
                r[:m], H[:m], R[:m, :m] = ru, Hu, Ru
        else:
            m = models.measure(
                kind, rows.value[i], rows.own[i], s.x, gyro, self.p, self.layout.offsets, r, H, R
            )
        rows.result[i] = 0.0
        rows.reset[i] = 0
        if m < 0:
            rows.outcome[i] = -m
            return
        r, H, R = r[:m], H[:m], R[:m, :m]
        memory = s.memory[rows.sensor[i]]
        t_s = (int(rows.t_ns[i]) - int(s.clock[2])) * 1e-9
        if kind == models.BAROMETER:
            R[0, 0] = update.reading_noise(memory, t_s, r[0], R[0, 0])
        S = H @ s.P @ H.T + R
        nis = float(r @ np.linalg.solve(S, r))
        rows.result[i, 0] = nis
        rows.result[i, 1] = m
        rows.result[i, 2 : 2 + m] = r
        rows.result[i, 5 : 5 + m] = np.sqrt(np.diag(S))
        rows.log_det[i] = np.linalg.slogdet(S)[1]
        if kind == models.VISION:
            seen_place(r, R, s.x, self.p, rows.seen[i])
            rows.seen[i, SEEN_MOVED:SEEN_PLACE] = s.moved[:3]
            rows.seen[i, SEEN_DOUBT:SEEN_CORRECTED] = np.diag(s.P)[V0 : V0 + 3]
            rows.seen[i, SEEN_CORRECTED:] = s.moved[3:]
        w = update.weight(nis, m, self.p)
        if kind == models.VISION and unexplained(memory, t_s, r, S, w, s.x, self.p, s.motion):
            rows.reset[i] = LET_GO
        if w == 0.0:
            rows.outcome[i] = Outcome.REJECTED_GATE
            if update.locked_out(memory, kind, t_s, r, R, m, self.p):
                update.reset_datum(kind, s.x, s.P, r, R, m, self.layout.offsets)
                memory[0] = 0.0
                rows.reset[i] = 1
                rows.outcome[i] = Outcome.FUSED_LATE if rows.late[i] else Outcome.FUSED
            return
        memory[0] = 0.0
        rows.outcome[i] = Outcome.FUSED_LATE if rows.late[i] else Outcome.FUSED
        if w < 1.0:
            rows.outcome[i] = Outcome.DOWNWEIGHTED
        learn, shown = False, 0.0
        if kind == models.VISION:
            age = int(self.layout.offsets[CAMERA_LATENCY])
            shown = noise_told(s.x, S, R, w, s.scatter[1], self.p)
            weigh(s.scatter, shown, H @ s.P[:, age], inverse(S - R + R / w, m), float(s.P[age, age]))
            learn = tells_age(s.scatter, self.p)
        first, stop = update.considered(learn, self.layout.offsets)
        held = s.P[first:stop, first:stop].copy()
        ekf, error = self.ekf, self._update(r, H, R / w)
        error[first:stop] = 0.0
        if moved_far(kind, error, self.layout.offsets):
            relinearise(rows.value[i], rows.own[i], s.x, error, gyro, self.p, self.layout.offsets, r, H, R)
            error = self._update(r, H, R / w)
            error[first:stop] = 0.0
        s.x = plus(s.x, error, self.layout.offsets)
        rows.seen[i, SEEN_LEVEL] = s.x[PL0]
        rows.seen[i, SEEN_PLACE:SEEN_DOUBT] = s.x[PO0 : PO0 + 2]
        P = ekf.P
        att = int(self.layout.offsets[ATTITUDE])
        G = models.right_jacobian(error[att : att + 3])
        P[att : att + 3, :] = G @ P[att : att + 3, :]
        P[:, att : att + 3] = P[:, att : att + 3] @ G.T
        P[first:stop, first:stop] = held
        s.P = 0.5 * (P + P.T)
        if learn:
            s.x = noise_taken_out(s.x, s.P, shown, interval_s, self.p, self.layout.offsets)
        if stop:
            update.hold_latency(s.x, self.p)

    def _update(self, r: Array, H: Array, R: Array) -> Array:
        """Let filterpy update the state's covariance; return the error state (n,)."""
        ekf, m = self.ekf, len(r)
        ekf.x = np.zeros(self.layout.size)
        ekf.P = self.state.P
        ekf.update(r, lambda _: H, lambda _: np.zeros(m), R=R)
        return np.asarray(ekf.x)

    def _let_go(self, rows: Rows, i: int) -> None:
        s = self.state
        t_s = (int(rows.t_ns[i]) - int(s.clock[2])) * 1e-9
        chain = self.trail.chain[self.trail.count[0]] if self.trail.on else np.empty((0, 0))
        memory = s.memory[rows.sensor[i]]
        let_go(t_s, s.x, s.P, memory, s.scatter, s.motion, self.p, self.layout.offsets, chain)

    def _record(self, rows: Rows, i: int, x: Array, P: Array) -> None:
        """Note a measurement that was fused, with the state before it."""
        s, trail = self.state, self.trail
        if rows.outcome[i] > Outcome.DOWNWEIGHTED:
            return
        if rows.reset[i] == 1:
            trail.open(int(rows.t_ns[i]), s.x, s.P, s.motion)
            trail.marks[trail.count[0] - 1, RESET_KIND] = rows.kind[i]
            trail.marks[trail.count[0] - 1, RESET_SIZE] = int(rows.result[i, 1])
            return
        trail.reach(int(rows.t_ns[i]), x, P, s.motion)
        trail.close(s.x, s.P)

    def _write(self, out: Estimates, t: int) -> None:
        s, k = self.state, out.count
        out.t_ns[k] = t
        out.x[k] = s.x
        out.sigma[k] = np.sqrt(np.diag(s.P))
        out.covariance[k] = s.P[:9, :9]
        if out.deck.shape[1]:
            out.deck[k], A = deck_output(s.x, s.motion, self.layout.offsets, self.layout.size)
            out.deck_covariance[k] = A @ s.P @ A.T
        out.count = k + 1


def _ekf(n: int) -> Any:
    from filterpy.kalman import ExtendedKalmanFilter

    class ErrorStateEKF(ExtendedKalmanFilter):  # type: ignore[misc]
        """filterpy's EKF whose state is the error: zero before each update, so predicting it is nothing."""

        def predict_x(self, u: object = 0) -> None:
            """Leave the error state as it is; the nominal state is propagated by the model."""

    ekf = ErrorStateEKF(dim_x=n, dim_z=3)
    ekf.x = np.zeros(n)
    return ekf

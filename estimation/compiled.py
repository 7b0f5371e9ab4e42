"""The compiled engine: the reference engine's loop in one numba kernel, over the same model functions.

The model functions stay plain Python; numba compiles them when the kernel is first called and caches the machine
code under the user's cache folder, keyed by the sources, so that an edit is never met by stale code.
"""

from __future__ import annotations

import hashlib
import inspect
import math
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numba
import numpy as np
from numba.extending import register_jitable

from estimation import frames, models, parameters, state, update
from estimation.frames import Array
from estimation.models import measure, right_jacobian, transition
from estimation.outcome import Outcome
from estimation.rows import Estimates, FilterState, Int, Rows
from estimation.state import ATTITUDE, Layout, Offsets, plus
from estimation.update import MAX_STEP_S, extra_noise, interpolate, locked_out, reset_datum, scatter_update, weight

_FUSED = int(Outcome.FUSED)
_FUSED_LATE = int(Outcome.FUSED_LATE)
_DOWNWEIGHTED = int(Outcome.DOWNWEIGHTED)
_REJECTED_GATE = int(Outcome.REJECTED_GATE)
_IMU = 0


@contextmanager
def _cache_of_these_sources() -> Iterator[None]:
    """Let numba cache what is defined within, in a folder named after the sources that it is compiled from."""
    digest = hashlib.sha256()
    for module in (frames, models, parameters, state, update):
        digest.update(Path(inspect.getfile(module)).read_bytes())
    digest.update(Path(__file__).read_bytes())
    base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
    before = numba.config.CACHE_DIR
    numba.config.CACHE_DIR = str(base / "deckfix" / digest.hexdigest()[:16])
    try:
        yield
    finally:
        numba.config.CACHE_DIR = before


for _module in (frames, models, state, update):
    for _function in vars(_module).values():
        if inspect.isfunction(_function) and _function.__module__ == _module.__name__:
            register_jitable(_function)


def _propagate(
    clock: Int, x: Array, P: Array, imu0: Array, scatter: Array, t: int, t_imu: int, imu: Array, p: Array,
    offsets: Offsets, F: Array, Q: Array,
) -> Array:  # fmt: skip
    total = t - clock[0]
    if total <= 0:
        return x
    n = P.shape[0]
    steps = max(1, math.ceil(total * 1e-9 / MAX_STEP_S))
    extra = extra_noise(scatter, (t_imu - clock[1]) * 1e-9, p)
    a = clock[0]
    dt = total * 1e-9 / steps
    for k in range(steps):
        middle = a + total * ((k + 0.5) / steps)
        mean = interpolate(imu0, clock[1], imu, t_imu, middle)
        x = transition(x, mean[:3], mean[3:], dt, extra, p, offsets, F, Q)
        # F is the identity but for the first 15 rows (and a diagonal): only those rows mix.
        FP = np.empty((n, n))
        FP[:15, :] = F[:15, :15] @ P[:15, :]
        for i in range(15, n):
            for j in range(n):
                FP[i, j] = F[i, i] * P[i, j]
        new = np.empty((n, n))
        new[:, :15] = FP[:, :15] @ F[:15, :15].T
        for j in range(15, n):
            for i in range(n):
                new[i, j] = FP[i, j] * F[j, j]
        for i in range(n):
            for j in range(i + 1):
                value = 0.5 * (new[i, j] + new[j, i]) + Q[i, j]
                P[i, j] = value
                P[j, i] = value
    clock[0] = t
    return x


def _fuse(
    x: Array, P: Array, lock: Array, kind: int, value: Array, own: Array, gyro: Array, t_s: float, late: int,
    p: Array, offsets: Offsets, H3: Array, result: Array,
) -> tuple[int, int, Array]:  # fmt: skip
    n = P.shape[0]
    r3 = np.zeros(3)
    R3 = np.zeros((3, 3))
    result[:] = 0.0
    m = measure(kind, value, own, x, gyro, p, offsets, r3, H3, R3)
    if m < 0:
        return -m, 0, x
    r, H, R = r3[:m], H3[:m], R3[:m, :m].copy()
    PHt = P @ H.T
    S = H @ PHt + R
    nis = r @ np.linalg.solve(S, r)
    result[0] = nis
    result[1] = m
    for i in range(m):
        result[2 + i] = r[i]
        result[5 + i] = math.sqrt(S[i, i])
    w = weight(nis, m, p)
    outcome = _FUSED_LATE if late else _FUSED
    if w == 0.0:
        if locked_out(lock, kind, t_s, r, m, p):
            reset_datum(kind, x, P, r, R, m, offsets)
            lock[0] = 0.0
            return outcome, 1, x
        return _REJECTED_GATE, 0, x
    lock[0] = 0.0
    if w < 1.0:
        outcome = _DOWNWEIGHTED
        R = R / w
        S = H @ PHt + R
    K = PHt @ np.linalg.inv(S)
    error = K @ r
    # Joseph's form (I - KH) P (I - KH)' + K R K', with the products in the cheap order.
    B = P - K @ PHt.T
    J = B - (B @ H.T) @ K.T + (K @ R) @ K.T
    x = plus(x, error, offsets)
    att = offsets[ATTITUDE]
    G = right_jacobian(error[att : att + 3])
    J[att : att + 3, :] = G @ J[att : att + 3, :]
    J[:, att : att + 3] = np.ascontiguousarray(J[:, att : att + 3]) @ G.T
    for i in range(n):
        for j in range(n):
            P[i, j] = 0.5 * (J[i, j] + J[j, i])
    return outcome, 0, x


register_jitable(_propagate)
register_jitable(_fuse)


def _advance(
    clock: Int, x: Array, P: Array, imu0: Array, scatter: Array, lock: Array, p: Array, offsets: Offsets,
    t_ns: Int, kind: Int, sensor: Int, late: Int, value: Array, own: Array, outcome: Int, reset: Int, result: Array,
    start: int, stop: int, out_t: Int, out_x: Array, out_sigma: Array, out_covariance: Array, count: int,
    emit_after_ns: int, period_ns: int,
) -> int:  # fmt: skip
    n = P.shape[0]
    F = np.empty((n, n))
    Q = np.empty((n, n))
    H = np.zeros((3, n))
    following = start
    state = x.copy()
    for i in range(start, stop):
        if following <= i:
            following = i
            while kind[following] != _IMU:
                following += 1
        t = t_ns[i]
        imu = value[following]
        state = _propagate(clock, state, P, imu0, scatter, t, t_ns[following], imu, p, offsets, F, Q)
        if i < following:
            gyro = interpolate(imu0, clock[1], imu, t_ns[following], t)[:3]
            t_s = (t - clock[2]) * 1e-9
            outcome[i], reset[i], state = _fuse(
                state, P, lock[sensor[i]], kind[i], value[i], own[i], gyro, t_s, late[i], p, offsets, H, result[i]
            )
            continue
        scatter_update(scatter, imu0, imu, (t - clock[1]) * 1e-9)
        new_period = period_ns == 0 or t // period_ns != clock[1] // period_ns
        clock[1] = t
        imu0[:] = imu
        if t > emit_after_ns and new_period:
            out_t[count] = t
            out_x[count] = state
            for j in range(n):
                out_sigma[count, j] = math.sqrt(P[j, j])
            out_covariance[count] = P[:9, :9]
            count += 1
        following = i + 1
    x[:] = state
    return count


def _jit(function: Callable[..., Any]) -> Callable[..., Any]:
    with _cache_of_these_sources():
        compiled: Callable[..., Any] = numba.njit(cache=True, error_model="numpy")(function)
    return compiled


_kernel = _jit(_advance)


@dataclass(slots=True)
class CompiledEngine:
    """Processes rows in order in compiled code; same results as ``estimation.filter.FilterPyEngine``."""

    p: Array
    layout: Layout
    state: FilterState

    @classmethod
    def start(cls, p: Array, layout: Layout, state: FilterState) -> CompiledEngine:
        """Return an engine at a state."""
        return cls(p, layout, state)

    def save(self) -> FilterState:
        """Return a checkpoint."""
        return self.state.copy()

    def load(self, saved: FilterState) -> None:
        """Go back to a checkpoint."""
        self.state = saved.copy()

    def advance(self, rows: Rows, start: int, stop: int, out: Estimates, emit_after_ns: int, period_ns: int) -> None:
        """Process the rows start..stop in order; see ``FilterPyEngine.advance``."""
        s = self.state
        out.count = _kernel(
            s.clock, s.x, s.P, s.imu, s.scatter, s.lock, self.p, self.layout.offsets,
            rows.t_ns, rows.kind, rows.sensor, rows.late, rows.value, rows.own, rows.outcome, rows.reset, rows.result,
            start, stop, out.t_ns, out.x, out.sigma, out.covariance, out.count, emit_after_ns, period_ns,
        )  # fmt: skip

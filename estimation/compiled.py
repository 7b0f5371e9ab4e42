"""The compiled engine: the reference engine's loop in one numba kernel, over the same model functions.

The model functions stay plain Python; numba compiles them (``estimation.overloads``) when the kernel is first called,
and caches the machine code under the user's cache folder, keyed by the sources: an edit never meets stale code.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numba.extending import register_jitable

from estimation.algebra import (
    congruence,
    corrected,
    cross_covariance,
    determinant,
    gain,
    innovation_covariance,
    inverse,
    joseph,
    reset_attitude,
)
from estimation.band import BAND_SIZE
from estimation.camera_age import noise_taken_out, noise_told, tells_age, weigh
from estimation.codecache import jitted
from estimation.deck import HEAVE, deck_output, no_steps, seen_place, take_up
from estimation.frames import Array
from estimation.models import BAROMETER, VISION, measure, right_jacobian, transition
from estimation.outcome import Outcome
from estimation.overloads import SOURCES
from estimation.relinearise import moved_far, relinearise
from estimation.rows import (
    HEAVE_MODEL,
    KIND,
    LATE,
    LOG_DET,
    OUTCOME,
    OWN,
    RESET,
    RESULT,
    SEEN,
    SEEN_CORRECTED,
    SEEN_DOUBT,
    SEEN_LEVEL,
    SEEN_MOVED,
    SEEN_PLACE,
    SENSOR,
    STAMP_NS,
    T_NS,
    VALUE,
    Estimates,
    FilterState,
    Int,
    Rows,
)
from estimation.state import (
    ATTITUDE,
    CAMERA_LATENCY,
    P0,
    PL0,
    PLATFORM_DRIFT,
    PLATFORM_HEAVE,
    PLATFORM_OFFSET,
    PLATFORM_SWAY,
    PO0,
    SIZES,
    V0,
    Layout,
    Offsets,
    plus,
)
from estimation.trail import AFTER, EMITS, RESET_KIND, RESET_SIZE, Trail
from estimation.update import (
    MAX_STEP_S,
    considered,
    extra_noise,
    hold_latency,
    interpolate,
    locked_out,
    reading_noise,
    reset_datum,
    scatter_update,
    weight,
)
from estimation.watch import LET_GO, let_go, unexplained

_FUSED = int(Outcome.FUSED)
_FUSED_LATE = int(Outcome.FUSED_LATE)
_DOWNWEIGHTED = int(Outcome.DOWNWEIGHTED)
_REJECTED_GATE = int(Outcome.REJECTED_GATE)
_IMU = 0
_SEEN = SEEN - RESULT
_LOG_DET = LOG_DET - RESULT


def _transited(F: Array, P: Array, span: Int) -> Array:
    """Return F P, using that F is the identity but for the nine columns of attitude and biases, the velocity in the
    position, and the spans of ``_spans`` behind. Sums are written out: a row is then gone through once.
    """
    n = P.shape[0]
    FP = np.empty((n, n))
    for i in range(6):
        dt = F[0, 3] if i < 3 else 0.0
        a, b, c = F[i, 6], F[i, 7], F[i, 8]
        d, e, f = F[i, 9], F[i, 10], F[i, 11]
        g, h, k = F[i, 12], F[i, 13], F[i, 14]
        for j in range(n):
            FP[i, j] = (
                P[i, j] + dt * P[i + 3, j]
                + a * P[6, j] + b * P[7, j] + c * P[8, j]
                + d * P[9, j] + e * P[10, j] + f * P[11, j]
                + g * P[12, j] + h * P[13, j] + k * P[14, j]
            )  # fmt: skip
    for i in range(6, 9):
        _six_rows(FP, F, P, i, 6)
    for i in range(9, n):
        first = span[i, 0]
        if span[i, 1] - first == BAND_SIZE:
            _six_rows(FP, F, P, i, first)
            continue
        for j in range(n):
            FP[i, j] = F[i, first] * P[first, j]
        for q in range(first + 1, span[i, 1]):
            for j in range(n):
                FP[i, j] += F[i, q] * P[q, j]
    return FP


@register_jitable
def _six_rows(out: Array, F: Array, P: Array, i: int, first: int) -> None:
    """Write row i of F P where F has entries in six columns from the first on."""
    a, b, c = F[i, first], F[i, first + 1], F[i, first + 2]
    d, e, f = F[i, first + 3], F[i, first + 4], F[i, first + 5]
    for j in range(P.shape[1]):
        out[i, j] = (
            a * P[first, j] + b * P[first + 1, j] + c * P[first + 2, j]
            + d * P[first + 3, j] + e * P[first + 4, j] + f * P[first + 5, j]
        )  # fmt: skip


def _propagate_covariance(P: Array, F: Array, Q: Array, span: Int) -> None:
    """Replace P by F (F P)' + Q, with F as in ``_transited``: its loops run along rows, and it is F P F'."""
    n = P.shape[0]
    FP = _transited(F, P, span)
    turned = np.empty((n, n))
    for i in range(n):
        for j in range(n):
            turned[j, i] = FP[i, j]
    FPF = _transited(F, turned, span)
    for i in range(n):
        for j in range(i + 1):
            value = FPF[j, i] + Q[i, j]
            P[i, j] = value
            P[j, i] = value


def _spans(layout: Layout) -> Int:
    """Return the first and last-but-one column in which each row of F (n, 2) is not zero, behind the ninth row."""
    span = np.array([[i, i + 1] for i in range(layout.size)], dtype=np.int64)
    place, drift = int(layout.offsets[PLATFORM_OFFSET]), int(layout.offsets[PLATFORM_DRIFT])
    if place >= 0:
        for axis in range(SIZES[PLATFORM_OFFSET]):
            span[place + axis, 1] = drift + axis + 1
    for block, size in ((PLATFORM_SWAY, BAND_SIZE), (PLATFORM_HEAVE, BAND_SIZE)):
        start = int(layout.offsets[block])
        if start >= 0:
            for i in range(start, start + SIZES[block]):
                first = start + (i - start) // size * size
                span[i] = first, first + size
    return span


def _propagate(
    clock: Int, x: Array, P: Array, imu0: Array, scatter: Array, t: int, t_imu: int, imu: Array, p: Array,
    offsets: Offsets, F: Array, Q: Array, motion: Array, keys: Array, kept: Array, span: Int, chain: Array,
) -> Array:  # fmt: skip
    total = t - clock[0]
    if total <= 0:
        return x
    steps = max(1, math.ceil(total * 1e-9 / MAX_STEP_S))
    extra = extra_noise(scatter, (t_imu - clock[1]) * 1e-9, p)
    a = clock[0]
    dt = total * 1e-9 / steps
    for k in range(steps):
        middle = a + total * ((k + 0.5) / steps)
        mean = interpolate(imu0, clock[1], imu, t_imu, middle)
        x = transition(x, mean[:3], mean[3:], dt, extra, p, offsets, F, Q, motion, keys, kept)
        _propagate_covariance(P, F, Q, span)
        if chain.shape[0] > 0:
            chain[:, :] = _transited(F, chain, span)
    clock[0] = t
    return x


def _fuse(
    x: Array, P: Array, memory: Array, scatter: Array, kind: int, value: Array, own: Array, gyro: Array,
    interval_s: float, t_s: float, late: int, p: Array, offsets: Offsets, motion: Array, moved: Array, H: Array,
    result: Array,
) -> tuple[int, int, Array]:  # fmt: skip
    r = np.zeros(3)
    R = np.zeros((3, 3))
    result[:] = 0.0
    m = measure(kind, value, own, x, gyro, p, offsets, r, H, R)
    if m < 0:
        return -m, 0, x
    if kind == BAROMETER:
        R[0, 0] = reading_noise(memory, t_s, r[0], R[0, 0])
    PHt = cross_covariance(P, H, m)
    S = innovation_covariance(H, PHt, R, 1.0, m)
    inverted = inverse(S, m)
    nis = 0.0
    for i in range(m):
        for j in range(m):
            nis += r[i] * inverted[i, j] * r[j]
        result[2 + i] = r[i]
        result[5 + i] = math.sqrt(S[i, i])
    result[0] = nis
    result[1] = m
    if kind == VISION:
        seen_place(r, R, x, p, result[_SEEN : _SEEN + SEEN_LEVEL])
        result[_SEEN + SEEN_MOVED : _SEEN + SEEN_PLACE] = moved[:3]
        for j in range(3):
            result[_SEEN + SEEN_DOUBT + j] = P[V0 + j, V0 + j]
        result[_SEEN + SEEN_CORRECTED : _LOG_DET] = moved[3:]
    result[_LOG_DET] = math.log(determinant(S, m))
    w = weight(nis, m, p)
    outcome = _FUSED_LATE if late else _FUSED
    mark = 0
    if kind == VISION and unexplained(memory, t_s, r, S, w, x, p, motion):
        mark = LET_GO
    if w == 0.0:
        if locked_out(memory, kind, t_s, r, R, m, p):
            reset_datum(kind, x, P, r, R, m, offsets)
            memory[0] = 0.0
            return outcome, 1, x
        return _REJECTED_GATE, 0, x
    memory[0] = 0.0
    if w < 1.0:
        outcome = _DOWNWEIGHTED
        inverted = inverse(innovation_covariance(H, PHt, R, 1.0 / w, m), m)
    K = gain(PHt, inverted, m)
    error = corrected(K, r, m)
    learn, shown = False, 0.0
    if kind == VISION:
        age = offsets[CAMERA_LATENCY]
        shown = noise_told(x, S, R, w, scatter[1], p)
        weigh(scatter, shown, PHt[age], inverted, P[age, age])
        learn = tells_age(scatter, p)
    first, stop = considered(learn, offsets)
    held = P[first:stop, first:stop].copy()
    error[first:stop] = 0.0
    if moved_far(kind, error, offsets):
        relinearise(value, own, x, error, gyro, p, offsets, r, H, R)
        PHt = cross_covariance(P, H, m)
        K = gain(PHt, inverse(innovation_covariance(H, PHt, R, 1.0 / w, m), m), m)
        error = corrected(K, r, m)
        error[first:stop] = 0.0
    joseph(P, K, H, R, 1.0 / w, m)
    att = offsets[ATTITUDE]
    reset_attitude(P, right_jacobian(error[att : att + 3]), att)
    x = plus(x, error, offsets)
    result[_SEEN + SEEN_LEVEL] = x[PL0]
    result[_SEEN + SEEN_PLACE : _SEEN + SEEN_DOUBT] = x[PO0 : PO0 + 2]
    if stop > 0:
        for i in range(first, stop):
            for j in range(first, stop):
                P[i, j] = held[i - first, j - first]
        if learn:
            x = noise_taken_out(x, P, shown, interval_s, p, offsets)
        hold_latency(x, p)
    return outcome, mark, x


def _open(
    t: int, x: Array, P: Array, motion: Array, trail_count: Int, trail_t: Int, trail_marks: Int, trail_x: Array,
    trail_P: Array, trail_chain: Array, trail_motion: Array,
) -> None:  # fmt: skip
    """Begin a node of the trail; ``Trail.open`` in compiled code."""
    k = trail_count[0]
    trail_t[k] = t
    trail_marks[k, :] = 0
    trail_motion[k] = motion
    for side in range(2):
        trail_x[k, side] = x
        trail_P[k, side] = P
    trail_chain[k + 1] = np.eye(P.shape[0])
    trail_count[0] = k + 1


register_jitable(_open)
register_jitable(_transited)
register_jitable(_propagate_covariance)
register_jitable(_propagate)
register_jitable(_fuse)


def _advance(
    clock: Int, x: Array, P: Array, imu0: Array, scatter: Array, memory: Array, motion: Array, moved: Array,
    keys: Array, kept: Array, p: Array, offsets: Offsets, span: Int, ints: Int, floats: Array, start: int,
    stop: int, out_t: Int, out_x: Array,
    out_sigma: Array, out_covariance: Array, out_deck: Array, out_deck_covariance: Array, count: int,
    emit_after_ns: int, period_ns: int, trail_count: Int, trail_t: Int, trail_marks: Int, trail_x: Array,
    trail_P: Array, trail_chain: Array, trail_motion: Array,
) -> int:  # fmt: skip
    n = P.shape[0]
    recording = len(trail_t) > 0
    chain = np.empty((0, 0))
    x_before, P_before = np.empty(0), np.empty((0, 0))
    F = np.empty((n, n))
    Q = np.empty((n, n))
    H = np.zeros((3, n))
    following = start
    state = x.copy()
    for i in range(start, stop):
        if following <= i:
            following = i
            while ints[following, KIND] != _IMU:
                following += 1
        t, t_imu = ints[i, T_NS], ints[following, T_NS]
        imu = floats[following, VALUE:OWN]
        if recording:
            chain = trail_chain[trail_count[0]]
        state = _propagate(
            clock, state, P, imu0, scatter, t, t_imu, imu, p, offsets, F, Q, motion, keys, kept, span, chain
        )
        if ints[i, KIND] == HEAVE_MODEL:
            ints[i, OUTCOME] = _FUSED
            before = (ints[i, STAMP_NS] - clock[2]) * 1e-9 < scatter[3]
            if before and floats[i, OWN + 1] == HEAVE:
                continue
            take_up(floats[i, VALUE:OWN], floats[i, OWN:RESULT], state, P, motion, offsets, chain)
            continue
        if i < following:
            gyro = interpolate(imu0, clock[1], imu, t_imu, t)[:3]
            t_s = (t - clock[2]) * 1e-9
            if recording:
                x_before, P_before = state, P.copy()
            held = state[P0 : V0 + 3].copy()
            ints[i, OUTCOME], ints[i, RESET], state = _fuse(
                state, P, memory[ints[i, SENSOR]], scatter, ints[i, KIND], floats[i, VALUE:OWN],
                floats[i, OWN:RESULT], gyro, (t_imu - clock[1]) * 1e-9, t_s, ints[i, LATE], p, offsets, motion, moved,
                H, floats[i, RESULT:],
            )  # fmt: skip
            moved[:3] += state[P0 : P0 + 3] - held[:3]
            moved[3:] += (state[V0 : V0 + 3] - held[3:]) ** 2
            if recording and ints[i, OUTCOME] <= _DOWNWEIGHTED:
                if ints[i, RESET] == 1:
                    _open(t, state, P, motion, trail_count, trail_t, trail_marks, trail_x, trail_P, trail_chain,
                          trail_motion)  # fmt: skip
                    trail_marks[trail_count[0] - 1, RESET_KIND] = ints[i, KIND]
                    trail_marks[trail_count[0] - 1, RESET_SIZE] = int(floats[i, RESULT + 1])
                    continue
                if trail_t[trail_count[0] - 1] != t:
                    _open(t, x_before, P_before, motion, trail_count, trail_t, trail_marks, trail_x, trail_P,
                          trail_chain, trail_motion)  # fmt: skip
                trail_x[trail_count[0] - 1, AFTER] = state
                trail_P[trail_count[0] - 1, AFTER] = P
            if ints[i, RESET] == LET_GO:
                if recording:
                    chain = trail_chain[trail_count[0]]
                let_go(t_s, state, P, memory[ints[i, SENSOR]], scatter, motion, p, offsets, chain)
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
            if out_deck.shape[1] > 0:
                y, A = deck_output(state, motion, offsets, n)
                out_deck[count] = y
                congruence(A, P, out_deck_covariance[count])
            count += 1
            if recording:
                if trail_t[trail_count[0] - 1] != t:
                    _open(t, state, P, motion, trail_count, trail_t, trail_marks, trail_x, trail_P, trail_chain,
                          trail_motion)  # fmt: skip
                trail_marks[trail_count[0] - 1, EMITS] = 1
        following = i + 1
    x[:] = state
    return count


_kernel = jitted(_advance, [*SOURCES, Path(__file__)])


@dataclass(slots=True)
class CompiledEngine:
    """Processes rows in order in compiled code; same results as ``estimation.filter.FilterPyEngine``."""

    p: Array
    layout: Layout
    state: FilterState
    span: Int
    trail: Trail
    steps: tuple[Array, Array] = field(default_factory=no_steps)

    @classmethod
    def start(cls, p: Array, layout: Layout, state: FilterState) -> CompiledEngine:
        """Return an engine at a state."""
        return cls(p, layout, state, _spans(layout), Trail.off(layout))

    def save(self) -> FilterState:
        """Return a checkpoint."""
        return self.state.copy()

    def load(self, saved: FilterState) -> None:
        """Go back to a checkpoint."""
        self.state = saved.copy()

    def advance(
        self, rows: Rows, start: int, stop: int, out: Estimates, emit_after_ns: int, period_ns: int
    ) -> None:
        """Process the rows start..stop in order; see ``FilterPyEngine.advance``."""
        s, trail = self.state, self.trail
        out.count = _kernel(
            s.clock, s.x, s.P, s.imu, s.scatter, s.memory, s.motion, s.moved, *self.steps, self.p,
            self.layout.offsets, self.span, rows.ints, rows.floats, start, stop, out.t_ns, out.x, out.sigma,
            out.covariance, out.deck, out.deck_covariance, out.count, emit_after_ns, period_ns, trail.count,
            trail.t_ns, trail.marks,
            trail.nominal, trail.covariance, trail.chain, trail.motion,
        )  # fmt: skip

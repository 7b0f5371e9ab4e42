"""Smoothing: the estimate at every instant from all that was measured before and after it.

The fixed-interval smoother of Rauch, Tung and Striebel in error form, for the filter's error state. With the filter's
state x+ after a node (``estimation.trail``), the state x- before the next one and the transition F in between,

    C = P+ F' (P-)^-1,   d = x_s(next) minus x-,   x_s = x+ plus C d,   P_s = P+ - C P- C' + C P_s(next) C',

the covariances carried between the tangent spaces of x-, x+ and x_s by right Jacobians. The recursion needs only that
P is the covariance of the filter's error, whatever its gain was; so it holds for measurements of less weight, for
those that were left out, and for states that were considered and not estimated. A move of the filter onto a sensor
that had been locked out is a transition like any other: what it cut hears nothing from later (``reset_transition``).
Where the filter was aligned anew the interval ends.

Memory does not grow with the flight but for its events and the result: backwards from the end, one piece of a second
after the other is run through the engine again, from the state that was kept before it. Engines being exact, that
gives the forward run's bits, its outcomes included.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from scipy.linalg.blas import dtrsm
from scipy.linalg.lapack import dpotrf

from estimation.deck import deck_output
from estimation.frames import Array
from estimation.models import inverse_right_jacobian, right_jacobian
from estimation.rows import Estimates, FilterState, Rows
from estimation.state import ATTITUDE, PLATFORM_OFFSET, Layout, minus, plus
from estimation.tape import Interval, Tape
from estimation.trail import AFTER, BEFORE, EMITS, RESET_KIND, RESET_SIZE, Trail
from estimation.update import hold_latency, reset_transition

IMU = 0
PIECE_NS = 1_000_000_000
"""Length of what is run through the engine at a time; pieces end at whole multiples of it, so that the result does
not depend on when the events arrived."""
EVER = int(np.iinfo(np.int64).min)


@dataclass(slots=True)
class Smoothed:
    """The smoothed state at one instant: nominal state and covariance of its error."""

    x: Array
    P: Array


def smooth(tape: Tape, layout: Layout, p: Array, period_ns: int) -> Estimates:
    """Return smoothed estimates of all intervals, at the first inertial sample of every period (0: at each).

    ``p`` is the parameter vector. At the end of an interval they equal the filter's.
    """
    parts: list[Estimates] = []
    for interval in tape.intervals:
        backwards = list(_interval(interval, layout, p, period_ns))
        parts.extend(reversed(backwards))
    return Estimates.concatenate(parts, layout)


def backward_step(later: Smoothed, trail: Trail, k: int, layout: Layout, p: Array) -> Smoothed:
    """Return the smoothed state at node ``k`` from the one at the node behind it."""
    n, att = layout.size, int(layout.offsets[ATTITUDE])
    F = trail.chain[k + 1]
    kind = int(trail.marks[k + 1, RESET_KIND])
    if kind:
        F = reset_transition(kind, int(trail.marks[k + 1, RESET_SIZE]), layout.offsets, n) @ F
    before, P_before = trail.nominal[k + 1, BEFORE], trail.covariance[k + 1, BEFORE]
    x, P = trail.nominal[k, AFTER], trail.covariance[k, AFTER]
    d = minus(later.x, before, layout.offsets, n)
    P_later = _turned(later.P, inverse_right_jacobian(d[att : att + 3]), att)
    W, Ct = _gain(P_before, F @ P)
    error = Ct.T @ d
    smoothed = P - W.T @ W + Ct.T @ P_later @ Ct
    smoothed = _turned(smoothed, right_jacobian(error[att : att + 3]), att)
    y = plus(x, error, layout.offsets)
    if layout.offsets[PLATFORM_OFFSET] >= 0:
        hold_latency(y, p)
    return Smoothed(y, 0.5 * (smoothed + smoothed.T))


def _gain(P_before: Array, FP: Array) -> tuple[Array, Array]:
    """Return W with W'W = FP' P_before^-1 FP, and C' = P_before^-1 FP, both (n, n).

    By the Cholesky factor of P_before scaled to a unit diagonal; a state without variance stays as it is. Where the
    matrix is not positive even with 1e-8 on that diagonal, both are zero: nothing is carried back.
    """
    variance = np.diag(P_before)
    known = variance <= 0.0
    scale = np.where(known, 1.0, np.sqrt(np.where(known, 1.0, variance)))
    unit = P_before / (scale[:, None] * scale)
    right = FP / scale[:, None]
    if known.any():
        unit[known, :] = 0.0
        unit[:, known] = 0.0
        unit[known, known] = 1.0
        right[known, :] = 0.0
    jitter = 0.0
    while True:
        factor, failed = dpotrf(unit + jitter * np.eye(len(unit)) if jitter else unit, lower=1)
        if not failed:
            break
        jitter = max(10.0 * jitter, 1e-14)
        if jitter > 1e-8:
            return np.zeros_like(FP), np.zeros_like(FP)
    # Not LAPACK's own triangular solver: on small matrices its threads cost a thousand times what they do.
    W = dtrsm(1.0, factor, right, lower=1)
    Ct = dtrsm(1.0, factor, W, lower=1, trans_a=1)
    return W, Ct / scale[:, None]


def _turned(P: Array, G: Array, att: int) -> Array:
    """Return the covariance with its attitude carried to another tangent space by G (3, 3)."""
    out = P.copy()
    out[att : att + 3, :] = G @ out[att : att + 3, :]
    out[:, att : att + 3] = out[:, att : att + 3] @ G.T
    return out


def _interval(interval: Interval, layout: Layout, p: Array, period_ns: int) -> Iterator[Estimates]:
    """Yield the smoothed estimates of an interval's pieces, from the last to the first."""
    rows = interval.rows()
    if len(rows) == 0:
        return
    engine = interval.engine
    engine_state, engine_trail = engine.save(), engine.trail
    later: Smoothed | None = None
    try:
        for first, last, state in _pieces(interval, rows, layout):
            trail = _run(interval, rows, first, last, state, layout, period_ns)
            later, out = _backwards(later, trail, layout, p)
            yield out
    finally:
        engine.load(engine_state)
        engine.trail = engine_trail


def _pieces(interval: Interval, rows: Rows, layout: Layout) -> Iterator[tuple[int, int, FilterState]]:
    """Yield first and last-but-one row of each piece with the state before it, from the last piece to the first."""
    imu = np.flatnonzero(rows.kind == IMU)
    number = rows.t_ns[imu] // PIECE_NS
    ends = imu[np.append(number[1:] != number[:-1], True)] + 1
    starts = np.concatenate(([0], ends[:-1]))
    engine = interval.engine
    scratch = Estimates.empty(0, layout)
    until = len(starts)
    for at, state in reversed(interval.states):
        # The pieces that begin behind this state and before the next one: run forward once for their states.
        mine = range(int(np.searchsorted(starts, at)), until)
        until = mine.start
        engine.load(state)
        engine.trail = Trail.off(layout)
        states, done = [], at
        for piece in mine:
            if starts[piece] > done:
                engine.advance(rows, done, int(starts[piece]), scratch, np.iinfo(np.int64).max, 0)
                done = int(starts[piece])
            states.append(engine.save())
        for piece in reversed(mine):
            yield int(starts[piece]), int(ends[piece]), states.pop()


def _run(
    interval: Interval, rows: Rows, first: int, last: int, state: FilterState, layout: Layout, period_ns: int
) -> Trail:
    """Return the trail of a piece; its first and last nodes are at the piece's ends."""
    engine = interval.engine
    imu = int(np.count_nonzero(rows.kind[first:last] == IMU))
    engine.load(state)
    trail = Trail.empty(last - first - imu + _periods(rows, first, last, state, period_ns) + 2, layout.size)
    trail.chain[0] = np.eye(layout.size)
    s = engine.state
    trail.open(int(s.clock[0]), s.x, s.P, s.motion)
    engine.trail = trail
    engine.advance(rows, first, last, Estimates.empty(imu, layout), EVER, period_ns)
    s = engine.state
    trail.reach(int(s.clock[0]), s.x, s.P, s.motion)
    return trail


def _periods(rows: Rows, first: int, last: int, state: FilterState, period_ns: int) -> int:
    """Return how many inertial samples of a piece begin a new period."""
    t = rows.t_ns[first:last][rows.kind[first:last] == IMU]
    if period_ns == 0:
        return len(t)
    number = np.append(state.clock[1], t) // period_ns
    return int(np.count_nonzero(number[1:] != number[:-1]))


def _backwards(later: Smoothed | None, trail: Trail, layout: Layout, p: Array) -> tuple[Smoothed, Estimates]:
    """Go through a piece from its end; return the smoothed state at its beginning, and its estimates in order."""
    count = int(trail.count[0])
    emits = np.flatnonzero(trail.marks[:count, EMITS])
    out = Estimates.empty(len(emits), layout)
    out.count = len(emits)
    place = len(emits)
    for k in range(count - 1, -1, -1):
        if later is None:
            later = Smoothed(trail.nominal[k, AFTER].copy(), trail.covariance[k, AFTER].copy())
        elif k < count - 1:
            later = backward_step(later, trail, k, layout, p)
        # Else the piece's last node, which is the first of the piece behind: the same instant.
        if trail.marks[k, EMITS]:
            place -= 1
            _write(out, place, int(trail.t_ns[k]), later, trail.motion[k], layout)
    assert later is not None
    return later, out


def _write(out: Estimates, k: int, t_ns: int, s: Smoothed, motion: Array, layout: Layout) -> None:
    out.t_ns[k] = t_ns
    out.x[k] = s.x
    out.sigma[k] = np.sqrt(np.maximum(np.diag(s.P), 0.0))
    out.covariance[k] = s.P[:9, :9]
    if out.deck.shape[1]:
        out.deck[k], A = deck_output(s.x, motion, layout.offsets, layout.size)
        out.deck_covariance[k] = A @ s.P @ A.T

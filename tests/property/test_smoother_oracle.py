"""The smoother against filterpy's on linear models, where both must give the same numbers."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import parameters as par
from estimation.config import parse_config
from estimation.deck import MOTION_SIZE
from estimation.events import Kind
from estimation.frames import geodetic_to_ned
from estimation.history import Engine
from estimation.parameters import Site, pack_parameters
from estimation.rows import Estimates, FilterState, Rows
from estimation.smoother import Smoothed, backward_step, smooth
from estimation.state import ACCEL_BIAS, GYRO_BIAS, P0, V0, Layout, nominal_zero, plus
from estimation.tape import Tape
from estimation.trail import AFTER, Trail
from estimation.update import MEMORY_SIZE

Array = NDArray[np.float64]
CONFIG = parse_config(
    "[gps]\nbias = false\nposition_sigma_m = 0.01\nheight_sigma_m = 0.01\n[barometer]\nuse = false\n"
)
SITE = Site((0.9, 0.1, 20.0), 0.0)
START_NS = 5_000_000_000


def linear_parameters() -> Array:
    """Parameters that leave of the filter a point mass driven by white acceleration."""
    p = pack_parameters(CONFIG, SITE)
    p[par.GYRO_NOISE] = p[par.GYRO_BIAS_WALK] = p[par.ACCEL_BIAS_WALK] = p[par.VIBRATION_GAIN] = 0.0
    p[par.ACCEL_NOISE] = 0.3
    return p


def start(name: str, p: Array, layout: Layout, state: FilterState) -> Engine:
    if name == "compiled":
        pytest.importorskip("numba", reason="the compiled engine needs numba")
        from estimation.compiled import CompiledEngine

        return CompiledEngine.start(p, layout, state)
    from estimation.filter import FilterPyEngine

    return FilterPyEngine.start(p, layout, state)


def point_mass_flight(p: Array, seconds: float = 3.0) -> Rows:
    """Level and still by the inertial sensor at 50 Hz; fixes at 4 Hz between its samples that wander."""
    rng = np.random.default_rng(4)
    entries = []
    for t in range(20, int(1000 * seconds) + 1, 20):
        entries.append((t * 1_000_000, int(Kind.IMU), [0, 0, 0, 0, 0, -p[par.GRAVITY]], [0.0] * 6))
        if t % 240 == 0:
            place = [0.9 + rng.normal() * 2e-7, 0.1 + rng.normal() * 2e-7, 20.0 + rng.normal(), 1.0, 0.0, 0.0]
            entries.append(
                (t * 1_000_000 + 7_000_000, int(Kind.GPS_POSITION), place, [0.8, 0, 0, 0.9, 0, 2.0])
            )
    entries = entries[: 1 + max(i for i, e in enumerate(entries) if e[1] == int(Kind.IMU))]
    rows = Rows.empty(len(entries))
    for i, (t, kind, value, own) in enumerate(entries):
        rows.t_ns[i], rows.kind[i], rows.sensor[i] = START_NS + t, kind, kind
        rows.value[i], rows.own[i] = value, own
    return rows


@pytest.mark.parametrize("name", ["filterpy", "compiled"])
def test_a_point_mass_is_smoothed_as_by_filterpy(name: str) -> None:
    from filterpy.kalman import KalmanFilter, rts_smoother

    p, layout = linear_parameters(), Layout.of(CONFIG)
    n = layout.size
    P = np.zeros((n, n))
    P[:6, :6] = np.diag([4.0, 4.0, 9.0, 1.0, 1.0, 1.0])
    imu = np.array([0, 0, 0, 0, 0, -p[par.GRAVITY]])
    clock = np.full(3, START_NS)
    state = FilterState(
        clock,
        nominal_zero(),
        P.copy(),
        imu,
        np.zeros(3),
        np.zeros((64, MEMORY_SIZE)),
        np.zeros(MOTION_SIZE),
        np.zeros(6),
    )
    rows = point_mass_flight(p)
    engine = start(name, p, layout, state)
    tape = Tape()
    tape.begin(engine)
    engine.advance(rows, 0, len(rows), Estimates.empty(len(rows), layout), START_NS, 0)
    tape.keep(rows, None)
    ours = smooth(tape, layout, p, 0)

    oracle = KalmanFilter(dim_x=6, dim_z=3)
    oracle.x, oracle.P, oracle.H = np.zeros(6), P[:6, :6].copy(), np.eye(3, 6)
    oracle.R = np.diag([0.8, 0.9, 2.0])
    xs, Ps, Fs, Qs = [], [], [], []
    last = START_NS
    for i in range(len(rows)):
        dt = (int(rows.t_ns[i]) - last) * 1e-9
        last = int(rows.t_ns[i])
        F = np.eye(6)
        F[:3, 3:] = dt * np.eye(3)
        Q = p[par.ACCEL_NOISE] ** 2 * np.kron([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]], np.eye(3))
        oracle.predict(F=F, Q=Q)
        if rows.kind[i] == int(Kind.GPS_POSITION):
            oracle.update(geodetic_to_ned(*rows.value[i, :3], p[par.ORIGIN : par.ORIGIN + 3]))
        xs.append(oracle.x.copy())
        Ps.append(oracle.P.copy())
        Fs.append(F)
        Qs.append(Q)
    # The function takes the transition and noise that lead away from a step.
    x, smoothed, _, _ = rts_smoother(np.array(xs), np.array(Ps), Fs[1:] + Fs[:1], Qs[1:] + Qs[:1])
    emitted = rows.kind == int(Kind.IMU)
    assert np.array_equal(ours.t_ns, rows.t_ns[emitted])
    assert np.abs(np.hstack([ours.x[:, P0 : P0 + 3], ours.x[:, V0 : V0 + 3]]) - x[emitted]).max() < 1e-9
    assert np.abs(ours.covariance[:, :6, :6] - smoothed[emitted]).max() < 1e-9
    filtered = np.array(Ps)[emitted]
    assert np.trace(smoothed[emitted][20]) < 0.5 * np.trace(filtered[20]), (
        "smoothing must have done something"
    )


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 2**32 - 1))
def test_steps_back_are_filterpys_for_any_linear_model(seed: int) -> None:
    """Transitions that couple everything, a rotation included: about one axis, where rotations are numbers."""
    from filterpy.kalman import rts_smoother

    rng = np.random.default_rng(seed)
    layout = Layout.with_blocks([GYRO_BIAS, ACCEL_BIAS])
    n, m = layout.size, 5
    free = np.delete(np.arange(n), [6, 7])
    # Some tenths of a radian of the eighth entry, against metres of the others.
    scale = np.where(free == 8, 0.05, 1.0)
    k = len(free)

    def widened(small: Array) -> Array:
        out = np.zeros((n, n))
        out[np.ix_(free, free)] = scale[:, None] * small * scale
        return out

    def nominal(x: Array) -> Array:
        error = np.zeros(n)
        error[free] = scale * x
        return plus(nominal_zero(), error, layout.offsets)

    trail = Trail.empty(m, n)
    xs, Ps, Fs, Qs = np.zeros((m, k)), np.zeros((m, k, k)), np.zeros((m, k, k)), np.zeros((m, k, k))
    x, P = rng.normal(size=k), _covariance(rng, k)
    for i in range(m):
        Fs[i], Qs[i] = np.eye(k) + 0.1 * rng.normal(size=(k, k)), 0.1 * _covariance(rng, k)
        x, P = Fs[i] @ x, Fs[i] @ P @ Fs[i].T + Qs[i]
        trail.open(i, nominal(x), widened(P), np.zeros(MOTION_SIZE))
        trail.chain[i] = np.eye(n)
        trail.chain[i][np.ix_(free, free)] = scale[:, None] * Fs[i] / scale
        H = rng.normal(size=(3, k))
        K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.eye(3))
        x = x + K @ rng.normal(size=3)
        P = (np.eye(k) - K @ H) @ P @ (np.eye(k) - K @ H).T + K @ K.T
        trail.close(nominal(x), widened(P))
        xs[i], Ps[i] = x, P
    want_x, want_P, _, _ = rts_smoother(xs, Ps, np.roll(Fs, -1, axis=0), np.roll(Qs, -1, axis=0))
    later = Smoothed(trail.nominal[m - 1, AFTER], trail.covariance[m - 1, AFTER])
    for i in range(m - 2, -1, -1):
        later = backward_step(later, trail, i, layout, linear_parameters())
        assert np.abs(later.x - nominal(want_x[i])).max() < 1e-9
        assert np.abs(later.P - widened(want_P[i])).max() < 1e-9
        assert np.array_equal(later.P, later.P.T)
        assert np.linalg.eigvalsh(later.P[np.ix_(free, free)]).min() > 0.0


def _covariance(rng: np.random.Generator, n: int) -> Array:
    A = rng.normal(size=(n, n))
    return np.asarray(A @ A.T / n + 0.1 * np.eye(n))

"""Every Jacobian of the models against finite differences on the state's manifold."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from estimation import models
from estimation import parameters as par
from estimation.config import parse_config
from estimation.consistency import check_jacobian
from estimation.deck import deck_output, no_steps
from estimation.frames import (
    R_CB_NOMINAL,
    Array,
    ned_to_geodetic,
    quat_exp,
    quat_multiply,
    quat_to_matrix,
)
from estimation.parameters import Site, pack_parameters
from estimation.state import (
    ATTITUDE,
    BA0,
    BB0,
    BG0,
    BP0,
    GPS_BIAS,
    GYRO_BIAS,
    NOMINAL_SIZE,
    P0,
    PH0,
    PL0,
    PLATFORM_HEAVE,
    PLATFORM_OFFSET,
    PLATFORM_SWAY,
    PO0,
    POSITION,
    PS0,
    Q0,
    V0,
    VELOCITY,
    Layout,
    minus,
    plus,
)

SITE = Site((1.1, 0.18, 20.0), 0.09)
CONFIG = parse_config(
    """
[gps]
lever_arm_m = [0.2, -0.1, -0.3]
[attitude]
use = "fuse"
[rangefinder]
use = true
lever_arm_m = [0.05, 0.1, 0.15]
surface_height_m = 0.7
[platform]
use = true
"""
)
LAYOUT = Layout.of(CONFIG)
P = pack_parameters(CONFIG, SITE)
NO_COVARIANCE = np.full(6, np.nan)
MOTION = np.array(
    [
        0.4,
        0.9,
        1.3,
        1.1,
        0.3,
        0.4,
        0.5,
        0.3,
        0.8,
        1.2,
        1.4,
        0.2,
        0.3,
        0.4,
        0.2,
        0.7,
        1.0,
        1.6,
        0.3,
        0.5,
        0.6,
        0.05,
    ]
)
"""Gain, three angular frequencies and three dampings of a heaving deck."""

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)


def state(position: Array, velocity: Array, rotation: Array, biases: Array, level: bool = False) -> Array:
    x = np.zeros(NOMINAL_SIZE)
    x[P0 : P0 + 3] = 30.0 * position - [0.0, 0.0, 40.0]
    x[V0 : V0 + 3] = 8.0 * velocity
    turn = quat_exp(rotation * (np.array([0.5, 0.5, 1.6]) if level else np.full(3, 1.7)))
    x[Q0 : Q0 + 4] = turn
    x[BG0 : BG0 + 3] = 0.01 * biases
    x[BA0 : BA0 + 3] = 0.1 * biases[::-1]
    x[BP0 : BP0 + 3] = biases
    x[BB0] = biases[0]
    x[PO0 : PO0 + 2] = 2.0 * position[:2]
    x[PS0 : PS0 + 12] = 0.3 * np.concatenate([velocity, biases, position, velocity])
    x[PL0] = 0.5 * biases[1]
    x[PH0 : PH0 + 6] = 0.4 * np.concatenate([position, velocity])
    return x


states = st.builds(state, vectors, vectors, vectors, vectors)
upright_states = st.builds(state, vectors, vectors, vectors, vectors, st.just(True))


@settings(max_examples=40, deadline=None)
@given(states, vectors, vectors, st.floats(0.001, 0.025))
def test_transition(x: Array, rate: Array, force: Array, dt: float) -> None:
    n = LAYOUT.size
    gyro, accel, scatter = 3.0 * rate, 15.0 * force, np.zeros(2)
    F, Q, unused = np.empty((n, n)), np.empty((n, n)), np.empty((n, n))

    def step(start: Array, F: Array = unused, Q: Array = unused) -> Array:
        return models.transition(
            start, gyro, accel, dt, scatter, P, LAYOUT.offsets, F, Q, MOTION, *no_steps()
        )

    end = step(x, F, Q)
    numeric = np.empty((n, n))
    h = 1e-4
    for j in range(n):
        error = np.zeros(n)
        error[j] = h
        ahead = minus(step(plus(x, error, LAYOUT.offsets)), end, LAYOUT.offsets, n)
        behind = minus(step(plus(x, -error, LAYOUT.offsets)), end, LAYOUT.offsets, n)
        numeric[:, j] = (ahead - behind) / (2.0 * h)
    np.testing.assert_allclose(F, numeric, atol=2e-8)
    names = LAYOUT.offsets
    for block in (POSITION, VELOCITY, ATTITUDE, GYRO_BIAS, GPS_BIAS, PLATFORM_SWAY, PLATFORM_HEAVE):
        assert np.any(F[:, names[block]] != 0.0)


@settings(max_examples=40, deadline=None)
@given(states, st.floats(0.002, 0.025))
def test_process_noise_composes(x: Array, dt: float) -> None:
    """Two halves of a step without motion add as much noise as the whole: noise is a rate, not a step's."""
    n = LAYOUT.size
    x = x.copy()
    x[Q0 : Q0 + 4] = [1.0, 0.0, 0.0, 0.0]
    x[BG0 : BG0 + 6] = 0.0
    still, scatter = np.zeros(3), np.array([1e-5, 1e-7])
    parts = []
    for step in (dt, 0.5 * dt):
        F, Q = np.empty((n, n)), np.empty((n, n))
        models.transition(x, still, still, step, scatter, P, LAYOUT.offsets, F, Q, MOTION, *no_steps())
        parts.append((F, Q))
    (_, whole), (F, half) = parts
    sum_of_halves = F @ half @ F.T + half
    np.testing.assert_allclose(sum_of_halves[:9, :9], whole[:9, :9], rtol=2e-6, atol=1e-15)
    vehicle = LAYOUT.offsets[PLATFORM_OFFSET]
    np.testing.assert_allclose(np.diag(sum_of_halves)[:vehicle], np.diag(whole)[:vehicle], rtol=2e-6)
    # The deck's oscillators are discretised by Simpson's rule.
    np.testing.assert_allclose(sum_of_halves[vehicle:, vehicle:], whole[vehicle:, vehicle:], atol=1e-9)
    assert np.linalg.eigvalsh(whole).min() >= -1e-18


def measured(kind: int, value: Array, gyro: Array, x: Array) -> None:
    """Check the Jacobian of a kind of measurement at a value and a state."""

    def model(value: Array, nominal: Array, layout: Layout) -> tuple[Array, Array, Array]:
        r, H, R = np.zeros(3), np.zeros((3, layout.size)), np.zeros((3, 3))
        m = models.measure(kind, value, NO_COVARIANCE, nominal, gyro, P, layout.offsets, r, H, R)
        assert m > 0
        return r[:m].copy(), H[:m].copy(), R[:m, :m].copy()

    check = check_jacobian(model, value, x, LAYOUT, tolerance=2e-6)
    assert check.correct, str(check)
    assert np.any(check.analytic != 0.0)
    R = model(value, x, LAYOUT)[2]
    np.testing.assert_allclose(R, R.T, atol=1e-18)
    assert np.linalg.eigvalsh(R).min() > 0.0


def six(*values: float) -> Array:
    return np.array([*values, *[np.nan] * (6 - len(values))])


@settings(max_examples=25, deadline=None)
@given(states, vectors, vectors)
def test_gps_position(x: Array, gyro: Array, off: Array) -> None:
    place = ned_to_geodetic(x[P0 : P0 + 3] + off, np.array(SITE.origin))
    measured(models.GPS_POSITION, six(*place, 1.0), gyro, x)


@settings(max_examples=25, deadline=None)
@given(states, vectors, vectors, st.booleans())
def test_gps_velocity(x: Array, gyro: Array, off: Array, vertical: bool) -> None:
    v = x[V0 : V0 + 3] + off
    measured(models.GPS_VELOCITY, six(v[0], v[1], v[2] if vertical else np.nan, 1.0), 3.0 * gyro, x)


@settings(max_examples=25, deadline=None)
@given(states, vectors, st.floats(90_000.0, 103_000.0))
def test_barometer(x: Array, gyro: Array, pressure: float) -> None:
    measured(models.BAROMETER, six(pressure, 288.0), gyro, x)


@settings(max_examples=25, deadline=None)
@given(states, vectors, st.floats(-1.3, 1.3))
def test_magnetometer(x: Array, gyro: Array, dip: float) -> None:
    """At the field that the state predicts: there the Jacobian must be exact."""
    heading = SITE.declination_rad
    field = 5e-5 * np.array([np.cos(dip) * np.cos(heading), np.cos(dip) * np.sin(heading), np.sin(dip)])
    measured(models.MAGNETOMETER, six(*(quat_to_matrix(x[Q0 : Q0 + 4]).T @ field)), gyro, x)


@settings(max_examples=25, deadline=None)
@given(states, vectors, vectors)
def test_attitude(x: Array, gyro: Array, off: Array) -> None:
    q = quat_multiply(x[Q0 : Q0 + 4], quat_exp(0.8 * off))
    measured(models.ATTITUDE_FIX, six(*q), gyro, x)


@settings(max_examples=25, deadline=None)
@given(upright_states, vectors, st.floats(1.0, 50.0))
def test_rangefinder(x: Array, gyro: Array, distance: float) -> None:
    measured(models.RANGE, six(distance, 0.1, 60.0), gyro, x)


def test_magnetometer_noise_does_not_reach_the_tilt() -> None:
    """The Jacobian must not follow the heading noise of the very field that it weighs: with a steep field
    that correlation would push the tilt, always to the same side.
    """
    x = state(np.zeros(3), np.zeros(3), np.zeros(3), np.zeros(3))
    att = LAYOUT.offsets[ATTITUDE]
    tilts = []
    for noise in (-0.1, 0.1):
        heading = SITE.declination_rad + noise
        field = np.array([0.3 * np.cos(heading), 0.3 * np.sin(heading), 0.95])
        r, H, R = np.zeros(3), np.zeros((3, LAYOUT.size)), np.zeros((3, 3))
        none = np.zeros(3)
        models.measure(models.MAGNETOMETER, six(*field), NO_COVARIANCE, x, none, P, LAYOUT.offsets, r, H, R)
        assert r[0] == pytest.approx(-noise)
        tilts.append(H[0, att : att + 2].copy())
    np.testing.assert_allclose(tilts[0], tilts[1], atol=1e-12)


@settings(max_examples=25, deadline=None)
@given(states, vectors, vectors)
def test_vision(x: Array, gyro: Array, off: Array) -> None:
    """With no mount error and no age: about these the Jacobian is made."""
    there = np.array([x[PO0] + x[PS0 + 5], x[PO0 + 1] + x[PS0 + 11], -x[PL0] - x[PH0 + 5]]) - x[P0 : P0 + 3]
    seen = R_CB_NOMINAL @ (quat_to_matrix(x[Q0 : Q0 + 4]).T @ there)
    measured(models.VISION, six(*(seen + off)), 3.0 * gyro, x)


@settings(max_examples=10, deadline=None)
@given(states)
def test_what_is_said_of_the_deck(x: Array) -> None:
    y, A = deck_output(x, MOTION, LAYOUT.offsets, LAYOUT.size)
    h = 1e-4
    for j in range(LAYOUT.size):
        error = np.zeros(LAYOUT.size)
        error[j] = h
        moved = deck_output(plus(x, error, LAYOUT.offsets), MOTION, LAYOUT.offsets, LAYOUT.size)[0]
        np.testing.assert_allclose(A[:, j], (moved - y) / h, atol=1e-8)


def test_right_jacobian_is_the_derivative_of_exp() -> None:
    rng = np.random.default_rng(5)
    for size in (0.0, 1e-5, 1e-3, 1.5, 3.0):
        v = rng.standard_normal(3)
        v *= size / np.linalg.norm(v)
        h = 1e-6
        base = np.zeros(NOMINAL_SIZE)
        base[Q0 : Q0 + 4] = quat_exp(v)
        numeric = np.empty((3, 3))
        for j, e in enumerate(np.eye(3) * h):
            moved = [base.copy(), base.copy()]
            moved[0][Q0 : Q0 + 4], moved[1][Q0 : Q0 + 4] = quat_exp(v + e), quat_exp(v - e)
            a, b = (minus(m, base, LAYOUT.offsets, LAYOUT.size)[6:9] for m in moved)
            numeric[:, j] = (a - b) / (2.0 * h)
        np.testing.assert_allclose(models.right_jacobian(v), numeric, atol=1e-8)
        if size > 0.0:
            np.testing.assert_allclose(
                models.inverse_right_jacobian(v) @ models.right_jacobian(v), np.eye(3), atol=1e-12
            )


def test_a_wrong_jacobian_is_named() -> None:
    def model(value: Array, nominal: Array, layout: Layout) -> tuple[Array, Array, Array]:
        H = np.zeros((1, layout.size))
        H[0, layout.offsets[POSITION] + 2] = 1.0  # of height: its sign is wrong
        return np.array([value[0] + nominal[P0 + 2]]), H, np.eye(1)

    check = check_jacobian(model, np.zeros(6), state(*np.zeros((4, 3))), LAYOUT)
    assert not check.correct
    assert check.name == "position.d"
    assert "position.d" in str(check)
    assert "-1" in str(check)


def test_a_model_of_wrong_shape_is_refused() -> None:
    def model(value: Array, nominal: Array, layout: Layout) -> tuple[Array, Array, Array]:
        return np.zeros(2), np.zeros((1, layout.size)), np.eye(2)

    with pytest.raises(ValueError, match="shapes"):
        check_jacobian(model, np.zeros(6), state(*np.zeros((4, 3))), LAYOUT)


def test_gravity_is_that_of_the_site() -> None:
    assert P[par.GRAVITY] == pytest.approx(9.8219, abs=2e-3)

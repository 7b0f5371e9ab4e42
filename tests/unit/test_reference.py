"""Comparison with references: interpolation, errors, consistency, contact and ratios."""

from __future__ import annotations

import numpy as np
import pytest

from deckfix.reference import (
    Column,
    Trajectory,
    column,
    compare,
    contact_time_ns,
    euler_sigmas,
    nees,
    quaternion_column,
    ratio_block,
    rmse_block,
    rotation_vector_columns,
    window,
)
from estimation.frames import euler_to_quat, quat_exp, quat_multiply, quat_to_euler

S = 1_000_000_000


def seconds(values: object) -> np.ndarray:
    return (np.asarray(values, dtype=np.float64) * 1e9).astype(np.int64)


def test_a_column_is_interpolated_inside_and_nowhere_else() -> None:
    c = Column(seconds([0, 0.1, 0.2, 1.0, 1.1]), np.array([[0.0], [1.0], [2.0], [3.0], [4.0]]))
    got = c.at(seconds([-0.01, 0.0, 0.05, 0.2, 0.6, 1.05, 1.1, 1.2]))[:, 0]
    assert np.allclose(got[[1, 2, 3, 5, 6]], [0.0, 0.5, 2.0, 3.5, 4.0])
    assert np.isnan(got[[0, 4, 7]]).all()


def test_rows_that_are_not_finite_or_repeated_are_left_out() -> None:
    c = column(seconds([2, 1, 1, 3]), np.array([[2.0], [0.0], [1.0], [np.nan]]))
    assert c is not None
    assert c.t_ns.tolist() == seconds([1, 2]).tolist()
    assert c.values[:, 0].tolist() == [1.0, 2.0]
    assert column(seconds([1]), np.ones((1, 3))) is None


def test_quaternions_lose_their_jumps_of_sign_and_their_unknown_rows() -> None:
    q = np.array([euler_to_quat(0.1, 0.2, yaw) for yaw in np.linspace(0, 7, 50)])
    signs = np.where(np.arange(50) % 3 == 0, -1.0, 1.0)
    q *= signs[:, None]
    q[10] = 0.0
    c = quaternion_column(seconds(np.arange(50) * 0.1), q)
    assert c is not None
    assert len(c.t_ns) == 49
    assert (np.sum(c.values[1:] * c.values[:-1], axis=1) > 0.9).all()


def test_rotation_vectors_undo_the_exponential() -> None:
    rng = np.random.default_rng(3)
    a = np.array([euler_to_quat(*rng.uniform(-1, 1, 3)) for _ in range(20)])
    v = rng.normal(size=(20, 3)) * 0.4
    b = np.array([quat_multiply(q, quat_exp(r)) for q, r in zip(a, v, strict=True)])
    assert np.allclose(rotation_vector_columns(a, -b), v, atol=1e-12)


def test_euler_sigmas_agree_with_finite_differences() -> None:
    q = euler_to_quat(0.3, -0.5, 2.0)
    p = np.diag([1e-4, 4e-4, 9e-4])
    h = 1e-6
    jacobian = np.empty((3, 3))
    for i in range(3):
        step = np.zeros(3)
        step[i] = h
        up, down = (quat_to_euler(quat_multiply(q, quat_exp(s * step))) for s in (1.0, -1.0))
        jacobian[:, i] = (up - down) / (2 * h)
    expected = np.sqrt(np.diag(jacobian @ p @ jacobian.T))
    assert np.allclose(euler_sigmas(q[None], p[None])[0], expected, rtol=1e-6)


def test_nees_of_known_parts_only() -> None:
    rng = np.random.default_rng(1)
    a = rng.normal(size=(9, 9))
    p = a @ a.T + 9 * np.eye(9)
    e = rng.normal(size=(1, 9))
    values, dof = nees(e, p[None])
    assert dof == 9
    assert values[0] == pytest.approx(float(e[0] @ np.linalg.solve(p, e[0])))
    e[:, 3:6] = np.nan
    values, dof = nees(e, p[None])
    known = [0, 1, 2, 6, 7, 8]
    assert dof == 6
    assert values[0] == pytest.approx(
        float(e[0, known] @ np.linalg.solve(p[np.ix_(known, known)], e[0, known]))
    )


def test_a_singular_covariance_does_not_raise() -> None:
    values, dof = nees(np.ones((2, 9)), np.zeros((2, 9, 9)))
    assert dof == 9
    assert len(values) == 2


def descent(touchdown_s: float, speed: float, deck: float = 0.0) -> Trajectory:
    """Return a climb to 10 m and a descent that a deck of amplitude ``deck`` ends, moving on with it."""
    t = np.arange(0, 80, 0.04)
    up = np.interp(t, [0, 5, 15, 40, touchdown_s - 10, touchdown_s], [0, 0, 10, 10, 10 * speed, 0])
    up = np.where(
        t > touchdown_s - 5, up, np.convolve(np.pad(up, 25, mode="edge"), np.ones(51) / 51, "valid")
    )
    sea = deck * np.sin(2 * np.pi * (t - touchdown_s) / 7)
    up = np.where(t >= touchdown_s, sea, up)
    velocity = np.zeros((len(t), 3))
    velocity[:, 2] = -np.gradient(up, t)
    position = np.zeros((len(t), 3))
    position[:, 2] = -up
    return Trajectory(Column(seconds(t), position), Column(seconds(t), velocity), None)


@pytest.mark.parametrize(("speed", "deck"), [(0.5, 0.0), (0.7, 0.6), (0.8, -0.6)])
def test_contact_is_where_the_descent_is_arrested(speed: float, deck: float) -> None:
    contact = contact_time_ns(descent(62.0, speed, deck))
    assert contact is not None
    assert contact * 1e-9 == pytest.approx(62.0, abs=0.1)


def test_a_feathers_contact_is_where_the_height_stays_small() -> None:
    contact = contact_time_ns(descent(60.0, 0.15))
    assert contact is not None
    assert contact * 1e-9 == pytest.approx(60.0 - 0.12 / 0.15, abs=0.1)


def test_without_take_off_or_landing_there_is_no_contact() -> None:
    landed = descent(62.0, 0.5)
    assert landed.position_m is not None
    still = Trajectory(Column(landed.position_m.t_ns, landed.position_m.values * 0.0), None, None)
    assert contact_time_ns(still) is None
    airborne = landed.position_m.t_ns < 50 * S
    cut = Trajectory(Column(landed.position_m.t_ns[airborne], landed.position_m.values[airborne]), None, None)
    assert contact_time_ns(cut) is None
    assert contact_time_ns(Trajectory(None, None, None)) is None


def test_the_window_is_as_designed_and_never_too_short() -> None:
    usual = window(5 * S, 100 * S, 90 * S)
    assert (usual.start_ns, usual.end_ns) == (15 * S, 90 * S - S // 2)
    assert (window(0, 60 * S, None).end_ns) == 60 * S
    short = window(0, 12 * S, None)
    assert (short.start_ns, short.end_ns) == (0, 12 * S)


def test_errors_are_less_their_datum_and_angles_wrap() -> None:
    t = seconds(np.arange(0, 30, 0.1))
    n = len(t)
    truth_q = np.array([euler_to_quat(0, 0, np.pi - 0.01)] * n)
    own_q = np.array([euler_to_quat(0, 0, -np.pi + 0.01)] * n)
    zero = np.zeros((n, 3))
    truth = Trajectory(Column(t, zero), Column(t, zero), Column(t, truth_q))
    own = zero + np.array([5.0, -3.0, 100.0])
    got = compare(t, own, zero + 0.1, own_q, truth, window(0, 30 * S, None))
    assert got.datum_m.tolist() == [5.0, -3.0, 100.0]
    assert np.abs(got.position_m).max() == 0.0
    assert np.allclose(got.velocity_mps, 0.1)
    assert np.allclose(got.attitude_rad[:, 2], 0.02)
    block = rmse_block(got, window(0, 30 * S, None))
    assert block["attitude_rmse_deg"][2] == pytest.approx(np.rad2deg(0.02))  # type: ignore[index]
    assert "nees_over_dof" not in block


def test_the_ratio_compares_the_same_rows() -> None:
    t = seconds(np.arange(0, 30, 0.1))
    rng = np.random.default_rng(5)
    noise = rng.normal(size=(len(t), 3))
    zero = np.zeros_like(noise)
    truth = Trajectory(Column(t, zero), Column(t, zero), None)
    q = np.tile([1.0, 0, 0, 0], (len(t), 1))
    whole = window(0, 30 * S, None)
    theirs = compare(t, noise, noise, q, truth, whole)
    half = noise * 0.5
    half[50:60] = np.nan
    ours = compare(t, half, half, q, truth, whole)
    ratios = ratio_block(ours, theirs, whole)
    assert set(ratios) == {"horizontal_position", "height", "horizontal_velocity", "vertical_velocity"}
    assert ratios["vertical_velocity"] == pytest.approx(0.5, rel=1e-9)
    assert ratios["height"] == pytest.approx(0.5, rel=0.01)
    with pytest.raises(ValueError, match="different times"):
        ratio_block(ours, compare(t[1:], noise[1:], noise[1:], q[1:], truth, whole), whole)

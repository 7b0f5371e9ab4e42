"""The simulated truth: its derivatives fit each other, and integrating its inertial quantities gives its
path.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
import pytest

from estimation.frames import quat_exp, quat_multiply, quat_to_matrix
from simulation.platform import Platform, Raft
from simulation.sea import Sea, beaufort
from simulation.trajectory import PHASES, Plan, Rock, Trajectory, Wind

GRAVITY = 9.81


@pytest.fixture(scope="module")
def trajectory() -> Trajectory:
    rng = np.random.default_rng(3)
    platform = Platform.draw(Raft(), Sea.draw(beaufort(3, 0.4), rng), rng)
    return Trajectory(Plan(), Wind.draw(5.0, 0.8, 0.4, rng), platform, GRAVITY)


def test_derivatives_fit_each_other(trajectory: Trajectory) -> None:
    h = 1e-4
    t = np.linspace(0.1, trajectory.plan.duration_s - 0.1, 700)
    before, at, after = (trajectory.motion(t + d) for d in (-h, 0.0, h))
    for rate, value in (("velocity_mps", "position_m"), ("acceleration_mps2", "velocity_mps")):
        slope = (getattr(after, value) - getattr(before, value)) / (2.0 * h)
        np.testing.assert_allclose(getattr(at, rate), slope, atol=2e-6)
    turned = np.einsum("nij,nik->njk", before.R_nb, after.R_nb)
    turned = 0.5 * (turned - turned.transpose(0, 2, 1))
    rates = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1) / (2.0 * h)
    np.testing.assert_allclose(at.angular_velocity_radps, rates, atol=2e-6)


def test_inertial_quantities_integrate_to_the_path(trajectory: Trajectory) -> None:
    """Fourth-order integration (Magnus with two Gauss points, Simpson) over the whole flight: below a
    millimetre.
    """
    dt = 0.01
    n = int(trajectory.plan.duration_s / dt)
    t = np.arange(n, dtype=np.float64) * dt
    g1, g2 = (
        trajectory.motion(t + dt * c).angular_velocity_radps for c in (0.5 - 3**0.5 / 6, 0.5 + 3**0.5 / 6)
    )
    turn = 0.5 * dt * (g1 + g2) + 3**0.5 / 12 * dt**2 * np.cross(g1, g2)
    ends = trajectory.motion(np.arange(n + 1, dtype=np.float64) * dt)
    middle = trajectory.motion(t + 0.5 * dt)
    q = ends.quaternion[0]
    p, v = ends.position_m[0].copy(), ends.velocity_mps[0].copy()
    down = np.array([0.0, 0.0, GRAVITY])
    a0 = quat_to_matrix(q) @ ends.specific_force_mps2[0] + down
    for k in range(n):
        q_next = quat_multiply(q, quat_exp(turn[k]))
        a1 = quat_to_matrix(q_next) @ ends.specific_force_mps2[k + 1] + down
        am = middle.R_nb[k] @ middle.specific_force_mps2[k] + down
        p = p + v * dt + dt**2 * (a0 + 2.0 * am) / 6.0
        v = v + dt * (a0 + 4.0 * am + a1) / 6.0
        q, a0 = q_next, a1
    np.testing.assert_allclose(quat_to_matrix(q), ends.R_nb[-1], atol=1e-6)
    np.testing.assert_allclose(v, ends.velocity_mps[-1], atol=1e-5)
    np.testing.assert_allclose(p, ends.position_m[-1], atol=1e-3)


def test_vehicle_rests_flies_and_rides(trajectory: Trajectory) -> None:
    plan = trajectory.plan
    rest = trajectory.motion(np.linspace(0.0, plan.rest_s, 50))
    np.testing.assert_allclose(rest.velocity_mps, 0.0, atol=1e-12)
    np.testing.assert_allclose(rest.specific_force_mps2, np.tile([0.0, 0.0, -GRAVITY], (50, 1)), atol=1e-12)
    t = np.linspace(plan.touchdown_s, plan.duration_s, 50)
    deck, vehicle = trajectory.platform.motion(t), trajectory.motion(t)
    above = deck.position[0] - vehicle.position_m
    np.testing.assert_allclose(above, np.tile([0.0, 0.0, plan.gear_m], (50, 1)), atol=1e-9)
    np.testing.assert_allclose(vehicle.velocity_mps, deck.position[1], atol=1e-9)
    aloft = trajectory.motion(np.linspace(plan.bounds_s["climb"][1], plan.bounds_s["descent"][0], 500))
    assert np.all(aloft.position_m[:, 2] < -13.0)
    tilt = np.degrees(np.arccos(aloft.R_nb[:, 2, 2]))
    assert 3.0 < tilt.max() < 40.0


def test_phases_cover_the_flight(trajectory: Trajectory) -> None:
    t = np.linspace(0.0, trajectory.plan.duration_s, 500)
    phase = trajectory.phase(t)
    assert set(phase) == set(range(len(PHASES)))
    assert np.all(np.diff(phase) >= 0)


def test_plan_refuses_what_does_not_fit() -> None:
    with pytest.raises(ValueError, match=r"plan\.hover_s"):
        Plan(hover_s=0.0)
    with pytest.raises(ValueError, match="3"):
        Plan(yaw_rad=(0.0,))


@pytest.mark.parametrize("path", ["circle", "to and fro"])
def test_rocking_tilts_as_far_as_is_asked_and_its_jet_is_consistent(
    path: Literal["circle", "to and fro"],
) -> None:
    rock = Rock(start_s=2.0, duration_s=20.0, tilt_deg=6.0, period_s=1.2, path=path)
    t, h = np.linspace(0.0, 24.0, 4801), 1e-4
    jet = rock.motion(t, GRAVITY)
    slope = (rock.motion(t + h, GRAVITY) - rock.motion(t - h, GRAVITY)) / (2.0 * h)
    np.testing.assert_allclose(jet[1:4], slope[0:3], atol=1e-4)
    assert not jet[:, (t < 2.0) | (t > 22.0)].any() and not jet[:, :, 2].any()
    tilt = np.degrees(np.arctan(np.linalg.norm(jet[2], axis=1) / GRAVITY))
    assert tilt[(t > 3.5) & (t < 10.5)].max() == pytest.approx(6.0, rel=0.01)
    early, late = (t > 3.5) & (t < 10.5), (t > 13.5) & (t < 20.5)
    moved = [[float(np.ptp(jet[0, part, axis])) for axis in range(2)] for part in (early, late)]
    if path == "circle":
        assert np.allclose(moved, moved[0][0], rtol=0.01)
    else:
        assert moved[0][1] == moved[1][0] == 0.0
        assert moved[0][0] == pytest.approx(moved[1][1], rel=0.01) and moved[0][0] > 0.05

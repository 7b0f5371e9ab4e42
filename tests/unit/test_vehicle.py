"""The simulated multirotor: it hovers, follows its set-points, keeps its bounds, and meets the deck as physics says."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.frames import quat_to_matrix
from simulation.vehicle import (
    CLIMB,
    EST_QUAT,
    LOADED,
    OWN_SIZE,
    QUAT,
    SET_MOTORS,
    SET_SIZE,
    SET_TILT,
    SET_VEL,
    STATE_SIZE,
    STEP_HZ,
    Airframe,
    advance,
    compiled,
    pack,
)
from simulation.wind import Turbulence

Array = NDArray[np.float64]
G = 9.82


class Bench:
    """A vehicle over a deck, with an autopilot that knows its state."""

    def __init__(self, height: float = 5.0, plain: bool = False) -> None:
        self.p = pack(Airframe(), G, 2.4)
        self.x, self.own, self.setpoint = np.zeros(STATE_SIZE), np.zeros(OWN_SIZE), np.zeros(SET_SIZE)
        self.x[2], self.x[QUAT], self.x[13] = -height, 1.0, G
        self.own[EST_QUAT] = 1.0
        self.setpoint[SET_TILT], self.setpoint[SET_MOTORS] = 0.3, 1.0
        self.deck = np.zeros((8, 12))
        self.deck[:, 8] = 1.0
        self.contact = np.full(4, -1.0)
        self.run = advance if plain else compiled()

    def fly(self, seconds: float, wind: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Array:
        rows = []
        for _ in range(round(seconds * STEP_HZ / 8)):
            truth, trail = np.zeros((8, 16)), np.zeros((8, 7))
            self.run(
                self.x, self.own, self.setpoint, np.array(wind), self.deck, False, self.p, truth, trail, self.contact
            )  # fmt: skip
            rows.append(truth)
        return np.concatenate(rows)


def test_a_vertical_velocity_is_led_up_to_with_bounded_acceleration() -> None:
    bench = Bench()
    bench.p[CLIMB] = 1.0
    bench.setpoint[SET_VEL + 2] = -2.0
    rates = bench.fly(4.0)[:, 5]
    half = np.flatnonzero(rates < -1.0)[0] / STEP_HZ
    assert half == pytest.approx(1.1, abs=0.1)
    assert np.abs(np.diff(rates)).max() * STEP_HZ < 1.5
    assert rates[-1] == pytest.approx(-2.0, abs=0.05)


def test_it_hovers_in_wind_and_follows_velocities() -> None:
    bench = Bench()
    bench.fly(12.0, (4.0, 0.0, 0.0))
    assert bench.x[3:6] == pytest.approx(np.zeros(3), abs=0.02)
    R = quat_to_matrix(bench.x[QUAT : QUAT + 4])
    # The drag of 4 m/s at 0.25 per second is balanced by tilt.
    assert math.acos(R[2, 2]) == pytest.approx(math.atan(1.0 / G), rel=0.05)
    bench.setpoint[:3] = [0.0, 1.0, -0.5]
    bench.fly(8.0, (4.0, 0.0, 0.0))
    assert bench.x[3:6] == pytest.approx([0.0, 1.0, -0.5], abs=0.05)


def test_its_inertial_sensor_feels_what_moves_it() -> None:
    bench = Bench()
    bench.setpoint[:3] = [2.0, -1.0, -1.0]
    rows = bench.fly(3.0)
    force = np.stack([quat_to_matrix(r[6:10]) @ r[13:16] for r in rows])
    force[:, 2] += G
    assert np.cumsum(force, axis=0)[-1] / STEP_HZ == pytest.approx(bench.x[3:6], abs=1e-9)


def test_roll_and_pitch_stay_near_their_bound() -> None:
    bench = Bench()
    bench.setpoint[:3], bench.setpoint[SET_TILT] = [10.0, 0.0, 0.0], 0.15
    rows = bench.fly(3.0)
    tilt = np.array([math.acos(min(1.0, quat_to_matrix(r[6:10])[2, 2])) for r in rows])
    assert 0.12 < tilt.max() < 0.15 * 1.2


def test_the_speed_of_contact_is_that_of_the_fall_onto_a_moving_deck() -> None:
    bench = Bench(height=0.6)
    bench.setpoint[2] = 0.4
    bench.deck[:, 5] = -0.2
    before = bench.x.copy()
    while bench.contact[0] < 0.0:
        bench.fly(0.02)
        bench.deck[:, 2] -= 0.2 * 8 / STEP_HZ
        assert bench.x[2] > before[2] - 0.1
    assert bench.contact[1] == pytest.approx(0.4 + 0.2, abs=0.08)
    assert bench.contact[2:] == pytest.approx(np.zeros(2), abs=0.02)


def test_it_stands_on_the_deck_once_its_motors_are_off() -> None:
    bench = Bench(height=0.3)
    bench.setpoint[2] = 0.3
    bench.fly(3.0)
    assert bench.own[LOADED] > 0.2
    bench.setpoint[SET_MOTORS] = 0.0
    bench.fly(3.0)
    assert bench.x[3:6] == pytest.approx(np.zeros(3), abs=1e-3)
    assert -bench.x[2] == pytest.approx(0.1, abs=0.01)


def test_beside_the_deck_it_falls() -> None:
    bench = Bench(height=0.3)
    bench.x[0] = 5.0
    bench.setpoint[SET_MOTORS] = 0.0
    bench.fly(1.0)
    assert bench.contact[0] < 0.0
    assert bench.x[2] > 0.5


def test_compiled_and_plain_code_agree() -> None:
    pytest.importorskip("numba")
    one, other = Bench(0.3), Bench(0.3, plain=True)
    for bench in (one, other):
        bench.setpoint[:3] = [0.3, 0.1, 0.4]
        bench.fly(0.6, (2.0, 1.0, 0.0))
    assert one.x == pytest.approx(other.x, abs=1e-9)
    assert one.contact == pytest.approx(other.contact, abs=1e-9)


def test_turbulence_has_the_strength_of_its_model() -> None:
    air = Turbulence(4.0, 0.0, np.random.default_rng(1))
    drawn = np.array([air.step(10.0, 0.5) for _ in range(40_000)])
    slope = 0.177 + 0.000823 * 10.0 / 0.3048
    assert drawn.mean(axis=0) == pytest.approx([4.0, 0.0, 0.0], abs=0.1)
    assert drawn.std(axis=0) == pytest.approx([0.4 / slope**0.4, 0.4 / slope**0.4, 0.4], rel=0.08)
    calm = Turbulence(0.0, 0.0, np.random.default_rng(1))
    assert np.all(calm.step(10.0, 0.5) == 0.0)

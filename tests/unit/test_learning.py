"""What the filter is told of the deck's motion, from where fixes show the deck."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.band import band_moments
from estimation.config import PlatformConfig
from estimation.deck import DRIFT_SPEED, DRIFT_TIME_S, HEAVE, SWAY_EAST, SWAY_NORTH, prior_motion
from estimation.events import Kind
from estimation.learning import (
    DRIFT_PRIOR,
    DRIFT_SEEN,
    MotionLearner,
    drift_velocity,
    fast_part,
    inertial_wander,
)
from estimation.outcome import Outcome
from estimation.rows import Rows
from estimation.watch import LET_GO

Array = NDArray[np.float64]
RATE_HZ, NOISE_M = 15.0, 0.08


def seen(height: Array, north: Array, east: Array, rng: np.random.Generator) -> Rows:
    n = len(height)
    rows = Rows.empty(n)
    rows.t_ns[:] = np.round((100.0 + np.arange(n) / RATE_HZ) * 1e9)
    rows.kind[:], rows.outcome[:] = Kind.VISION, Outcome.FUSED
    for column, values in ((0, height), (2, north), (4, east)):
        rows.seen[:, column] = values + NOISE_M * rng.standard_normal(n)
        rows.seen[:, column + 1] = NOISE_M**2
    rows.seen[:, 12:15] = 0.01**2
    return rows


def learner() -> MotionLearner:
    return MotionLearner(2.0, 60.0, prior_motion(PlatformConfig()), 0.01, 5e-4)


def told(parameters: Array, chain: int = HEAVE) -> tuple[float, float]:
    """Return the 1-sigma of a chain's displacement and of its rate that parameters mean."""
    moments = band_moments(parameters[chain : chain + 7])
    return math.sqrt(moments[3]), math.sqrt(moments[4])


def sea(t: Array, sigma_m: float, period_s: float, rng: np.random.Generator) -> Array:
    """Return a narrow sea: five sinusoids about a period."""
    omega = 2.0 * np.pi / (period_s * rng.uniform(0.85, 1.15, 5))
    phase = rng.uniform(0.0, 2.0 * np.pi, 5)
    out: Array = sigma_m * math.sqrt(2.0 / 5.0) * np.sin(np.outer(t, omega) + phase).sum(axis=1)
    return out


def test_a_sea_is_taken_up_in_its_form_and_both_axes_of_the_sway_soon() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 16.0, 1.0 / RATE_HZ)
    one = learner()
    one.take(seen(sea(t, 0.2, 5.0, rng), sea(t, 0.15, 5.0, rng), sea(t, 0.02, 5.0, rng), rng))
    size, rate = told(one.parameters)
    assert HEAVE in one.blocks
    assert size == pytest.approx(0.2, rel=0.5) and rate / size == pytest.approx(2.0 * math.pi / 5.0, rel=0.3)
    assert all(m is not None for m in one.sway)
    north, east = told(one.parameters, SWAY_NORTH), told(one.parameters, SWAY_EAST)
    assert north[0] == pytest.approx(0.15, rel=0.5) and north[0] > 2.0 * east[0]
    assert north[1] / north[0] == pytest.approx(2.0 * math.pi / 5.0, rel=0.3)


def test_steps_of_the_vehicles_own_place_are_no_sea_and_its_drift_is_none_of_the_decks() -> None:
    """The vehicle is moved by 2 cm at each reading of GPS, back and forth about a slow error of half a metre."""
    rng = np.random.default_rng(4)
    t = np.arange(0.0, 58.0, 1.0 / RATE_HZ)
    pull = np.repeat(rng.normal(size=len(t) // 3 + 1), 3)[: len(t)] * 0.02
    moved = np.cumsum(np.where(np.arange(len(t)) % 3 == 0, pull, 0.0))
    moved += 0.5 * np.sin(2.0 * np.pi * t / 120.0) - np.linspace(0.0, moved[-1], len(t))
    swing, still = sea(t, 0.1, 6.0, rng), 0.0 * t
    rows = seen(still - moved, swing + moved, still + moved, rng)
    rows.seen[:, 7], rows.seen[:, 8], rows.seen[:, 9] = moved, moved, moved
    one = learner()
    one.take(rows)
    size, rate = told(one.parameters, SWAY_NORTH)
    assert size == pytest.approx(0.1, rel=0.4) and rate / size == pytest.approx(2.0 * math.pi / 6.0, rel=0.3)
    # Nothing but what the noise may hide: a rate of 0.055 m/s; steps taken as they look would be three times the size.
    assert told(one.parameters, SWAY_EAST)[0] < 0.02 and told(one.parameters, SWAY_EAST)[1] < 0.06
    assert told(one.parameters, HEAVE)[0] < 0.04
    assert one.parameters[DRIFT_SPEED] < 0.75 * PlatformConfig().drift_sigma_mps


def wandering(
    accel_noise: float, readings: list[tuple[Array, float]], rng: np.random.Generator
) -> tuple[Array, float, float]:
    """Return what inertia alone makes, in 80 s at 20 Hz, of a place that a filter of place and velocity holds with
    readings at 5 Hz, the variance of its velocity at the end and the squares of its corrections in a second."""
    dt = 0.05
    F = np.array([[1.0, dt], [0.0, 1.0]])
    Q = accel_noise**2 * np.array([[dt**3 / 3.0, dt**2 / 2.0], [dt**2 / 2.0, dt]])
    root, P, error = np.linalg.cholesky(Q), 0.01 * np.eye(2), np.zeros(2)
    moved, corrected, out = 0.0, 0.0, np.empty(2000)
    for k in range(2000):
        error, P = F @ error + root @ rng.standard_normal(2), F @ P @ F.T + Q
        for h, sigma in readings if k % 4 == 0 else []:
            gain = P @ h / (h @ P @ h + sigma**2)
            correction = gain * (sigma * rng.standard_normal() - h @ error)
            error, moved = error + correction, moved + correction[0]
            corrected += correction[1] ** 2 if k >= 400 else 0.0
            P = P - np.outer(gain, h @ P)
        out[k] = error[0] - moved
    return out[400:], float(P[1, 1]), corrected / 80.0


@pytest.mark.parametrize(
    ("accel_noise", "position_m", "velocity_mps"),
    [(0.01, 0.02, 1.0), (0.01, 1.0, 0.1), (0.03, 0.02, 0.05), (0.1, 0.02, 0.05)],
)
def test_the_wander_of_a_series_has_the_density_that_its_velocitys_variance_tells(
    accel_noise: float, position_m: float, velocity_mps: float
) -> None:
    """From a filter that follows inertia for half a minute to one that follows its readings at once; from the slowest
    sea to the fastest the density falls by five orders."""
    rng = np.random.default_rng(6)
    readings = [(np.array([1.0, 0.0]), position_m), (np.array([0.0, 1.0]), velocity_mps)]
    taper = np.hanning(1600)
    f = np.fft.rfftfreq(1600, 0.05)[1:]
    density = np.zeros(len(f))
    for _ in range(30):
        series, variance, corrected = wandering(accel_noise, readings, rng)
        y = fast_part(0.05 * np.arange(1600), series)
        line = np.fft.rfft(taper * (y - y.mean()))[1:]
        density += 2.0 * np.abs(line) ** 2 * 0.05 / (taper @ taper) / 30
    share = density / inertial_wander(variance, corrected, accel_noise, 0.0, f)
    for low, high in ((0.07, 0.1), (0.1, 0.2), (0.2, 0.4), (0.4, 0.8)):
        assert 0.5 < share[(f >= low) & (f < high)].mean() < 2.0


def drifting(n: int, sigma_mps: float, rng: np.random.Generator) -> Array:
    """Return a place (n,) whose velocity is the filter's Gauss-Markov process."""
    remains = math.exp(-1.0 / RATE_HZ / DRIFT_TIME_S)
    velocity = np.empty(n)
    velocity[0] = sigma_mps * rng.standard_normal()
    for k in range(1, n):
        velocity[k] = (
            remains * velocity[k - 1] + sigma_mps * math.sqrt(1.0 - remains**2) * rng.standard_normal()
        )
    return np.asarray(np.cumsum(velocity) / RATE_HZ)


def test_the_speed_of_the_drift_is_learned_from_its_place_and_not_from_its_sway() -> None:
    """Over many flights the velocities between means have the share of its variance that is reckoned with, and a flight
    tells as much as it has seen, the prior the rest."""
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 58.0, 1.0 / RATE_HZ)
    squares = [np.mean(drift_velocity(t, drifting(len(t), 0.1, rng)) ** 2) for _ in range(600)]
    assert np.mean(squares) == pytest.approx(DRIFT_SEEN * 0.1**2, rel=0.08)

    prior = PlatformConfig().drift_sigma_mps
    still, steady = learner(), learner()
    still.take(seen(0.0 * t, sea(t, 0.1, 4.0, rng), sea(t, 0.2, 6.0, rng), rng))
    steady.take(seen(0.0 * t, 0.2 * t, sea(t, 0.2, 6.0, rng), rng))
    assert 0.5 * prior < still.parameters[DRIFT_SPEED] < 0.75 * prior
    expected = math.sqrt((DRIFT_PRIOR * prior**2 + 3 * 0.2**2 / DRIFT_SEEN) / (DRIFT_PRIOR + 6))
    assert steady.parameters[DRIFT_SPEED] == pytest.approx(expected, rel=0.1)


@pytest.mark.parametrize("seed", range(4))
def test_a_small_sea_under_the_wander_of_the_own_height_is_not_taken_for_slow(seed: int) -> None:
    """Noise hides most of it: what is told must leave room for the rate that it may have."""
    rng = np.random.default_rng(seed)
    t = np.arange(0.0, 36.0, 1.0 / RATE_HZ)
    wander = 0.04 * np.sin(2.0 * np.pi * t / 25.0 + rng.uniform(0.0, 6.0))
    one = learner()
    one.take(seen(wander + sea(t, 0.02, 2.0, rng), 0.0 * t, 0.0 * t, rng))
    true_rate = 0.02 * 2.0 * math.pi / 2.0
    assert told(one.parameters)[1] > 0.6 * true_rate
    assert told(one.parameters)[0] < 0.12


def test_what_came_before_a_letting_go_is_not_learned_from() -> None:
    rng = np.random.default_rng(2)
    t = np.arange(0.0, 34.0, 1.0 / RATE_HZ)
    height = np.where(t < 20.0, 0.0, sea(t, 0.4, 6.0, rng))
    rows = seen(height, 0.0 * t, 0.0 * t, rng)
    one = learner()
    one.take(rows.take(slice(0, int(21.0 * RATE_HZ))))
    small = told(one.parameters)[0]
    rest = rows.take(slice(int(21.0 * RATE_HZ), None))
    rest.reset[0] = LET_GO
    fits = one.take(rest)
    assert small < 0.2
    # Nothing until eight seconds of the new motion were seen; and then it is not diluted by the old.
    assert fits[0][0] * 1e-9 >= 100.0 + 21.0 - 3.0 + 8.0
    assert told(one.parameters)[0] == pytest.approx(float(height[t > 20.0].std()), rel=0.25)

"""What fixes tell of the camera's age, and what of it is the gyro's noise."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.camera_age import SCATTER_SIZE, noise_taken_out, noise_told, tells_age, turned, weigh
from estimation.config import parse_config
from estimation.deck import vision
from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_exp, quat_multiply, quat_to_matrix
from estimation.parameters import Site, pack_parameters
from estimation.state import (
    CAMERA_LATENCY,
    CAMERA_MOUNT,
    CL0,
    CM0,
    P0,
    PL0,
    PO0,
    Q0,
    V0,
    Layout,
    nominal_zero,
    plus,
)
from estimation.update import MAX_LATENCY_S, MIN_LATENCY_S, hold_latency

CONFIG = parse_config("[platform]\nuse = true\n[vision]\nlever_arm_m = [0.1, -0.05, 0.2]\n")
LAYOUT = Layout.of(CONFIG)
P = pack_parameters(CONFIG, Site((0.9, 0.1, 50.0), 0.0))
LEVER = np.array([0.1, -0.05, 0.2])
RATE = np.array([0.4, -0.3, 0.2])
AGE = LAYOUT.offsets[CAMERA_LATENCY]
Array = NDArray[np.float64]


def flying() -> Array:
    """Return a state some metres over the platform, tilted, and on its way."""
    x = nominal_zero()
    x[P0 : P0 + 3], x[V0 : V0 + 3] = [3.0, -2.0, -6.0], [0.8, -1.1, 0.4]
    x[PO0 : PO0 + 2], x[PL0] = [2.5, -1.0], 0.3
    x[Q0 : Q0 + 4] = euler_to_quat(0.1, -0.15, 1.1)
    return x


def place_seen(x: Array, age_s: float) -> Array:
    """Return P^c (3,) of a platform at rest as it was ``age_s`` ago, by rigid motion."""
    position = x[P0 : P0 + 3] - x[V0 : V0 + 3] * age_s
    attitude = quat_multiply(x[Q0 : Q0 + 4], quat_exp(-RATE * age_s))
    platform = np.array([x[PO0], x[PO0 + 1], -x[PL0]])
    seen: Array = R_CB_NOMINAL @ (quat_to_matrix(attitude).T @ (platform - position) - LEVER)
    return seen


def change(x: Array) -> Array:
    """Return by how much what is seen changes per second of age (3,) [m/s]."""
    step = 1e-5
    difference: Array = (place_seen(x, step) - place_seen(x, -step)) / (2.0 * step)
    return difference


def test_a_fix_changes_with_its_age_as_the_vehicle_turned() -> None:
    x = flying()
    x[V0 : V0 + 3] = 0.0
    assert -turned(x, P) @ RATE == pytest.approx(change(x), abs=1e-7)


@pytest.mark.parametrize("age_s", [-0.02, 0.01, 0.04])
def test_the_innovation_of_an_aged_fix_is_of_second_order(age_s: float) -> None:
    x = flying()
    value = place_seen(x, age_s)
    x[CL0] = age_s
    r, H, R = np.zeros(3), np.zeros((3, LAYOUT.size)), np.zeros((3, 3))
    assert vision(value, np.full(6, math.nan), x, RATE, P, LAYOUT.offsets, r, H, R) == 3
    first = np.linalg.norm(change(x)) * abs(age_s)
    assert np.linalg.norm(r) < abs(age_s) * first
    assert H[:, AGE] == pytest.approx(change(x), abs=1e-7)


def test_information_is_taken_out_and_nothing_else() -> None:
    """An update by an age of 3/4 sample with that information, which considers the camera's mounting, undoes it."""
    x, rng = flying(), np.random.default_rng(4)
    x[CL0] = -0.012
    root = rng.standard_normal((LAYOUT.size, LAYOUT.size)) * 0.001
    before = root @ root.T + 1e-6 * np.eye(LAYOUT.size)
    R = np.diag([1e-4, 1e-4, 4e-4])
    S, after = R + np.diag([1e-4, 2e-4, 2e-4]), before.copy()
    shown = noise_told(x, S, R, 1.0, 0.004**2, P)
    W, M = turned(x, P), np.linalg.inv(0.5 * (S + R))
    assert shown == pytest.approx(2.0 / 3.0 * 0.004**2 * np.trace(W.T @ M @ W))
    y = noise_taken_out(x, after, shown, 0.01, P, LAYOUT.offsets)
    mount = slice(LAYOUT.offsets[CAMERA_MOUNT], LAYOUT.offsets[CAMERA_MOUNT] + 3)
    assert after[AGE, AGE] > (1.0 + 1e-4) * before[AGE, AGE]
    assert np.array_equal(after[mount, mount], before[mount, mount])
    assert np.array_equal(y[CM0 : CM0 + 3], x[CM0 : CM0 + 3])
    K, H = after[:, AGE] / (after[AGE, AGE] + 1.0 / shown), np.eye(LAYOUT.size)[AGE]
    K[mount] = 0.0
    A = np.eye(LAYOUT.size) - np.outer(K, H)
    undone = A @ after @ A.T + np.outer(K, K) / shown
    assert abs(undone - before).max() < 1e-12 * abs(before).max()
    z = plus(y, K * (0.0075 - y[CL0]), LAYOUT.offsets)
    assert z == pytest.approx(x, abs=1e-12)


INTERVAL_S = 0.05
OWN = np.array([1e-4, 0.0, 0.0, 1e-4, 0.0, 9e-4])


def hovered(
    rng: np.random.Generator,
    fixes: int,
    noise_radps: float,
    rocked_radps: float = 0.0,
    taken_out: bool = True,
) -> tuple[float, float, Array]:
    """Return the age that fixes at 30 Hz show in a hover, its sigma [s], and what is remembered of them.

    All but the age is known; the attitude integrates the gyro's noise at 20 Hz. The true age is the nominal one.
    """
    x = flying()
    x[V0 : V0 + 3] = 0.0
    level, seen, q = x[Q0 : Q0 + 4].copy(), place_seen(x, 0.0), noise_radps**2
    covariance = np.zeros((LAYOUT.size, LAYOUT.size))
    covariance[AGE, AGE] = CONFIG.vision.latency_sigma_s**2
    scatter = np.zeros(SCATTER_SIZE)
    scatter[1], scatter[2] = q, 3.0 * q + rocked_radps**2
    for k in range(fixes):
        samples, share = noise_radps * rng.standard_normal((2, 3)), rng.random()
        noise = (1.0 - share) * samples[0] + share * samples[1]
        # Up to the first sample by half an interval of it; from there on by the mean of the two ends.
        error = 0.5 * INTERVAL_S * (samples[0] + share * (samples[0] + noise))
        x[Q0 : Q0 + 4] = quat_multiply(level, quat_exp(error))
        turning = (
            math.sqrt(2.0) * rocked_radps * math.sin(2.0 * math.pi * k / 30.0) * np.array([0.6, 0.8, 0.0])
        )
        r, H, R = np.zeros(3), np.zeros((3, LAYOUT.size)), np.zeros((3, 3))
        value = seen + np.array([0.01, 0.01, 0.03]) * rng.standard_normal(3)
        vision(value, OWN, x, turning + noise, P, LAYOUT.offsets, r, H, R)
        S = H @ covariance @ H.T + R
        shown = noise_told(x, S, R, 1.0, q, P)
        weigh(scatter, shown, H @ covariance[:, AGE], np.linalg.inv(S), float(covariance[AGE, AGE]))
        K = covariance @ H.T @ np.linalg.inv(S)
        x[CL0] += (K @ r)[AGE]
        covariance = covariance - K @ S @ K.T
        if taken_out:
            x = noise_taken_out(x, covariance, shown, INTERVAL_S, P, LAYOUT.offsets)
    return float(x[CL0]), math.sqrt(covariance[AGE, AGE]), scatter


def test_noise_of_the_gyro_tells_nothing_of_the_age() -> None:
    """A few seconds of a still hover with a gyro of 4 mrad/s of noise, many times: no fix shows any age. Taken as it
    is, the noise would tell of one of 37 ms, three quarters of the samples' interval.
    """
    known = CONFIG.vision.latency_sigma_s
    for taken_out in (True, False):
        found = [hovered(np.random.default_rng(seed), 100, 0.004, 0.0, taken_out)[:2] for seed in range(40)]
        ages, sigmas = np.array(found).T
        doubt = ages.std() / math.sqrt(len(ages))
        if taken_out:
            assert abs(ages.mean()) < 2.5 * doubt
            assert np.all((sigmas > 0.98 * known) & (sigmas < 1.0001 * known))
        else:
            assert ages.mean() > 4.0 * doubt
            assert np.all(sigmas < 0.96 * known)


@pytest.mark.parametrize(
    ("noise_radps", "rocked_radps", "tells"),
    [(0.004, 0.0, False), (0.03, 0.0, False), (0.004, 0.1, True), (0.004, 0.03, False), (0.3, 0.1, False)],
)
def test_the_age_is_told_by_rotation_that_is_more_than_noise(
    noise_radps: float, rocked_radps: float, tells: bool
) -> None:
    """A gyro on a vehicle whose propellers shake it may scatter by far more than the vehicle turns."""
    scatter = hovered(np.random.default_rng(8), 300, noise_radps, rocked_radps)[2]
    assert tells_age(scatter, P) is tells


@pytest.mark.parametrize("calibrated_s", [0.0, 0.05])
def test_the_age_stays_in_its_box(calibrated_s: float) -> None:
    """Below zero as far as the map of the clocks may err; calibrated and learned together."""
    config = parse_config(f"[platform]\nuse = true\n[vision]\nlatency_s = {calibrated_s}\n")
    p, x = pack_parameters(config, Site((0.9, 0.1, 50.0), 0.0)), flying()
    for learned_s, kept_s in ((-1.0, MIN_LATENCY_S), (-0.01 - calibrated_s, -0.01), (1.0, MAX_LATENCY_S)):
        x[CL0] = learned_s
        hold_latency(x, p)
        assert calibrated_s + x[CL0] == pytest.approx(kept_s)

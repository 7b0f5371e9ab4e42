"""The first fixes of a platform that is not where it was thought to be."""

from __future__ import annotations

import math

import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from estimation.config import parse_config
from estimation.deck import vision
from estimation.estimator import LandingEstimator
from estimation.events import EventBatch
from estimation.frames import euler_to_quat
from estimation.models import BAROMETER, VISION
from estimation.parameters import Site, pack_parameters
from estimation.relinearise import FAR_M, moved_far, relinearise
from estimation.state import NOMINAL, P0, Q0, RANGE_SCALE, RS0, Layout, nominal_zero, plus
from simulation.flight import load_scenario, simulate

CONFIG = parse_config("[platform]\nuse = true\n[vision]\nlever_arm_m = [0.1, -0.05, 0.2]\n")
LAYOUT = Layout.of(CONFIG)
P = pack_parameters(CONFIG, Site((0.9, 0.1, 50.0), 0.0))
GYRO = np.array([0.2, -0.3, 0.1])
VALUE = np.array([1.0, 2.0, 11.0])
Array = NDArray[np.float64]


def innovation(x: Array) -> tuple[Array, Array]:
    """Return innovation and covariance of the fix at a state."""
    r, H, R = np.zeros(3), np.zeros((3, LAYOUT.size)), np.zeros((3, 3))
    assert vision(VALUE, np.full(6, math.nan), x, GYRO, P, LAYOUT.offsets, r, H, R) == 3
    return r, R


def far_error() -> Array:
    """Return an error by which the platform moves by metres, and everything else by little."""
    error = 0.02 * np.random.default_rng(3).standard_normal(LAYOUT.size)
    error[LAYOUT.names.index("platform_level.h")] = 2.5
    error[LAYOUT.names.index("platform_offset.n")] = -1.5
    for k, name in enumerate(LAYOUT.names):
        if name.startswith(("camera_", "gyro_bias")):
            error[k] = 0.0
    return error


def test_a_fix_is_stated_about_the_state_and_linearised_where_it_leads() -> None:
    x, error = nominal_zero(), far_error()
    x[P0 : P0 + 3], x[RS0] = [3.0, -2.0, -12.0], 0.01
    x[Q0 : Q0 + 4] = euler_to_quat(0.2, -0.15, 1.1)
    r, H, R = np.zeros(3), np.full((3, LAYOUT.size), 7.0), np.zeros((3, 3))
    relinearise(VALUE, np.full(6, math.nan), x, error, GYRO, P, LAYOUT.offsets, r, H, R)
    there = innovation(plus(x, error, LAYOUT.offsets))
    assert r == pytest.approx(there[0] + H @ error, abs=1e-12)
    np.testing.assert_array_equal(R, there[1])
    step = 1e-6
    for k in range(LAYOUT.size):
        d = np.zeros(LAYOUT.size)
        d[k] = step
        forward = innovation(plus(x, error + d, LAYOUT.offsets))[0]
        backward = innovation(plus(x, error - d, LAYOUT.offsets))[0]
        assert H[:, k] == pytest.approx(-(forward - backward) / (2.0 * step), abs=2e-6), LAYOUT.names[k]


def test_only_a_fix_that_moves_the_platform_far_is_linearised_again() -> None:
    error = np.zeros(LAYOUT.size)
    error[LAYOUT.names.index("platform_level.h")] = 2.0 * FAR_M
    assert moved_far(VISION, error, LAYOUT.offsets)
    assert not moved_far(BAROMETER, error, LAYOUT.offsets)
    # Both together: the vehicle is as much lower (down is positive) as the platform is higher.
    error[LAYOUT.names.index("position.d")] = -2.0 * FAR_M
    assert not moved_far(VISION, error, LAYOUT.offsets)
    error[LAYOUT.names.index("platform_sway.e3_rate")] = 2.0 * FAR_M
    assert moved_far(VISION, error, LAYOUT.offsets)


@pytest.mark.parametrize("engine", ["filterpy", "compiled"])
def test_finding_the_platform_metres_off_says_nothing_of_the_range_scale(engine: str) -> None:
    """Neither does a vehicle that stays at its height: what it sees is all of one distance."""
    scenario = load_scenario("latency_calm_2026_11")
    origin = msgspec.structs.replace(scenario.config.origin, altitude_m=3.0)
    config = msgspec.structs.replace(scenario.config, origin=origin)
    flight = simulate(scenario, 1)
    rows = flight.batch.rows
    known = rows[rows["arrival_ns"] < rows["arrival_ns"][0] + 24_000_000_000]
    batch = EventBatch(known, flight.batch.sensors, flight.batch.clocks, flight.batch.timesync_reference)
    run = LandingEstimator(config, engine=engine, facts=flight.facts).run(batch)  # type: ignore[arg-type]
    prior = config.vision.scale_sigma
    sigma = run.sigma[:, run.state_names.index("range_scale.s")]
    before = run.deck[sigma == prior][-1, 2]
    assert abs(run.deck[-1, 2] - before) > 2.0
    assert sigma[-1] > 0.97 * prior
    assert abs(run.nominal[-1, NOMINAL[RANGE_SCALE]]) < 0.25 * prior

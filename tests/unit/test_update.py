"""Gate, lock-out and the sensors' own noise."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.config import Config
from estimation.models import BAROMETER, GPS_POSITION, GPS_VELOCITY
from estimation.parameters import Site, chi_square_bound, pack_parameters
from estimation.state import BARO_BIAS, BB0, GPS_BIAS, P0, POSITION, Layout, nominal_zero
from estimation.update import MEMORY_SIZE, locked_out, reading_noise, reset_datum, weight

P = pack_parameters(Config(), Site((0.9, 0.1, 50.0), 0.0))
LAYOUT = Layout.of(Config())
NOISE = np.diag([0.01, 0.01, 9.0])


@pytest.mark.parametrize(("kind", "dimension"), [(GPS_POSITION, 3), (GPS_VELOCITY, 3), (BAROMETER, 1)])
def test_a_reset_keeps_the_covariance_positive_and_the_rest_untouched(kind: int, dimension: int) -> None:
    rng = np.random.default_rng(7)
    root = rng.normal(size=(LAYOUT.size, LAYOUT.size))
    before = root @ root.T
    after, x = before.copy(), nominal_zero()
    reset_datum(
        kind, x, after, np.array([1.0, 2.0, 3.0]), np.diag([0.1, 0.2, 0.3]), dimension, LAYOUT.offsets
    )
    assert np.array_equal(after, after.T)
    assert np.linalg.eigvalsh(after).min() > 0.0
    attitude_and_biases = slice(6, 15)
    assert np.array_equal(
        after[attitude_and_biases, attitude_and_biases], before[attitude_and_biases, attitude_and_biases]
    )


def test_a_reset_position_is_the_fix_less_its_bias() -> None:
    covariance = np.eye(LAYOUT.size)
    bias = int(LAYOUT.offsets[GPS_BIAS])
    covariance[bias : bias + 3, bias : bias + 3] = np.diag([4.0, 9.0, 16.0])
    x = nominal_zero()
    reset_datum(GPS_POSITION, x, covariance, np.array([5.0, -6.0, 7.0]), np.eye(3) * 0.5, 3, LAYOUT.offsets)
    position = int(LAYOUT.offsets[POSITION])
    assert x[P0 : P0 + 3] == pytest.approx([5.0, -6.0, 7.0])
    assert np.diag(covariance)[position : position + 3] == pytest.approx([4.5, 9.5, 16.5])
    assert covariance[position, bias] == pytest.approx(-4.0)


def test_a_reset_barometer_takes_the_innovation_into_its_offset() -> None:
    covariance, x = np.eye(LAYOUT.size), nominal_zero()
    reset_datum(BAROMETER, x, covariance, np.array([12.0]), np.eye(1), 1, LAYOUT.offsets)
    assert x[BB0] == pytest.approx(12.0)
    assert covariance[LAYOUT.offsets[BARO_BIAS], LAYOUT.offsets[POSITION] + 2] == pytest.approx(1.0)


def test_weight_falls_from_one_to_zero_at_the_bounds() -> None:
    huber, gate = chi_square_bound(3.0, 3), chi_square_bound(6.0, 3)
    assert weight(0.99 * huber, 3, P) == 1.0
    assert 0.0 < weight(0.99 * gate, 3, P) < 1.0
    assert weight(1.01 * gate, 3, P) == 0.0
    assert weight(float("nan"), 3, P) == 0.0
    assert chi_square_bound(3.0, 1) == pytest.approx(9.0)


def test_no_number_of_rejections_lets_a_sensor_without_a_datum_in() -> None:
    memory, r = np.zeros(MEMORY_SIZE), np.ones(3)
    assert not any(locked_out(memory, 5, 0.1 * k, r, NOISE, 1, P) for k in range(1000))


def test_a_gps_that_agrees_with_itself_is_believed_after_the_set_time() -> None:
    memory, r = np.zeros(MEMORY_SIZE), np.array([1000.0, 0.0, 0.0])
    answers = [locked_out(memory, GPS_POSITION, 0.2 * k, r, NOISE, 3, P) for k in range(40)]
    first = answers.index(True)
    assert 0.2 * first == pytest.approx(Config().gps.reset_after_s, abs=0.21)


def test_a_gps_that_contradicts_itself_is_never_believed() -> None:
    memory, rng = np.zeros(MEMORY_SIZE), np.random.default_rng(1)
    assert not any(
        locked_out(memory, GPS_POSITION, 0.2 * k, rng.normal(size=3) * 500.0, NOISE, 3, P) for k in range(500)
    )


def test_the_noise_of_readings_is_found_and_never_below_the_stated_one() -> None:
    rng = np.random.default_rng(2)
    noisy, quiet = np.zeros(MEMORY_SIZE), np.zeros(MEMORY_SIZE)
    for k in range(4000):
        found = reading_noise(noisy, 0.02 * k, rng.normal() * 0.5, 0.01)
        stated = reading_noise(quiet, 0.02 * k, rng.normal() * 0.01, 0.01)
    assert found == pytest.approx(0.25, rel=0.25)
    assert stated == 0.01

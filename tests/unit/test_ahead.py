"""The deck's forecast against the filter's own propagation, and against the sea."""

from __future__ import annotations

import math

import numpy as np
import pytest

from estimation.ahead import DeckForecaster
from estimation.band import band_matrix, band_stationary
from estimation.config import parse_config
from estimation.deck import deck_output, deck_transition, no_steps
from estimation.estimator import LandingEstimator
from estimation.parameters import OFFSET_WALK, Site, pack_parameters
from estimation.state import (
    PD0,
    PH0,
    PLATFORM_HEAVE,
    POSITION,
    PS0,
    VELOCITY,
    Layout,
    nominal_zero,
)
from simulation.flight import load_scenario, simulate

HEAVE = np.array([0.5, 1.0, 1.3, 1.7, 0.3, 0.2, 0.4])
NORTH, EAST = np.array([0.4, 1.1, 1.2, 2.0, 0.1, 0.2, 0.4]), np.array([0.7, 0.9, 1.6, 1.9, 0.2, 0.3, 0.3])
DRIFT = np.array([0.15, -0.08])
SWAY = 0.2 * np.random.default_rng(5).normal(size=12)


CONFIG = parse_config("[platform]\nuse = true\n")
MOTION = np.array([*HEAVE, *NORTH, *EAST, 0.05])


LAYOUT = Layout.of(CONFIG)
HEAVE_BLOCK = slice(LAYOUT.offsets[PLATFORM_HEAVE], LAYOUT.offsets[PLATFORM_HEAVE] + 6)


def some_state() -> tuple[np.ndarray, np.ndarray]:
    """Return a nominal state with a moving deck and a covariance in which everything is correlated."""
    rng = np.random.default_rng(3)
    root = rng.normal(size=(LAYOUT.size, LAYOUT.size)) * 0.01
    x = nominal_zero()
    x[PH0 : PH0 + 6] = rng.normal(size=6) * 0.3
    x[PS0 : PS0 + 12] = SWAY
    x[PD0 : PD0 + 2] = DRIFT
    return x, root @ root.T + 1e-4 * np.eye(LAYOUT.size)


def test_the_forecast_is_what_the_filter_would_propagate_to() -> None:
    p = pack_parameters(CONFIG, Site((0.9, 0.1, 0.0), 0.0))
    # The walk of the mean place, a centimetre in a second, is left out of the forecast.
    p[OFFSET_WALK] = 0.0
    x0, P = some_state()
    x, covariance = x0.copy(), P.copy()
    forecast = DeckForecaster.at([0.0, 0.8]).forecast(0, x0, P, MOTION, True, LAYOUT.offsets)
    n = LAYOUT.size
    position, velocity = LAYOUT.offsets[POSITION], LAYOUT.offsets[VELOCITY]
    for _ in range(160):
        F, Q = np.eye(n), np.zeros((n, n))
        F[position : position + 3, velocity : velocity + 3] = 0.005 * np.eye(3)
        y = x.copy()
        deck_transition(x, y, 0.005, p, MOTION, *no_steps(), LAYOUT.offsets, F, Q)
        x = y
        covariance = F @ covariance @ F.T + Q
    rate = band_matrix(HEAVE)[5]
    heave, block = x0[PH0 : PH0 + 6], covariance[HEAVE_BLOCK, HEAVE_BLOCK]
    assert forecast.height_m == pytest.approx([heave[5], x[PH0 + 5]], abs=1e-6)
    assert forecast.rate_mps == pytest.approx([rate @ heave, rate @ x[PH0 : PH0 + 6]], abs=1e-6)
    assert forecast.rate_sigma_mps[1] == pytest.approx(math.sqrt(rate @ block @ rate), rel=1e-3)
    assert forecast.height_sigma_m[1] == pytest.approx(math.sqrt(block[5, 5]), rel=1e-3)
    for axis, band in enumerate((NORTH, EAST)):
        swing, at = band_matrix(band)[5], PS0 + 6 * axis
        assert forecast.velocity_mps[:, axis] == pytest.approx(
            [swing @ SWAY[6 * axis : 6 * axis + 6] + DRIFT[axis], swing @ x[at : at + 6] + x[PD0 + axis]],
            abs=1e-6,
        )
    for at, P_then in ((0, P), (1, covariance)):
        place = deck_output(x, MOTION, LAYOUT.offsets, n)[1][:2]
        np.testing.assert_allclose(forecast.apart_covariance_m2[at], place @ P_then @ place.T, rtol=1e-3)
    assert np.all(np.diag(forecast.apart_covariance_m2[1]) > np.diag(forecast.apart_covariance_m2[0]))
    np.testing.assert_allclose(forecast.apart_at(0.8), forecast.apart_covariance_m2[1])
    np.testing.assert_allclose(forecast.apart_at(0.4), forecast.apart_covariance_m2.mean(axis=0))


def test_far_ahead_only_the_sea_is_known_and_it_is_never_worse() -> None:
    x, P = some_state()
    forecast = DeckForecaster.at([0.1, 1.0, 200.0]).forecast(0, x, 1e3 * P, MOTION, False, LAYOUT.offsets)
    sea = band_stationary(HEAVE)
    rate = band_matrix(HEAVE)[5]
    assert forecast.sea_rate_sigma_mps == pytest.approx(math.sqrt(rate @ sea @ rate))
    assert np.all(forecast.rate_sigma_mps <= forecast.sea_rate_sigma_mps * (1.0 + 1e-12))
    assert np.all((forecast.skill >= 0.0) & (forecast.skill <= 1.0))
    assert forecast.rate_mps[2] == pytest.approx(0.0, abs=1e-6)
    assert forecast.height_sigma_m[2] == pytest.approx(math.sqrt(sea[5, 5]), rel=1e-6)


def test_the_probability_of_quiet_is_that_of_the_worst_moment() -> None:
    x, P = some_state()
    forecast = DeckForecaster.at(np.arange(0.0, 3.0, 0.1)).forecast(0, x, P, MOTION, True, LAYOUT.offsets)
    chance = forecast.quiet_probability(0.5, 1.5, 0.3)
    rng = np.random.default_rng(1)
    inside = (forecast.horizon_s >= 0.5) & (forecast.horizon_s <= 1.5)
    drawn = forecast.rate_mps + forecast.rate_sigma_mps * rng.standard_normal((200_000, 30))
    shares = (np.abs(drawn) < 0.3).mean(axis=0)[inside]
    assert chance == pytest.approx(shares.min(), abs=0.005)
    assert forecast.quiet_probability(0.5, 1.5, 0.5) >= chance
    assert forecast.quiet_probability(5.0, 6.0, 0.3) == 0.0


def test_horizons_that_are_none_are_refused() -> None:
    for wrong in ([], [1.0, 0.5], [-1.0, 1.0], [math.nan]):
        with pytest.raises(ValueError, match="horizon_s"):
            DeckForecaster.at(wrong)


def test_events_fed_in_pieces_lead_to_the_estimates_of_single_steps() -> None:
    flight = simulate(load_scenario("consistency_default_2026_06"), 3)
    batch = flight.batch
    whole, pieces = (LandingEstimator(flight.scenario.config, engine="filterpy") for _ in range(2))
    rows = batch.rows[:900]
    stepped = [whole.step(e) for e in list(type(batch)(rows, batch.sensors, batch.clocks))]
    fed = [
        pieces.feed(type(batch)(rows[k : k + 7], batch.sensors, batch.clocks)) for k in range(0, len(rows), 7)
    ]
    known = {o.estimate.t_ns: o.estimate for o in stepped if o.estimate is not None}
    given = [o.estimate for o in fed if o.estimate is not None]
    assert len(given) > 30
    for estimate in given:
        assert np.array_equal(estimate.nominal, known[estimate.t_ns].nominal)
    assert sum(len(o.records) for o in stepped) == sum(len(o.records) for o in fed)

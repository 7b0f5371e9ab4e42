"""The statistics of consistency, against tables and sequences whose answer is known."""

from __future__ import annotations

import numpy as np
import pytest

from estimation.consistency import chi_square_band, normalised_squared, runs_consistency, whiteness


def test_bands_are_those_of_the_tables() -> None:
    """Chi-square quantiles 0.025 and 0.975 of 1, 6 and 100 degrees of freedom (Abramowitz and Stegun, table 26.8)."""
    for dof, runs, low, high in (
        (1, 1, 0.000982069, 5.02389),
        (6, 1, 1.237347, 14.4494),
        (2, 50, 74.2219, 129.561),
    ):
        band = chi_square_band(dof, runs)
        assert band.low == pytest.approx(low / (dof * runs), rel=1e-5)
        assert band.high == pytest.approx(high / (dof * runs), rel=1e-5)
    assert list(chi_square_band(3, 10).holds(np.array([0.1, 1.0, 3.0]))) == [False, True, False]


@pytest.mark.parametrize(("dof", "runs", "probability"), [(0, 1, 0.95), (1, 0, 0.95), (1, 1, 1.0)])
def test_impossible_bands_are_refused(dof: int, runs: int, probability: float) -> None:
    with pytest.raises(ValueError, match=r"band|probability"):
        chi_square_band(dof, runs, probability)


def test_normalised_squares_in_mixed_units() -> None:
    rng = np.random.default_rng(1)
    units = np.array([1e3, 1.0, 1e-6])
    a = rng.standard_normal((20, 3, 3))
    P = (a @ a.transpose(0, 2, 1) + np.eye(3)) * np.outer(units, units)
    e = rng.standard_normal((20, 3)) * units
    expected = [float(v @ np.linalg.inv(m) @ v) for v, m in zip(e, P, strict=True)]
    np.testing.assert_allclose(normalised_squared(e, P), expected, rtol=1e-9)
    P[3] = 0.0
    e[4, 1] = np.nan
    value = normalised_squared(e, P)
    assert np.isnan(value[[3, 4]]).all()
    np.testing.assert_allclose(np.delete(value, [3, 4]), np.delete(expected, [3, 4]), rtol=1e-9)


def test_honest_and_overconfident_filters_are_told_apart() -> None:
    rng = np.random.default_rng(2)
    squares = (rng.standard_normal((50, 40, 3)) ** 2).sum(axis=2)
    squares[:, 3] = np.nan
    honest = runs_consistency(squares, 3)
    assert honest.consistent
    assert honest.runs == 50
    assert honest.instants == 39
    assert honest.inside > 0.85
    assert not runs_consistency(1.5 * squares, 3).consistent
    assert not runs_consistency(0.6 * squares, 3).consistent
    with pytest.raises(ValueError, match="finite"):
        runs_consistency(np.full((2, 3), np.nan), 1)


def test_whiteness_tells_white_from_coloured() -> None:
    rng = np.random.default_rng(3)
    white = rng.standard_normal((3000, 2))
    coloured = white.copy()
    for k in range(1, len(coloured)):
        coloured[k] += 0.7 * coloured[k - 1]
    assert whiteness(white).outside <= 0.15
    found = whiteness(coloured)
    assert found.outside > 0.3
    np.testing.assert_allclose(found.autocorrelation[:3], [0.7, 0.49, 0.343], atol=0.06)
    assert whiteness(white[:, 0]).bound == pytest.approx(1.96 / np.sqrt(3000))
    with pytest.raises(ValueError, match="lags"):
        whiteness(np.zeros(10), lags=10)

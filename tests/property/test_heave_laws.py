"""Laws of the heave model, whatever the series."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from estimation import heave
from estimation.heave.basis import Basis, dense_basis

Array = NDArray[np.float64]


@st.composite
def series(draw: st.DrawFn) -> tuple[Array, Array, Array]:
    """Irregular times with gaps, values of any size with NaN among them, sigmas over two decades."""
    n = draw(st.integers(1, 250))
    rng = np.random.default_rng(draw(st.integers(0, 2**32 - 1)))
    span = draw(st.floats(0.0, 150.0))
    scale = 10.0 ** draw(st.floats(-3.0, 2.0))
    t = np.sort(rng.uniform(0.0, span, n)) + draw(st.sampled_from([0.0, 1e6, 1.7e9]))
    if draw(st.booleans()):
        t = t[(t <= t[0] + 0.3 * span) | (t > t[0] + 0.7 * span)]
    value = scale * rng.standard_normal(len(t)).cumsum() + draw(st.floats(-1e3, 1e3))
    value[rng.random(len(t)) < draw(st.sampled_from([0.0, 0.2]))] = np.nan
    value[0] = 0.0
    return t, value, scale * 10.0 ** rng.uniform(-1.0, 1.0, len(t))


@given(series(), st.sampled_from(["bhr", "sinusoids", "mean"]))
@settings(max_examples=40, deadline=None)
def test_every_series_gives_a_usable_forecast(data: tuple[Array, Array, Array], method: str) -> None:
    model = heave.fit(*data, method=method)  # type: ignore[arg-type]
    horizon = np.array([-5.0, 0.0, 0.3, 1.0, 5.0, 40.0, 300.0])
    result = model.predict(horizon)
    assert np.all(np.isfinite(result.mean_m))
    assert np.all(np.isfinite(result.rate_mps))
    assert np.all(result.variance_m2 >= 0)
    assert not np.any(np.isnan(result.variance_m2))
    assert not np.any(np.isnan(result.rate_variance_m2ps2))
    assert np.all((result.skill >= 0) & (result.skill <= 1))
    assert np.all(result.skill[result.fallback] == 0)
    assert 0.0 <= model.quiescent(0.5, 0.5) <= 1.0
    if np.isfinite(model.sd_m):
        mean, covariance = model.joint(horizon)
        assert np.all(np.isfinite(mean))
        size = np.abs(np.diag(covariance)).max()
        if np.isfinite(size):
            assert np.linalg.eigvalsh(covariance).min() >= -1e-8 * max(size, 1e-12)


@given(st.integers(0, 1000), st.floats(-50.0, 50.0), st.floats(-1e5, 1e5))
@settings(max_examples=10, deadline=None)
def test_level_and_time_origin_do_not_matter(seed: int, level: float, origin: float) -> None:
    rng = np.random.default_rng(seed)
    t = np.sort(rng.uniform(0, 20, 200))
    value = 0.3 * np.sin(2 * np.pi * t / 5.0) + rng.normal(0, 0.03, 200)
    one = heave.fit(t, value, 0.03)
    other = heave.fit(t + origin, value + level, 0.03)
    horizon = np.array([0.0, 1.0, 3.0])
    assert np.allclose(one.forecast(horizon)[0] + level, other.forecast(horizon)[0], atol=2e-2)
    assert np.allclose(one.hs_m, other.hs_m, rtol=0.1)


@given(st.floats(5.0, 120.0), st.floats(0.01, 1.0), st.floats(-60.0, 10.0))
@settings(max_examples=60, deadline=None)
def test_rates_are_the_derivatives_of_the_basis(span: float, interval: float, at: float) -> None:
    basis = dense_basis(span, interval, 0.03, 1.3, 10.0)
    step = 1e-5
    ends = basis.values(np.array([at - step, at + step]))
    numerical = (ends[1] - ends[0]) / (2 * step)
    assert np.allclose(basis.rates(np.array([at]))[0], numerical, atol=1e-6)
    assert basis.size == ends.shape[1]


def test_drift_columns_are_a_random_walk() -> None:
    """With many terms the drift's covariance is that of a random walk: min(s, t) after its start."""
    basis = Basis(np.zeros(0), -10.0, 40.0, 4000)
    t = np.array([-5.0, 0.0, 12.0])
    drift = basis.values(t)[:, 1:]
    assert np.allclose(drift @ drift.T, np.minimum.outer(t, t) + 10.0, atol=0.02)

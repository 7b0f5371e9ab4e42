"""The search behind a learned spectrum: its derivatives, its information, its bounds, and another's optimum."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize

from estimation.heave.basis import dense_basis, phasors
from estimation.heave.regression import compress, information, posterior
from estimation.heave.series import Window, cut_window
from estimation.scoring import Place, descend

Array = NDArray[np.float64]


def window(rng: np.random.Generator, span_s: float = 12.0) -> Window:
    t = np.sort(rng.uniform(0.0, span_s, 150))
    return cut_window(t, np.sin(2.2 * t) + 0.1 * rng.standard_normal(len(t)), rng.uniform(0.08, 0.2, len(t)))


@pytest.mark.parametrize("wander", [False, True])
def test_derivatives_of_the_evidence_are_its_differences(wander: bool) -> None:
    rng = np.random.default_rng(3)
    seen = window(rng)
    basis = dense_basis(15.0, seen.interval_s, 0.1, 1.3, 10.0)
    m = len(basis.frequency_hz)
    r = compress(seen, basis, 15.0, 10.0, rng.uniform(0.0, 0.02, m) if wander else None)
    prior, noise = r.prior(rng.uniform(0.001, 0.1, m), 1e-4), 1.3
    at = r.evidence(prior, noise)
    for k in rng.choice(len(prior), 12, replace=False):
        step = np.zeros(len(prior))
        step[k] = 1e-4 * prior[k]
        difference = r.evidence(prior + step, noise).value - r.evidence(prior - step, noise).value
        assert at.slope[k] * 2.0 * step[k] == pytest.approx(difference, rel=1e-4, abs=1e-8)
    difference = (
        r.evidence(prior, noise * np.exp(1e-4)).value - r.evidence(prior, noise * np.exp(-1e-4)).value
    )
    assert at.by_noise == pytest.approx(difference / 2e-4, rel=1e-5)


def test_evidence_is_the_density_of_the_samples_themselves() -> None:
    """Projecting loses nothing: differences of the evidence are those of the density of all samples, uncompressed."""
    rng = np.random.default_rng(4)
    seen = window(rng)
    basis = dense_basis(15.0, seen.interval_s, 0.1, 1.3, 10.0)
    r = compress(seen, basis, 15.0, 10.0, None)
    columns = basis.values(seen.time_s)
    said, direct = [], []
    for size, noise in ((0.05, 1.0), (0.002, 0.7)):
        prior = r.prior(np.full(len(basis.frequency_hz), size), 1e-4)
        said.append(r.evidence(prior, noise).value)
        K = (columns * prior) @ columns.T + noise * np.diag(seen.variance_m2)
        direct.append(0.5 * float(seen.value_m @ np.linalg.solve(K, seen.value_m) + np.linalg.slogdet(K)[1]))
    assert r.outside > 0
    assert said[0] - said[1] == pytest.approx(direct[0] - direct[1], abs=0.01)


def test_information_is_the_covariance_of_the_slope() -> None:
    """Over draws from the model itself; and a coefficient's posterior without doubt of the prior is Bayes' rule."""
    rng = np.random.default_rng(5)
    seen = window(rng)
    basis = dense_basis(15.0, seen.interval_s, 0.1, 1.3, 10.0)
    r = compress(seen, basis, 15.0, 10.0, None)
    prior = r.prior(0.05 * np.exp(-(((basis.frequency_hz - 0.4) / 0.2) ** 2)) + 1e-4, 1e-4)
    by_parameter = np.vstack([prior, prior * np.linspace(-1.0, 1.0, len(prior))])
    slopes = []
    for _ in range(3000):
        y = r.columns @ (np.sqrt(prior) * rng.standard_normal(len(prior))) + rng.standard_normal(len(r.data))
        drawn = type(r)(r.columns, y, r.harmonics, r.level_variance, 0, 0.0, r.wander)
        slopes.append(by_parameter @ drawn.evidence(prior, 1.0).slope)
    at = r.evidence(prior, 1.0)
    np.testing.assert_allclose(np.cov(np.array(slopes).T), information(at, by_parameter), rtol=0.1)
    mean, covariance = posterior(at, by_parameter, np.zeros((2, 2)))
    known = np.linalg.inv(r.columns.T @ r.columns + np.diag(1.0 / prior))
    np.testing.assert_allclose(covariance, known, atol=1e-9)
    np.testing.assert_allclose(mean, known @ r.columns.T @ r.data, atol=1e-7)


def regression(rng: np.random.Generator, rows: int = 80, parameters: int = 4) -> tuple[Array, Array]:
    X = rng.standard_normal((rows, parameters))
    return X, rng.poisson(np.exp(X @ np.array([0.8, -0.5, 0.3, 1.2]))).astype(np.float64)


@pytest.mark.parametrize("bound", [10.0, 0.6])
@pytest.mark.parametrize("seed", range(5))
def test_scoring_finds_the_optimum_that_another_search_finds(seed: int, bound: float) -> None:
    """Poisson regression, free and with the optimum on bounds, against L-BFGS-B."""
    X, y = regression(np.random.default_rng(seed))

    def evaluate(beta: Array) -> Place[Array]:
        rate = np.exp(X @ beta)
        return Place(beta, float(rate.sum() - y @ X @ beta), rate)

    def derivatives(place: Place[Array]) -> tuple[Array, Array]:
        return X.T @ (place.state - y), (X.T * place.state) @ X

    low, high = np.full(4, -bound), np.full(4, bound)
    found, evaluated = descend(
        evaluate,
        derivatives,
        evaluate(np.zeros(4)),
        low,
        high,
        iterations=50,
        tolerance=1e-10,
    )
    wanted = minimize(
        lambda b: (evaluate(b).value, derivatives(evaluate(b))[0]), np.zeros(4), jac=True, method="L-BFGS-B",
        bounds=list(zip(low, high, strict=True)), options={"ftol": 1e-14, "gtol": 1e-9},
    )  # fmt: skip
    np.testing.assert_allclose(found.x, wanted.x, atol=1e-4)
    assert found.value <= wanted.fun + 1e-8
    assert evaluated <= 30
    assert np.all((found.x >= low) & (found.x <= high))


def test_a_search_that_cannot_gain_stays() -> None:
    def evaluate(x: Array) -> Place[None]:
        return Place(x, float(x @ x), None)

    def derivatives(place: Place[None]) -> tuple[Array, Array]:
        return 2.0 * place.x, 2.0 * np.eye(2)

    start = evaluate(np.zeros(2))
    found, evaluated = descend(
        evaluate, derivatives, start, -np.ones(2), np.ones(2), iterations=9, tolerance=1e-6
    )
    assert found is start
    assert evaluated == 0
    corner = evaluate(np.ones(2))
    found, _ = descend(
        evaluate, derivatives, corner, np.ones(2), 2.0 * np.ones(2), iterations=9, tolerance=1e-6
    )
    assert found is corner


@pytest.mark.parametrize("count", [0, 1, 2, 37, 181])
def test_phasors_of_even_frequencies_are_those_of_any(count: int) -> None:
    t = np.random.default_rng(6).uniform(-200.0, 20.0, 300)
    even = (7 + np.arange(count)) * 0.0071
    np.testing.assert_allclose(phasors(t, even), np.exp(2j * np.pi * np.outer(t, even)), atol=1e-12)
    uneven = even**1.3
    np.testing.assert_allclose(phasors(t, uneven), np.exp(2j * np.pi * np.outer(t, uneven)), atol=1e-12)

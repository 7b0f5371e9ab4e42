"""Heave models: components, statistics, forecasts, the guard, and named results for series that carry nothing."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from threadpoolctl import threadpool_limits

from estimation import heave
from estimation.heave.series import cut_window

Array = NDArray[np.float64]

AHEAD = np.array([0.0, 0.5, 1.0, 2.0, 3.0])


def times(rng: np.random.Generator, span_s: float = 60.0, rate_hz: float = 16.0) -> Array:
    return np.sort(rng.uniform(0.0, span_s, int(span_s * rate_hz)))


def swell(t: Array) -> Array:
    return np.asarray(0.6 * np.sin(2 * np.pi * t / 7.0 + 0.3), np.float64)


def irregular(t: Array, seed: int) -> Array:
    """A narrow sea of 60 components around 4 s, standard deviation 0.15 m."""
    rng = np.random.default_rng(seed)
    f = np.linspace(0.15, 0.5, 60)
    power = np.exp(-0.5 * ((f - 0.25) / 0.05) ** 2)
    amplitude = 0.15 * np.sqrt(power / power.sum())
    phase = np.outer(t, 2 * np.pi * (f + rng.uniform(-0.003, 0.003, 60)))
    return np.asarray(
        np.cos(phase) @ (amplitude * rng.standard_normal(60))
        + np.sin(phase) @ (amplitude * rng.standard_normal(60)),
        np.float64,
    )


def fit_swell(seed: int = 0, **options: object) -> tuple[heave.HeaveModel, float]:
    rng = np.random.default_rng(seed)
    t = times(rng)
    measured = 5.0 + swell(t) + rng.normal(0, 0.03, len(t))
    return heave.fit(t, measured, 0.03, **options), float(t[-1])  # type: ignore[arg-type]


def test_a_wander_that_is_told_is_none_of_the_motion() -> None:
    """The series hangs on a vehicle that wanders as f^-4; the motion is judged, not the series."""

    def wander(f: Array) -> Array:
        return np.asarray(np.where(f < 0.055, 0.0, 5e-7 / f**4), np.float64)

    squares: dict[bool, list[float]] = {True: [], False: []}
    f = np.arange(0.06, 1.0, 0.01)
    for seed in range(24):
        rng = np.random.default_rng(seed)
        t = times(rng)
        phase = 2 * np.pi * np.outer(t, f)
        a, b = np.sqrt(wander(f) * 0.01) * rng.standard_normal((2, len(f)))
        seen = irregular(t, seed) + np.cos(phase) @ a + np.sin(phase) @ b + 0.03 * rng.standard_normal(len(t))
        for told in (True, False):
            mean, variance = heave.fit(t, seen, 0.03, wander=wander if told else None).forecast(np.zeros(1))
            squares[told].append(float((mean - irregular(t[-1:], seed))[0] ** 2 / variance[0]))
    assert 0.3 < np.mean(squares[True]) < 1.6
    assert np.mean(squares[False]) > 3.0


def test_a_fit_has_the_same_bytes_on_any_number_of_threads() -> None:
    """On two threads the likelihood's last bits differ, and the search ends some 1e-5 elsewhere."""
    rng = np.random.default_rng(3)
    t = times(rng)
    seen = irregular(t, 3) + 0.03 * rng.standard_normal(len(t))
    fitted = []
    for threads in (1, 2):
        with threadpool_limits(threads, user_api="blas"):
            fitted.append(heave.fit(t, seen, 0.03))
    np.testing.assert_array_equal(fitted[0].power_m2, fitted[1].power_m2)
    np.testing.assert_array_equal(fitted[0].forecast(AHEAD), fitted[1].forecast(AHEAD))


def test_regular_swell_is_described_and_forecast() -> None:
    model, last = fit_swell()
    truth = 5.0 + swell(last + AHEAD)
    mean, variance = model.forecast(AHEAD)
    assert np.sqrt(np.mean((mean - truth) ** 2)) < 0.08
    assert np.all(np.abs(mean - truth) < 4 * np.sqrt(variance))
    assert model.dominant_period_s == pytest.approx(7.0, rel=0.005)
    assert model.tp_s == pytest.approx(7.0, rel=0.05)
    assert model.level_m == pytest.approx(5.0, abs=0.02)
    assert model.hs_m == pytest.approx(4 * 0.6 / np.sqrt(2), rel=0.05)
    skill = model.skill(AHEAD)
    assert np.all(skill > 0.9)
    assert model.method == "bhr"
    assert model.reason == ""


def test_period_is_found_within_fifteen_seconds() -> None:
    for seed in range(3):
        rng = np.random.default_rng(seed)
        t = times(rng, 15.0)
        model = heave.fit(t, swell(t) + rng.normal(0, 0.05, len(t)), 0.05)
        assert model.dominant_period_s == pytest.approx(7.0, rel=0.03)


def test_the_period_of_a_swell_that_sets_in_is_not_too_long() -> None:
    rng = np.random.default_rng(21)
    t = np.arange(0.0, 15.0, 1.0 / 18.0)
    value = 0.6 * (1.0 - np.exp(-((t / 5.0) ** 2))) * np.sin(2.0 * np.pi * t / 7.0)
    model = heave.fit(t, value + 0.12 * rng.standard_normal(len(t)), 0.12, window_s=60.0)
    assert model.dominant_period_s == pytest.approx(7.0, rel=0.03)


def test_one_sinusoid_by_least_squares_is_found_exactly() -> None:
    model, last = fit_swell(method="sinusoids", components=1)
    (component,) = model.components
    assert component.amplitude_m == pytest.approx(0.6, abs=0.01)
    assert component.period_s == pytest.approx(7.0, rel=1e-3)
    expected = (2 * np.pi * last / 7.0 + 0.3) % (2 * np.pi)
    assert component.phase_rad % (2 * np.pi) == pytest.approx(expected, abs=0.02)
    rate, rate_variance = model.forecast_rate(AHEAD)
    truth = 0.6 * 2 * np.pi / 7.0 * np.cos(2 * np.pi * (last + AHEAD) / 7.0 + 0.3)
    assert rate == pytest.approx(truth, abs=0.01)
    assert np.all(rate_variance < 1e-3)


@pytest.mark.parametrize("method", ["bhr", "sinusoids"])
def test_components_add_up_to_the_forecast(method: str) -> None:
    model, _ = fit_swell(method=method)
    at = np.linspace(-20.0, 0.0, 30)
    c = model.coefficients
    slow = c.basis.values(at)[:, c.level] @ c.mean[c.level] + c.offset_m
    total = slow + sum(a * np.sin(2 * np.pi * at / period + phase) for a, period, phase in model.components)
    mean, _ = model.joint(at)
    assert mean[: len(at)] == pytest.approx(total, abs=1e-9)


def test_rate_is_the_derivative_of_heave_in_the_joint_forecast() -> None:
    model, _ = fit_swell()
    step = 1e-4
    mean, covariance = model.joint(np.array([1.0 - step, 1.0 + step]))
    rate, rate_variance = model.forecast_rate(1.0)
    assert (mean[1] - mean[0]) / (2 * step) == pytest.approx(float(rate), abs=1e-6)
    difference = (covariance[0, 0] + covariance[1, 1] - 2 * covariance[0, 1]) / (4 * step**2)
    assert difference == pytest.approx(float(rate_variance), rel=1e-3)
    assert np.linalg.eigvalsh(covariance).min() > -1e-9


def test_forecast_error_matches_its_variance_on_an_irregular_sea() -> None:
    z = []
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        t = times(rng, 60.0, 10.0)
        model = heave.fit(t, irregular(t, seed) + rng.normal(0, 0.03, len(t)), 0.03)
        mean, variance = model.forecast(AHEAD)
        z.append((mean - irregular(t[-1] + AHEAD, seed)) / np.sqrt(variance))
        assert model.sd_m == pytest.approx(0.15, rel=0.5)
    assert 0.5 < np.mean(np.square(z)) < 1.6
    assert np.mean(np.abs(z) < 1.96) > 0.85


def test_beyond_its_skill_the_mean_is_given_and_said() -> None:
    rng = np.random.default_rng(1)
    t = times(rng)
    model = heave.fit(t, irregular(t, 3) + rng.normal(0, 0.03, len(t)), 0.03)
    far = model.predict(np.array([0.5, 60.0]))
    assert far.fallback.tolist() == [False, True]
    assert far.mean_m[1] == pytest.approx(model.level_m, abs=0.02)
    assert far.variance_m2[1] >= model.sd_m**2
    assert far.skill[1] == 0.0
    every = model.predict(np.linspace(0, 50, 101))
    worst = model.sd_m**2 + model.level_sigma_m**2
    assert np.all(every.variance_m2[~every.fallback] <= 1.1 * worst)


def test_forecast_keeps_the_shape_of_the_horizon() -> None:
    model, _ = fit_swell()
    assert model.forecast(1.0)[0].shape == ()
    assert model.forecast([[1.0, 2.0]])[1].shape == (1, 2)
    assert float(model.forecast(1.0)[0]) == model.forecast([1.0])[0][0]
    with pytest.raises(ValueError, match="horizon_s"):
        model.forecast([math.nan])


def test_quiet_windows_are_more_likely_where_the_rate_is_small() -> None:
    model, last = fit_swell()
    starts = np.arange(0.0, 4.0, 0.1)
    probability = [model.quiescent(s, 0.3, rate_limit_mps=0.2) for s in starts]
    middle = last + starts + 0.15
    rate = np.abs(np.cos(2 * np.pi * middle / 7.0 + 0.3))
    assert probability[int(np.argmin(rate))] > 0.9
    assert probability[int(np.argmax(rate))] < 0.02
    assert model.quiescent(0.0, 60.0, rate_limit_mps=5.0) == 1.0
    band = model.quiescent(0.0, 1.0, rate_limit_mps=5.0, height_band_m=0.01)
    assert band < 0.05
    assert model.quiescent(1.0) == model.quiescent(1.0)
    with pytest.raises(ValueError, match="rate_limit_mps"):
        model.quiescent(0.0, rate_limit_mps=0.0)


def test_probability_of_a_quiet_window_is_calibrated() -> None:
    said, happened = [], []
    for seed in range(40):
        rng = np.random.default_rng(200 + seed)
        t = times(rng, 40.0, 10.0)
        model = heave.fit(t, irregular(t, seed) + rng.normal(0, 0.03, len(t)), 0.03)
        for start in np.arange(0.0, 5.0, 1.0):
            said.append(model.quiescent(start, 0.5, rate_limit_mps=0.2))
            fine = t[-1] + start + np.linspace(0, 0.5, 26)
            rate = np.gradient(irregular(fine, seed), fine)
            happened.append(float(np.all(np.abs(rate) < 0.2)))
    assert np.mean(said) == pytest.approx(np.mean(happened), abs=0.1)
    assert np.mean(np.square(np.array(said) - happened)) < 0.25


def test_a_refit_starts_warm_and_agrees() -> None:
    rng = np.random.default_rng(5)
    t = np.arange(0.0, 61.0, 0.05)
    measured = irregular(t, 5) + rng.normal(0, 0.03, len(t))
    first = heave.fit(t[t < 60], measured[t < 60], 0.03, window_s=45.0)
    cold = heave.fit(t, measured, 0.03, window_s=45.0)
    warm = heave.fit(t, measured, 0.03, window_s=45.0, previous=first)
    assert cold.learned is not None
    assert warm.learned is not None
    assert warm.learned.evaluations < cold.learned.evaluations
    assert warm.forecast(AHEAD)[0] == pytest.approx(cold.forecast(AHEAD)[0], abs=0.03)
    assert warm.hs_m == pytest.approx(cold.hs_m, rel=0.1)


def test_unmodelled_drift_of_the_observer_is_carried() -> None:
    """A slow drift of 0.1 m in 30 s must not ruin the forecast of the deck's height."""
    errors, plain = [], []
    for seed in range(8):
        rng = np.random.default_rng(300 + seed)
        t = np.arange(0.0, 61.0, 0.05)
        drift = np.cumsum(rng.normal(0, 0.02 * math.sqrt(0.05), len(t)))
        whole = irregular(t, seed) + drift
        seen = t <= 60.0
        model = heave.fit(t[seen], whole[seen] + rng.normal(0, 0.03, seen.sum()), 0.03)
        errors.append(float(model.forecast(1.0)[0]) - whole[-1])
        plain.append(whole[seen].mean() - whole[-1])
    assert np.sqrt(np.mean(np.square(errors))) < 0.6 * np.sqrt(np.mean(np.square(plain)))


@pytest.mark.parametrize(
    ("t", "value", "reason"),
    [
        ([1.0], [2.0], "one sample"),
        ([0.0, 1.0], [1.0, 2.0], "too few"),
        (list(np.linspace(0, 2, 100)), list(np.zeros(100)), "too few"),
        ([0.0] * 50, [1.0] * 50, "too few"),
        (list(np.arange(0, 400.0, 10.0)), list(np.zeros(40)), "too few"),
        (list(np.arange(0, 110.0, 5.0)), list(np.zeros(22)), "too far apart"),
    ],
)
def test_too_little_gives_the_mean_and_the_reason(t: list[float], value: list[float], reason: str) -> None:
    model = heave.fit(t, value, 0.1)
    assert model.method == "mean"
    assert reason in model.reason
    result = model.predict(AHEAD)
    assert np.all(result.fallback)
    assert np.all(np.isinf(result.variance_m2))
    assert result.mean_m == pytest.approx(np.mean(value[-12:]), abs=0.5)
    assert model.components == []
    assert math.isnan(model.tp_s)
    assert model.quiescent(0.0) == 0.0


def test_too_little_after_a_model_keeps_its_variance() -> None:
    before, _ = fit_swell()
    model = heave.fit([0.0], [4.0], 0.1, previous=before)
    mean, variance = model.forecast(2.0)
    assert float(mean) == 4.0
    assert float(variance) > before.sd_m**2


def test_mean_only_on_request() -> None:
    model, _ = fit_swell(method="mean")
    mean, variance = model.forecast(2.0)
    assert float(mean) == pytest.approx(5.0, abs=0.1)
    assert float(variance) == pytest.approx(0.18, rel=0.4)
    assert np.all(model.predict(AHEAD).fallback)


def test_no_motion_is_no_heave() -> None:
    rng = np.random.default_rng(6)
    t = times(rng)
    still = heave.fit(t, 1.0 + rng.normal(0, 0.03, len(t)), 0.03)
    assert still.hs_m < 0.03
    mean, variance = still.forecast(AHEAD)
    assert mean == pytest.approx(np.ones(len(AHEAD)), abs=0.01)
    assert np.all(np.sqrt(variance) < 0.01)
    assert still.quiescent(0.0, 5.0, rate_limit_mps=0.1) > 0.95
    for sigma in (0.03, 1e-3, 1e-5, 1e-8):
        constant = heave.fit(t, np.full(len(t), 2.5), sigma)
        assert constant.forecast(1.0)[0] == pytest.approx(2.5, abs=1e-6)
        assert np.all(np.isfinite(constant.forecast(AHEAD)[1]))
        assert constant.sd_m < max(sigma, 1e-5)


def test_gap_nan_trend_and_wrong_sigma_do_not_diverge() -> None:
    rng = np.random.default_rng(7)
    t = times(rng)
    clean = swell(t) + rng.normal(0, 0.03, len(t))
    truth = swell(t[-1] + AHEAD)
    gap = (t < 20) | (t > 42)
    holes = np.where(rng.random(len(t)) < 0.4, np.nan, clean)
    cases = {
        "gap": heave.fit(t[gap], clean[gap], 0.03),
        "nan": heave.fit(t, holes, 0.03),
        "spiky sigma": heave.fit(t, clean, np.where(rng.random(len(t)) < 0.3, 3.0, 0.03)),
        "sigma ten times too small": heave.fit(t, clean, 0.003),
        "sigma ten times too large": heave.fit(t, clean, 0.3),
    }
    scale = {"sigma ten times too small": 10.0, "sigma ten times too large": 0.1}
    for name, model in cases.items():
        mean, variance = model.forecast(AHEAD)
        assert np.max(np.abs(mean - truth)) < 0.2, name
        assert model.noise_scale == pytest.approx(scale.get(name, 1.0), rel=0.3), name
        assert np.all(variance > 0), name
    assert cases["nan"].dropped == np.isnan(holes).sum()
    trend = heave.fit(t, clean + 0.05 * t, 0.03)
    mean, _ = trend.forecast(AHEAD)
    assert np.max(np.abs(mean - truth - 0.05 * (t[-1] + AHEAD))) < 0.2


@pytest.mark.parametrize(
    ("t", "value", "sigma", "options", "named"),
    [
        ([0.0, 2.0, 1.0], [0.0, 0.0, 0.0], 0.1, {}, "t_s: must be oldest first"),
        ([0.0, 1.0], [0.0], 0.1, {}, "heave_m: shape"),
        ([0.0, 1.0], [0.0, 1.0], [0.1, 0.1, 0.1], {}, "sigma_m: shape"),
        ([0.0, 1.0], [0.0, 1.0], 0.0, {}, "sigma_m: must be positive"),
        ([0.0, 1.0], [math.nan, math.nan], 0.1, {}, "heave_m: no finite sample"),
        ([], [], 0.1, {}, "heave_m: no finite sample"),
        ([0.0, 1.0], [0.0, 1.0], 0.1, {"method": "magic"}, "method: 'magic'"),
        ([0.0, 1.0], [0.0, 1.0], 0.1, {"components": 0}, "components"),
        ([0.0, 1.0], [0.0, 1.0], 0.1, {"window_s": -1.0}, "window_s"),
    ],
)
def test_unusable_arguments_are_named(
    t: list[float], value: list[float], sigma: object, options: dict[str, object], named: str
) -> None:
    with pytest.raises(ValueError, match=named):
        heave.fit(t, value, sigma, **options)  # type: ignore[arg-type]


def test_window_keeps_the_information_of_its_samples() -> None:
    rng = np.random.default_rng(8)
    t = times(rng, 150.0)
    window = cut_window(t, np.ones(len(t)), 0.1, window_s=60.0)
    assert window.samples == np.sum(t >= t[-1] - 60.0)
    assert np.sum(1 / window.variance_m2) == pytest.approx(window.samples / 0.01)
    assert window.time_s[-1] <= 0
    assert np.all(np.diff(window.time_s) > 0)


@pytest.mark.parametrize(("size", "sigma"), [(1e6, 1e-3), (1e-9, 1e-3), (1.0, 1e-9)])
def test_extreme_ratios_of_motion_to_noise_are_solved(size: float, sigma: float) -> None:
    rng = np.random.default_rng(9)
    t = times(rng, 30.0)
    model = heave.fit(t, size * swell(t), sigma)
    mean, variance = model.forecast(AHEAD)
    assert np.all(np.isfinite(mean))
    assert np.all(variance > 0)
    assert np.max(np.abs(mean - size * swell(t[-1] + AHEAD))) < 0.5 * size + 4 * sigma


def test_a_small_sea_is_seen_beside_a_slow_wander_and_in_large_noise() -> None:
    """2.5 cm of short waves in 12 cm of noise, and a wander of 20 cm as an altimeter has: nothing hides the rate."""
    t = np.arange(0.0, 50.0, 0.05)
    wander = 0.2 * np.sin(2.0 * np.pi * t / 70.0)
    ratios = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        f = rng.normal(0.6, 0.06, 40)
        waves = np.sin(2.0 * np.pi * np.outer(t, f) + rng.uniform(0.0, 2.0 * np.pi, 40)).sum(axis=1)
        waves *= 0.025 / waves.std()
        model = heave.fit(t, waves + wander + 0.12 * rng.normal(size=len(t)), 0.12, window_s=60.0)
        rate = math.sqrt(model.coefficients.rate_variance_m2ps2)
        ratios.append(rate / float(np.gradient(waves, t).std()))
        assert model.sd_m < 0.07
    assert np.median(ratios) == pytest.approx(1.0, abs=0.4)
    assert min(ratios) > 0.6
    assert max(ratios) < 2.0


def test_motion_that_was_not_seen_to_come_back_is_drift() -> None:
    """A third of a slow swing fits any wave: it must not become one, of any height."""
    rng = np.random.default_rng(6)
    t = np.arange(0.0, 10.0, 0.1)
    swing = 0.5 * np.sin(2.0 * np.pi * t / 30.0)
    model = heave.fit(t, swing + 0.02 * rng.normal(size=len(t)), 0.02)
    assert model.sd_m < 0.1
    assert model.level_m == pytest.approx(swing[-1], abs=0.1)

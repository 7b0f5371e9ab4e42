"""Forecasting a series as it went: at many moments a model of the past, held against what then came."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deckfix.forecasts import HORIZONS_S, Forecasts, Scores, forecasts, judge
from deckfix.heave_series import HeaveSeries
from deckfix.reference import LONGEST_BRIDGE_S, Column, column
from deckfix.terminal import tracked
from estimation.heave.model import HeaveModel, Method, fit
from estimation.heave.spectrum import SpectrumSettings

Array = NDArray[np.float64]

MOST_ORIGINS = 60
LEAST_PAST_S = 20.0


@dataclass(frozen=True, slots=True)
class Fitting:
    """How models are fitted: the window [s], the method, its number of sinusoids, the band."""

    window_s: float
    method: Method = "bhr"
    components: int = 3
    settings: SpectrumSettings | None = None

    def fit(self, series: HeaveSeries, until_s: float) -> HeaveModel:
        """Return the model of the samples up to a time; raises ValueError where there is none that is finite."""
        past = series.t_s <= until_s
        return fit(
            series.t_s[past], series.heave_m[past], series.sigma_m[past], method=self.method,
            components=self.components, window_s=self.window_s, settings=self.settings,
        )  # fmt: skip


@dataclass(frozen=True, slots=True)
class Backtest:
    """Models at moments spread over a series, their forecasts, and how these did (None: nothing to judge)."""

    made: Forecasts
    scores: Scores | None
    hs_m: float
    tp_s: float


def backtest(series: HeaveSeries, fitting: Fitting, most: int = MOST_ORIGINS) -> Backtest:
    """Return the forecasts from up to ``most`` moments, evenly spread, each from its own past alone.

    ``hs_m`` is four times the scatter of the samples about a straight line, ``tp_s`` the peak period of the mean of the
    models' spectra: what the series is as a whole.
    """
    first, last = min(fitting.window_s, 0.5 * series.span_s), series.span_s
    models: list[tuple[int, HeaveModel]] = []
    if series.span_s - first > 0.0 and first >= LEAST_PAST_S:
        moments = np.linspace(first, last, max(2, min(most, int((last - first) / HORIZONS_S[1]) + 1)))
        for moment in tracked(moments, "forecasting", len(moments)):
            model = fitting.fit(series, float(moment))
            models.append((0, model))
    made = forecasts(models)
    seen = continuous(series)
    scores = judge(made, seen, "series") if len(made) and seen is not None else None
    return Backtest(made, scores, height(series), peak_period_s([model for _, model in models]))


def height(series: HeaveSeries) -> float:
    """Return four times the scatter of the samples about a straight line, less that of their stated noise [m]."""
    finite = np.isfinite(series.heave_m)
    t, value = series.t_s[finite], series.heave_m[finite]
    if len(t) < 3 or not t[-1] > t[0]:
        return float("nan")
    left = value - np.polynomial.Polynomial.fit(t, value, 1)(t)
    sigma = series.sigma_m[finite & np.isfinite(series.sigma_m)] if series.given_sigma else np.zeros(1)
    noise = float(np.mean(sigma**2)) if len(sigma) else 0.0
    return 4.0 * float(np.sqrt(max(0.0, float(np.mean(left**2)) - noise)))


def peak_period_s(models: list[HeaveModel]) -> float:
    """Return the period of the peak of the mean of learned spectra [s], as in ``HeaveModel.tp_s``; else NaN."""
    learned = [m for m in models if m.learned is not None]
    if not learned:
        tps = [m.tp_s for m in models if np.isfinite(m.tp_s)]
        return float(np.median(tps)) if tps else float("nan")
    grid = learned[-1].frequency_hz
    mean = np.mean([np.interp(grid, m.frequency_hz, m.density_m2ps) for m in learned], axis=0)
    near = mean >= 0.7 * mean.max()
    return float(mean[near].sum() / (mean[near] @ grid[near]))


def continuous(series: HeaveSeries) -> Column | None:
    """Return the series between its samples, by straight lines that do not bridge more than 2.5 intervals."""
    finite = np.isfinite(series.heave_m)
    t, value = series.t_s[finite], series.heave_m[finite]
    if len(t) < 2 or not series.interval_s > 0:
        return None
    grid = np.union1d(np.arange(t[0], t[-1], 0.4 * LONGEST_BRIDGE_S), t)
    right = np.searchsorted(t, grid).clip(1, len(t) - 1)
    near = t[right] - t[right - 1] <= 2.5 * series.interval_s
    ns = np.round(grid * 1e9).astype(np.int64)
    return column(ns, np.where(near, np.interp(grid, t, value), np.nan)[:, None])

"""Figures of heave: spectrum, fit and forecast, forecasts against what happened, skill, quiet windows.

They take models and arrays, so that the report of a flight and the page of a series draw alike. Heave is positive up.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from deckfix.forecasts import WIDTH_95, Forecasts, Scores
from deckfix.plotting import (
    AUTOPILOT,
    AXES,
    GREY,
    OURS,
    TRUTH,
    Array,
    Figure,
    Trace,
    axis,
    band,
    layout,
    limits,
    line,
    points,
    rgba,
    stacked,
)
from deckfix.reference import Column
from estimation.heave.model import HeaveModel

SHOWN_HORIZONS_S = (1.0, 2.0, 3.0)
AHEAD_S = 8.0
BEHIND_S = 40.0
WHISKERS = rgba(AXES[1], 0.45)


def spectrum(model: HeaveModel) -> Figure:
    """Return the learned spectral density over the frequency, with the noise's and the peak."""
    frequency = model.frequency_hz
    data: list[Trace] = []
    if model.learned is not None and len(frequency) > 1:
        density = model.density_m2ps
        data += band(frequency, np.zeros_like(density), density, "heave", 1, legend=False)
        data.append(line(frequency, density, "heave", OURS, 1, width=1.8))
        noise = np.full(len(frequency), model.noise_density_m2ps)
        data.append(line(frequency, noise, "noise of the measurements", AUTOPILOT, 1, dash="dash"))
        total = np.cumsum(density) / density.sum()
        end = float(frequency[min(int(np.searchsorted(total, 0.999)) + 1, len(frequency) - 1)])
        top, title = 1.08 * float(density.max()), "spectral density [m²/Hz]"
    else:
        components = model.components
        at = np.array([1.0 / c.period_s for c in components])
        height = np.array([c.amplitude_m for c in components])
        data.append(points(at, height, "amplitude", OURS, 1, size=9))
        end = 1.3 * float(at.max()) if len(at) else 1.0
        top, title = (1.2 * float(height.max()) if len(at) else 1.0), "amplitude [m]"
    shapes = []
    if np.isfinite(model.tp_s):
        shapes.append(
            {
                "type": "line", "xref": "x", "yref": "y domain", "x0": 1.0 / model.tp_s,
                "x1": 1.0 / model.tp_s, "y0": 0, "y1": 1, "line": {"color": GREY, "width": 1, "dash": "dash"},
            }
        )  # fmt: skip
    axes = {
        "xaxis": axis("frequency [Hz]; dashed: the peak", range=[0.0, end]),
        "yaxis": axis(title, range=[0.0, max(top, 1e-9)]),
    }
    return {"data": data, "layout": layout(340, shapes=shapes, **axes)}


def fit_and_forecast(
    model: HeaveModel, t_s: Array, heave_m: Array, later_s: Array | None = None, later_m: Array | None = None
) -> Figure:
    """Return the samples, the model through them and what it says of the seconds ahead, with its 95 % band.

    ``t_s`` (n,) count from the model's last sample (so <= 0); ``later_s``, ``later_m`` (m,) are what came then.
    """
    behind = max(-BEHIND_S, -model.span_s) if model.span_s > 0 else -BEHIND_S
    times = np.concatenate([np.arange(behind, 0.0, 0.05), np.arange(0.0, AHEAD_S + 0.01, 0.05)])
    said = model.predict(times)
    sigma = WIDTH_95 * np.sqrt(said.variance_m2)
    known = np.isfinite(sigma)
    past, ahead = known & (times <= 0.0), known & (times >= 0.0)
    shown = (t_s >= behind) & np.isfinite(heave_m)
    data: list[Trace] = [points(t_s[shown], heave_m[shown], "samples", GREY, 1, size=4, opacity=0.6)]
    low, high = said.mean_m - sigma, said.mean_m + sigma
    data += band(times[ahead], low[ahead], high[ahead], "95 % of the forecast", 1, colour=AXES[1])
    data.append(line(times[past], said.mean_m[past], "fit", OURS, 1, width=1.8))
    data.append(line(times[ahead], said.mean_m[ahead], "forecast", AXES[1], 1, width=2.2))
    values = [heave_m[shown], low[ahead], high[ahead]]
    if later_s is not None and later_m is not None:
        soon = (later_s > 0.0) & (later_s <= AHEAD_S) & np.isfinite(later_m)
        data.append(line(later_s[soon], later_m[soon], "what then happened", TRUTH, 1, dash="dot"))
        values.append(later_m[soon])
    now = {
        "type": "line", "xref": "x", "yref": "y domain", "x0": 0, "x1": 0, "y0": 0, "y1": 1,
        "line": {"color": GREY, "width": 1, "dash": "dash"},
    }  # fmt: skip
    axes = {
        "xaxis": axis("seconds from the last sample", range=[behind, AHEAD_S]),
        "yaxis": axis("heave [m, up]", **_range(limits(*values, share=100.0))),
    }
    return {"data": data, "layout": layout(380, shapes=[now], **axes)}


def against_what_happened(
    made: Forecasts, seconds: Array, happened_s: Array, happened_m: Array, name: str, end_s: float
) -> Figure:
    """Return forecasts at 1, 2 and 3 s with their 95 % bands, at the times that they speak of.

    ``seconds`` (n,) are the origins of the forecasts, ``happened_s``, ``happened_m`` (m,) what came, called ``name``.
    """
    data: list[Trace] = []
    titles, ranges = [], []
    for row, horizon in enumerate(SHOWN_HORIZONS_S, start=1):
        k = int(np.argmin(np.abs(made.horizon_s - horizon)))
        t, mean = seconds + made.horizon_s[k], made.heave_m[:, k]
        sigma = WIDTH_95 * made.sigma_m[:, k]
        known = np.isfinite(sigma)
        t, mean, sigma = t[known], mean[known], sigma[known]
        data.append(line(happened_s, happened_m, name, TRUTH, row, legend=row == 1, width=1.1))
        whiskers = {
            "type": "data", "array": sigma.astype(np.float32), "thickness": 1, "width": 0,
            "color": WHISKERS,
        }  # fmt: skip
        made_points = points(t, mean, "forecast ± 95 %", AXES[1], row, legend=row == 1, size=4.5)
        if len(t) > 2 * 800:
            whiskers = {}
        data.append(made_points | ({"error_y": whiskers} if whiskers else {}))
        titles.append(f"{horizon:g} s ahead [m]")
        ranges.append(limits(happened_m, mean - sigma, mean + sigma, share=99.8))
    return {"data": data, "layout": layout(520, **stacked(titles, ranges, end_s))}


def scatter(made: Forecasts, happened: Column) -> Figure:
    """Return forecasts at 1, 2 and 3 s over what happened, with their 95 % intervals, around the line of equality."""
    data: list[Trace] = []
    axes: dict[str, Any] = {}
    reach = limits(happened.values[:, 0], share=100.0) or (-1.0, 1.0)
    for i, horizon in enumerate(SHOWN_HORIZONS_S):
        k = int(np.argmin(np.abs(made.horizon_s - horizon)))
        seen = happened.at(made.origin_ns + round(made.horizon_s[k] * 1e9))[:, 0]
        known = np.isfinite(seen) & np.isfinite(made.sigma_m[:, k])
        mean, sigma = made.heave_m[known, k], WIDTH_95 * made.sigma_m[known, k]
        ends = np.array(reach)
        data.append(line(ends, ends, "equal", GREY, i + 1, legend=i == 0, width=1, dash="dot"))
        whiskers = {
            "type": "data", "array": sigma.astype(np.float32), "thickness": 1, "width": 0,
            "color": WHISKERS,
        }  # fmt: skip
        dots = points(seen[known], mean, "forecast ± 95 %", AXES[1], i + 1, legend=i == 0, size=5)
        data.append(dots | {"error_y": whiskers})
        suffix = "" if i == 0 else str(i + 1)
        left = i * 0.355
        title = f"what came {horizon:g} s later [m]"
        axes[f"xaxis{suffix}"] = axis(
            title, domain=[left, left + 0.29], anchor=f"y{suffix}", range=list(reach)
        )
        axes[f"yaxis{suffix}"] = axis("forecast [m]" if i == 0 else "", anchor=f"x{suffix}")
    return {"data": data, "layout": layout(380, hovermode="closest", **axes)}


def skill(made: Forecasts, scores: Scores | None) -> Figure:
    """Return over the horizon: the error of forecast and level and the stated sigma; the skill stated and found."""
    h = made.horizon_s
    finite = np.isfinite(made.sigma_m)
    with np.errstate(invalid="ignore"):
        squares = np.where(finite, made.sigma_m, np.nan) ** 2
        stated = np.sqrt(_columns_mean(squares))
    told = _columns_mean(np.where(finite, made.skill, np.nan))
    data: list[Trace] = [_marked(h, stated, "stated sigma, rms", AXES[1], 1, dash="dash")]
    shown = [stated]
    if scores is not None:
        happened = {"truth": "truth", "estimate": "later estimate", "series": "series"}[scores.against]
        data.append(_marked(h, scores.rmse_m, f"forecast's error against the {happened}, rms", OURS, 1))
        data.append(_marked(h, scores.level_rmse_m, "the level's alone, rms", GREY, 1))
        shown += [scores.rmse_m, scores.level_rmse_m]
        with np.errstate(invalid="ignore", divide="ignore"):
            found = 1.0 - (scores.rmse_m / scores.level_rmse_m) ** 2
        data.append(_marked(h, found, "skill found", OURS, 2))
    data.append(_marked(h, told, "skill stated, mean", AXES[1], 2, dash="dash"))
    top = limits(*shown, share=100.0)
    axes = {
        "xaxis": axis("horizon [s]", domain=[0.0, 0.45], anchor="y"),
        "yaxis": axis(
            "error [m]", anchor="x", rangemode="tozero", **({"range": [0.0, top[1]]} if top else {})
        ),
        "xaxis2": axis("horizon [s]", domain=[0.55, 1.0], anchor="y2"),
        "yaxis2": axis("skill (1: perfect, 0: the level)", anchor="x2", range=[-0.25, 1.05]),
    }
    zero = {
        "type": "line", "xref": "x2 domain", "yref": "y2", "x0": 0, "x1": 1, "y0": 0, "y1": 0,
        "line": {"color": GREY, "width": 1, "dash": "dot"},
    }  # fmt: skip
    figure = layout(380, shapes=[zero], **axes)
    figure["margin"]["t"] = 64
    return {"data": data, "layout": figure}


def windows(made: Forecasts, seconds: Array, end_s: float) -> Figure:
    """Return the probability of a quiescent window that begins at once, in 1 s and in 3 s, over time."""
    data: list[Trace] = []
    for i, horizon in enumerate((0.0, 1.0, 3.0)):
        k = int(np.argmin(np.abs(made.horizon_s - horizon)))
        name = "at once" if horizon == 0 else f"in {horizon:g} s"
        data.append(line(seconds, made.window_probability[:, k], name, AXES[i], 1, width=1.5, shape="hv"))
    axes = stacked(["probability"], [(0.0, 1.02)], end_s)
    return {"data": data, "layout": layout(280, **axes)}


def _marked(x: Array, y: Array, name: str, colour: str, axes: int, **style: Any) -> Trace:
    trace = line(x, y, name, colour, axes, **style)
    return trace | {"mode": "lines+markers", "marker": {"size": 6, "color": colour}}


def _columns_mean(values: Array) -> Array:
    """Return the mean of each column over what is finite (NaN where nothing is)."""
    count = np.isfinite(values).sum(axis=0)
    total = np.nansum(values, axis=0)
    mean: Array = np.where(count > 0, total / np.maximum(count, 1), np.nan)
    return mean


def _range(found: tuple[float, float] | None) -> dict[str, Sequence[float]]:
    return {} if found is None else {"range": list(found)}

"""The report's sections of the platform: where it is, how it heaves, and what was forecast of it."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from deckfix import deck_figures, heave_figures
from deckfix.deck_reference import fused_fixes_ns, height_seen_later, true_height
from deckfix.forecasts import FEWEST, QUIET_RATE_MPS, QUIET_S, Forecasts, Scores, origin_ns
from deckfix.page import Plots, table, text
from deckfix.reference import rms
from deckfix.result import Result
from estimation.heave.model import HeaveModel

Array = NDArray[np.float64]

SHOWN_COMPONENTS = 8


def platform(result: Result, plots: Plots) -> str:
    """Return the section of the platform; empty where none was seen."""
    if not result.has_deck:
        return ""
    errors = result.deck_errors
    about = (
        "Relative position is the vehicle's less the platform's, north, east, down: its third component is negative "
        "above the deck. Grey dots are the vision fixes as they came, turned by the estimated attitude."
    )
    if errors is not None:
        about += " Shown are errors against the truth, with nothing taken off them."
    out = [f'<p class="lead">{about}</p>', _relative_table(result)]
    out.append(plots.place(deck_figures.relative(result), "Relative position over time"))
    level = np.sqrt(max(0.0, float(result.run.deck_covariance[-1, 6, 6])))
    about = (
        "Above the origin, positive up. The band is that of the distance below the vehicle; the level itself hangs on "
        f"GPS and barometer and is known to ±{3.0 * level:.1f} m (3 sigma) at the end."
    )
    if result.platform is not None:
        about += " The truth is put on the estimate's level."
    out.append(f'<h3>Height of the deck</h3><p class="lead">{about}</p>')
    out.append(plots.place(deck_figures.deck_height(result), "Height and rate of the deck over time"))
    return "".join(out)


def clocks(result: Result, plots: Plots) -> str:
    """Return the section of the clocks over time; empty where there is but one."""
    if not result.clocks and not result.has_deck:
        return ""
    out = [
        '<p class="lead">Offset: the other clock less the inertial one; the plot shows it less its last value. '
        "Latency: the age of a fix at its stamp. <b>Positive means that the content is older than its stamp</b>: "
        "content time = stamp - latency.</p>"
    ]
    rows = []
    for name, told in result.clocks.items():
        cells = [
            _told(told, "offset_ms", "ms"),
            _told(told, "sigma_ms", "ms"),
            _told(told, "skew_ppm", "ppm"),
        ]
        rows.append(("", [text(name), *cells, text(told.get("status", "")), text(told.get("source", ""))]))
    latency = deck_figures.latency_track(result)
    if latency is not None:
        status = next((str(c["latency_status"]) for c in result.clocks.values() if "latency_status" in c), "")
        _, value, sigma = latency
        cells = [f"{value[-1]:.1f} ms", f"{sigma[-1]:.1f} ms", "", text(status), "the filter's own state"]
        rows.append(("", ["latency of fixes", *cells]))
    heads = ("clock", "at the end", "1 sigma", "skew", "status", "rests on")
    out.append(table(heads, rows, numeric=(1, 2, 3)))
    if result.clock_tracks or latency is not None:
        out.append(plots.place(deck_figures.clocks(result), "Clock offsets and latency over time"))
    return "".join(out)


def heave(result: Result, plots: Plots) -> str:
    """Return the section of the heave and its forecasts; empty where no model was learned."""
    if not result.run.heave:
        return ""
    due, model = result.run.heave[-1]
    made = result.forecasts
    seconds = result.seconds_of(made.origin_ns)
    out = [
        f'<p class="lead">{len(made)} models were learned from the fixes, one after another; this is the last, at '
        f"{result.seconds(origin_ns(due, model)):.1f} s.</p>",
        model_table(model),
    ]
    height = height_seen_later(result.run)
    if model.method != "mean" and height is not None:
        t = np.asarray((height.t_ns - origin_ns(due, model)) * 1e-9, np.float64)
        fit = heave_figures.fit_and_forecast(model, t[t <= 0][::5], height.values[t <= 0, 0][::5])
        out.append('<div class="pair">')
        out.append(
            f"<div><h3>Spectrum</h3>{plots.place(heave_figures.spectrum(model), 'Spectrum of the heave')}</div>"
        )
        out.append(
            f"<div><h3>Fit and forecast</h3>{plots.place(fit, 'Fit and forecast of the heave')}</div></div>"
        )
    out.append(component_table(model))
    happened = true_height(result.run, result.platform) if result.platform is not None else height
    if len(made) >= FEWEST and happened is not None:
        name = "truth" if result.platform is not None else "later estimate"
        s = result.seconds_of(happened.t_ns)
        figure = heave_figures.against_what_happened(
            made, seconds, s, happened.values[:, 0], name, result.duration_s
        )
        out.append(
            "<h3>Forecasts against what happened</h3>"
            '<p class="lead">Each forecast at the time that it speaks of, with its 95 % interval.</p>'
        )
        out.append(plots.place(figure, "Forecasts against what happened"))
        out.append(forecast_section(made, result.forecast_scores, plots))
        out.append(
            f'<h3>Quiet windows</h3><p class="lead">Probability that the deck\'s rate stays below {QUIET_RATE_MPS:g} '
            f"m/s for {QUIET_S:g} s, by the time that the window begins.</p>"
        )
        out.append(
            plots.place(heave_figures.windows(made, seconds, result.duration_s), "Quiet windows over time")
        )
    return "".join(out)


def forecast_section(made: Forecasts, scores: Scores | None, plots: Plots) -> str:
    """Return the skill over the horizon, as a figure and a table."""
    out = [
        '<h3>Skill over horizon</h3><p class="lead">Skill is 1 less the squared error over that of the level alone. An '
        "honest forecast's error equals the sigma that it states, and 95 % of what happens lies in its interval.</p>",
        plots.place(heave_figures.skill(made, scores), "Skill over horizon"),
    ]
    if scores is not None:
        rows = []
        for k, h in enumerate(scores.horizon_s):
            if scores.count[k] < FEWEST:
                continue
            fallback = float(np.mean(made.fallback[:, k]))
            cells = [
                f"{h:g} s", f"{scores.count[k]:,}", f"{100 * scores.rmse_m[k]:.1f} cm",
                f"{100 * scores.level_rmse_m[k]:.1f} cm", f"{100 * scores.coverage_95[k]:.0f} %",
                f"{100 * fallback:.0f} %",
            ]  # fmt: skip
            rows.append(("", cells))
        heads = (
            "horizon",
            "forecasts",
            "rms error",
            "of the level alone",
            "inside 95 %",
            "level given instead",
        )
        out.append(table(heads, rows, numeric=tuple(range(6))))
    return "".join(out)


def model_table(model: HeaveModel) -> str:
    """Return a model's statistics as a row of figures."""
    cells = [
        ("significant height Hs", _metres(model.hs_m)),
        ("peak period Tp", _seconds(model.tp_s)),
        ("dominant period", _seconds(model.dominant_period_s)),
        ("level", f"{model.level_m:.3f} m <small>± {model.level_sigma_m:.3f}</small>"),
        ("learned from", f"{model.samples:,} samples <small>{model.span_s:.0f} s</small>"),
        ("method", text(model.method)),
    ]
    facts = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in cells)
    reason = (
        f'<p class="lead">Only the level could be given: {text(model.reason)}.</p>' if model.reason else ""
    )
    return f'<dl class="figures">{facts}</dl>{reason}'


def component_table(model: HeaveModel) -> str:
    """Return the largest components of a model, as Z(t) = level + sum of A sin(2 pi t / T + phi)."""
    largest = sorted(model.components, key=lambda c: -c.amplitude_m)[:SHOWN_COMPONENTS]
    if not largest:
        return ""
    rows = [
        ("", [str(i), f"{c.amplitude_m:.4f} m", f"{c.period_s:.3f} s", f"{c.phase_rad:+.3f} rad"])
        for i, c in enumerate(largest, start=1)
    ]
    count = len(model.components)
    about = f"The {len(largest)} largest of {count} components" if count > len(largest) else "The components"
    if model.learned is not None:
        about += "; on a dense grid their sum counts, not any one of them"
    return (
        f'<h3>Components</h3><p class="lead">{about}. Z(t) = level + Σ A sin(2π t / T + φ), t from the last sample.</p>'
        + table(("", "A", "T", "φ"), rows, numeric=(1, 2, 3))
    )


def _relative_table(result: Result) -> str:
    errors, fixes = result.deck_errors, result.fixes
    if errors is None:
        return ""
    fused = fused_fixes_ns(result.run)
    rows = []
    inside = errors.judged.inside(errors.relative.t_ns)
    ours = errors.relative.position_m[inside]
    cells = _rms_cells(ours)
    if cells:
        rows.append(("", ["deckfix", *cells]))
    if fixes is not None and len(fused):
        raw = deck_figures.fix_errors(result)
        if raw is not None:
            cells = _rms_cells(raw[errors.judged.inside(fixes.t_ns)])
            if cells:
                rows.append(("", ["raw fixes", *cells]))
    heave_rms = rms(errors.heave_m[inside])
    note = ""
    if heave_rms is not None:
        note = f" Heave, the deck's height less its level and slow drift: {100 * heave_rms:.1f} cm rms."
    start, end = result.seconds(errors.judged.start_ns), result.seconds(errors.judged.end_ns)
    heads = ("rms error", "north", "east", "down", "horizontal", "3-D")
    return (
        table(heads, rows, numeric=(1, 2, 3, 4, 5))
        + f'<p class="lead">Between {start:.1f} s (5 s after the first fix) and {end:.1f} s.{note}</p>'
    )


def _rms_cells(errors: Array) -> list[str]:
    errors = errors[np.isfinite(errors).all(axis=1)]
    if not len(errors):
        return []
    square = np.mean(errors**2, axis=0)
    values = [*np.sqrt(square), np.sqrt(square[:2].sum()), np.sqrt(square.sum())]
    return [f"{v:.3f} m" for v in values]


def _told(values: dict[str, Any], key: str, unit: str) -> str:
    """Return a number of a clock's block, or that it is unknown."""
    value = values.get(key)
    return f"{value:,.3f} {unit}" if isinstance(value, float) else "unknown"


def _metres(value: float) -> str:
    return f"{value:.3f} m" if np.isfinite(value) else "unknown"


def _seconds(value: float) -> str:
    return f"{value:.2f} s" if np.isfinite(value) else "unknown"

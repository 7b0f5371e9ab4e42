"""``deckfix heave``: how a deck heaves and what it will do next, from a flight or from a series."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import msgspec
import numpy as np

from deckfix.commands import finite, write_text
from deckfix.files import InputError, check_output, existing
from deckfix.forecasts import FEWEST, QUIET_RATE_MPS, QUIET_S, Forecasts, Scores, forecasts
from deckfix.heave_series import Choice, HeaveSeries, read_series
from deckfix.terminal import printable, working

if TYPE_CHECKING:
    from deckfix.backtest import Backtest, Fitting
    from deckfix.result import Result
    from estimation.estimator import EngineName
    from estimation.heave.model import HeaveModel

_MCAP = b"\x89MCAP"
SHOWN = 8


def is_log(path: str | Path) -> bool:
    """Return whether a file is an MCAP log, by its first bytes; raises ``InputError`` where it cannot be read."""
    with existing(path).open("rb") as file:
        return file.read(5) == _MCAP


def heave_of_flight(
    file: str, *, page: str | None, json_path: str | None, config: str | None, engine: str, force: bool
) -> str:
    """Return what there is to say of the heave of a flight's platform; writes page and summary as asked."""
    from deckfix.replaying import configuration, open, replay

    inputs = [file, *([config] if config else [])]
    _check_outputs(page, json_path, force, inputs)
    flight = open(file)
    settings, source = configuration(flight, config)
    settings = msgspec.structs.replace(
        settings, platform=msgspec.structs.replace(settings.platform, use=True)
    )
    with working(f"replaying {Path(file).name}"):
        result = replay(flight, settings, cast("EngineName", engine))
    result.config_source = source
    if not result.has_deck:
        raise InputError(
            f"{file}: no vision fix of a platform could be fused; import a log that holds vision fixes"
        )
    if not result.run.heave:
        raise InputError(
            f"{file}: its fixes are too few for a heave model; hover over the target for 20 s or more"
        )
    model = result.run.heave[-1][1]
    block: dict[str, Any] = {"flight": result.flight, **result.summary()["heave"]}
    block |= _ahead(result.forecasts, model)
    document = _document(block)
    if page:
        write_text(page, flight_page(result), force=force, inputs=inputs)
    if json_path and json_path != "-":
        write_text(json_path, document, force=force, inputs=inputs)
    if json_path == "-":
        return document.rstrip("\n")
    said = f"{result.flight}: {len(result.run.heave)} models; the last:"
    return _finish([said, *told(model, result.forecasts, result.forecast_scores)], page, json_path)


def heave_of_series(
    file: str,
    choice: Choice,
    fitting: Fitting,
    *,
    page: str | None,
    json_path: str | None,
    force: bool,
) -> str:
    """Return what there is to say of a series; writes page and summary as asked."""
    from deckfix.backtest import backtest

    _check_outputs(page, json_path, force, [file])
    series = read_series(file, choice)
    try:
        model = fitting.fit(series, series.span_s)
    except ValueError as error:
        raise InputError(f"{file}: {error}") from None
    tested = backtest(series, fitting)
    made = forecasts([(0, model)])
    document = _document(series_block(series, model, made, tested))
    if page:
        write_text(page, series_page(series, model, made, tested), force=force, inputs=[file])
    if json_path and json_path != "-":
        write_text(json_path, document, force=force, inputs=[file])
    if json_path == "-":
        return document.rstrip("\n")
    return _finish([_about(series), *told(model, made, tested.scores, tested)], page, json_path)


def series_block(series: HeaveSeries, model: HeaveModel, made: Forecasts, tested: Backtest) -> dict[str, Any]:
    """Return the summary of a series (docs/json.md)."""
    from deckfix.result import heave_block

    block: dict[str, Any] = {
        "series": series.name,
        "samples": int(np.isfinite(series.heave_m).sum()),
        "dropped": int((~np.isfinite(series.heave_m)).sum()),
        "gaps": len(series.gaps),
        "span_s": series.span_s,
        "noise_scale": float(model.noise_scale),
        **heave_block(model, made),
        **_ahead(made, model),
    }
    if len(tested.made):
        block["whole"] = {"hs_m": tested.hs_m, "tp_s": tested.tp_s, "windows": len(tested.made)}
    if tested.scores is not None:
        block["forecast"] = tested.scores.block()
    return block


def told(
    model: HeaveModel, made: Forecasts, scores: Scores | None, tested: Backtest | None = None
) -> list[str]:
    """Return a model, its forecast and how the forecasts did, as lines of text."""
    lines = [
        f"  Hs {_number(model.hs_m, 'm', 3)}, Tp {_number(model.tp_s, 's', 2)}, dominant period "
        f"{_number(model.dominant_period_s, 's', 3)}, level {model.level_m:+.3f} m (1 sigma "
        f"{model.level_sigma_m:.3f}), from {model.samples:,} samples over {model.span_s:.1f} s ({model.method})"
    ]
    if tested is not None and len(tested.made):
        lines.append(
            f"  the whole series: Hs {_number(tested.hs_m, 'm', 3)}, Tp {_number(tested.tp_s, 's', 2)} "
            f"({len(tested.made)} windows)"
        )
    if model.reason:
        lines.append(f"  only the level could be given: {model.reason}")
    if model.noise_scale > 1.5:
        lines.append(
            f"  the samples scatter {model.noise_scale:.1f} times as much as the sigma that they came with"
        )
    largest = sorted(model.components, key=lambda c: -c.amplitude_m)[:SHOWN]
    if largest:
        lines += [
            "",
            f"  the {len(largest)} largest of {len(model.components)} components, A sin(2 pi t / T + phi)",
        ]
        lines.append(f"  {'A [m]':>9} {'T [s]':>9} {'phi [rad]':>10}")
        lines += [f"  {c.amplitude_m:9.4f} {c.period_s:9.3f} {c.phase_rad:+10.3f}" for c in largest]
    against = f"; found: against the {scores.against}" if scores is not None else ""
    quiet = f"quiet: |rate| < {QUIET_RATE_MPS:g} m/s for {QUIET_S:g} s"
    lines += ["", f"  forecast from the last sample on ({quiet}{against})"]
    found = f" {'rmse [m]':>9} {'level':>7} {'in 95 %':>8}" if scores is not None else ""
    lines.append(
        f"  {'s':>5} {'heave [m]':>10} {'sigma':>7} {'rate [m/s]':>11} {'sigma':>7} {'skill':>6} {'quiet':>6}{found}"
    )
    for k, h in enumerate(made.horizon_s):
        line = (
            f"  {h:5g} {made.heave_m[-1, k]:+10.3f} {made.sigma_m[-1, k]:7.3f} {made.rate_mps[-1, k]:+11.3f} "
            f"{made.rate_sigma_mps[-1, k]:7.3f} {made.skill[-1, k]:6.2f} {made.window_probability[-1, k]:6.2f}"
        )
        if scores is not None and scores.count[k] >= FEWEST:
            line += (
                f" {scores.rmse_m[k]:9.3f} {scores.level_rmse_m[k]:7.3f} {100 * scores.coverage_95[k]:6.0f} %"
            )
        lines.append(line + ("  (level only)" if made.fallback[-1, k] else ""))
    return lines


def series_page(series: HeaveSeries, model: HeaveModel, made: Forecasts, tested: Backtest) -> str:
    """Return the page of a series: spectrum, components, fit and forecast, and how forecasts did."""
    from deckfix import heave_figures, report_deck
    from deckfix.backtest import continuous
    from deckfix.page import Plots, document, text

    plots = Plots()
    t = series.t_s - model.last_s
    fit = heave_figures.fit_and_forecast(model, t, series.heave_m)
    parts = [report_deck.model_table(model)]
    whole = ""
    if len(tested.made):
        whole = f" The whole series: Hs {tested.hs_m:.3f} m, Tp {tested.tp_s:.2f} s, from {len(tested.made)} windows."
    parts.append(f'<p class="lead">The model is of the last {model.span_s:.0f} s.{whole}</p>')
    parts.append(f"<h3>Spectrum</h3>{plots.place(heave_figures.spectrum(model), 'Spectrum of the heave')}")
    parts.append(f"<h3>Fit and forecast</h3>{plots.place(fit, 'Fit and forecast of the heave')}")
    parts.append(report_deck.component_table(model))
    sections = [("model", "Model", "".join(parts))]
    seen = continuous(series)
    if tested.scores is not None and len(tested.made) >= FEWEST and seen is not None:
        figure = plots.place(heave_figures.scatter(tested.made, seen), "Forecasts over what happened")
        about = (
            f'<p class="lead">From {len(tested.made)} moments of the series, each from its own past alone, held '
            "against the samples that came then, noise and all.</p>"
        )
        scored = about + figure + report_deck.forecast_section(tested.made, tested.scores, plots)
        sections.append(("forecasts", "Forecasts against what happened", scored))
    body = "".join(
        f'<section id="{key}"><h2>{title}</h2>{content}</section>' for key, title, content in sections
    )
    links = "".join(f'<a href="#{key}">{title}</a>' for key, title, _ in sections)
    header = f'<header><p class="eyebrow">Heave of a series</p><h1>{text(series.name)}</h1>'
    return document(
        series.name, f'{header}<p class="verdict">{text(_about(series))}</p></header>', links, body, plots
    )


def flight_page(result: Result) -> str:
    """Return the page of a flight's heave: the report's sections of it alone."""
    from deckfix import report_deck
    from deckfix.page import Plots, document, text

    plots = Plots()
    sections = [
        ("heave", "Heave", report_deck.heave(result, plots)),
        ("platform", "Platform", report_deck.platform(result, plots)),
    ]
    body = "".join(
        f'<section id="{key}"><h2>{title}</h2>{content}</section>' for key, title, content in sections
    )
    links = "".join(f'<a href="#{key}">{title}</a>' for key, title, _ in sections)
    header = f'<header><p class="eyebrow">Heave of a flight</p><h1>{text(result.flight)}</h1></header>'
    return document(result.flight, header, links, body, plots)


def _ahead(made: Forecasts, model: HeaveModel) -> dict[str, Any]:
    """Return the last forecast by horizon, and all components."""
    names = ("heave_m", "sigma_m", "rate_mps", "rate_sigma_mps", "skill", "window_probability")
    ahead = []
    for k, h in enumerate(made.horizon_s):
        entry: dict[str, Any] = {"horizon_s": float(h), "fallback": bool(made.fallback[-1, k])}
        ahead.append(entry | {name: float(getattr(made, name)[-1, k]) for name in names})
    return {"components": [[float(v) for v in c] for c in model.components], "ahead": ahead}


def _about(series: HeaveSeries) -> str:
    bad = int((~np.isfinite(series.heave_m)).sum())
    parts = [f"{series.name}: {len(series.t_s) - bad:,} samples over {series.span_s:.1f} s"]
    if series.interval_s > 0:
        parts.append(f"every {series.interval_s:.3g} s")
    if bad:
        parts.append(f"{bad} not finite")
    if series.gaps:
        parts.append(
            f"{len(series.gaps)} gap{'s' if len(series.gaps) > 1 else ''}, the longest {max(series.gaps):.1f} s"
        )
    parts.append(series.columns)
    if not series.given_sigma:
        parts.append(f"no sigma given, {series.sigma_m[0]:.2g} m assumed")
    return ", ".join(parts)


def _number(value: float, unit: str, digits: int) -> str:
    return f"{value:.{digits}f} {unit}" if np.isfinite(value) else "unknown"


def _document(block: dict[str, Any]) -> str:
    return json.dumps(finite(block), indent=1) + "\n"


def _check_outputs(page: str | None, json_path: str | None, force: bool, inputs: list[str]) -> None:
    for path in (page, None if json_path == "-" else json_path):
        if path:
            check_output(path, force=force, inputs=inputs)
    if page and json_path and Path(page).resolve() == Path(json_path).resolve():
        raise InputError(f"{page}: is named for two outputs; give each its own file")


def _finish(lines: list[str], page: str | None, json_path: str | None) -> str:
    written = [f"wrote {p}" for p in (page, json_path) if p]
    return "\n".join(printable(line) for line in [*lines, *written])

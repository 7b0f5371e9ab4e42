"""The report: one self-contained HTML page, without network, that opens on any machine and any phone.

All text from a log is escaped: in the page as HTML, in the figures' data by writing ``<``, ``>`` and ``&``
as JSON escapes, and a content security policy lets only the page's own two scripts run and nothing be
fetched.
"""

from __future__ import annotations

import numpy as np

from deckfix import figures, report_deck, sensor_figures
from deckfix._version import __version__
from deckfix.finding import Finding, Severity
from deckfix.findings import findings, verdict
from deckfix.page import Plots, document, table, text
from deckfix.reference import RATIOS
from deckfix.result import Result
from estimation.outcome import Outcome

MOST_SENSORS = 12
"""So many sensors get plots of their innovations; the tables name all."""

_RATIO_WORDS = {"roll_pitch": "roll and pitch"}
_WORDS = {Severity.SERIOUS: "serious", Severity.WARNING: "warning", Severity.NOTE: "note"}


def render(result: Result) -> str:
    """Return the report of a result as HTML."""
    found = findings(result)
    plots = Plots()
    sections = [
        ("wrong", "What went wrong", _wrong(found)),
        ("track", "Track", _track(result, plots)),
        ("estimate", "Estimate", _estimate(result, plots)),
        ("platform", "Platform", report_deck.platform(result, plots)),
        ("heave", "Heave", report_deck.heave(result, plots)),
        ("measurements", "Measurements", _measurements(result, plots)),
        ("outcomes", "Outcomes", _outcomes(result, plots)),
        ("states", "Biases and other states", _states(result, plots)),
        ("clocks", "Clocks", report_deck.clocks(result, plots)),
        ("inputs", "Rates and gaps", _inputs(result, plots)),
        ("configuration", "Configuration", _configuration(result)),
    ]
    body = "".join(
        f'<section id="{key}"><h2>{title}</h2>{content}</section>'
        for key, title, content in sections
        if content
    )
    links = "".join(f'<a href="#{key}">{title}</a>' for key, title, content in sections if content)
    return document(result.flight, _header(result, found), links, body, plots)


def _header(result: Result, found: list[Finding]) -> str:
    worst = max((f.severity for f in found), default=Severity.NOTE)
    if not len(result.run.t_ns):
        worst = Severity.SERIOUS
    cells = [("duration", _duration(result.duration_s)), ("estimates", f"{len(result.run.t_ns):,}")]
    if len(result.tried):
        share = float(np.mean(result.tried["outcome"] <= int(Outcome.DOWNWEIGHTED)))
        cells.append(("measurements fused", f"{100 * share:.1f} % <small>of {len(result.tried):,}</small>"))
    cells += _accuracy(result)
    facts = "".join(f"<div><dt>{name}</dt><dd>{value}</dd></div>" for name, value in cells)
    speed = result.duration_s / result.wall_s if result.wall_s > 0 else 0.0
    engine = f"{text(result.run.engine)} engine" + (f", {speed:.0f} times real time" if speed >= 2 else "")
    return (
        f'<header><p class="eyebrow">Flight report · {engine} · deckfix {__version__}</p>'
        f"<h1>{text(result.flight)}</h1>"
        f'<p class="verdict {_WORDS[worst]}">{text(verdict(result, found))}</p>'
        f'<dl class="figures">{facts}</dl></header>'
    )


def _accuracy(result: Result) -> list[tuple[str, str]]:
    if result.truth_errors is not None:
        inside = result.judged.inside(result.truth_errors.t_ns)
        out = []
        for name, values, unit, axes in (
            ("horizontal error, rms", result.truth_errors.position_m, "m", (0, 1)),
            ("height error, rms", result.truth_errors.position_m, "m", (2,)),
            ("tilt error, rms", np.rad2deg(result.truth_errors.attitude_rad), "deg", (0, 1)),
        ):
            part = values[inside][:, axes]
            part = part[np.isfinite(part).all(axis=1)]
            if len(part):
                rms = float(np.sqrt(np.mean(np.sum(part**2, axis=1))))
                out.append((name, f"{rms:.3f} {unit}"))
        return out
    if not len(result.run.t_ns):
        return []
    variance = np.median(np.einsum("nii->ni", result.run.covariance), axis=0).clip(0.0)
    horizontal, vertical = float(np.sqrt(variance[0] + variance[1])), float(np.sqrt(variance[2]))
    return [
        ("horizontal sigma, median", f"{horizontal:.2f} m"),
        ("height sigma, median", f"{vertical:.2f} m"),
    ]


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest:02d} s" if minutes else f"{seconds:.1f} s"


def _wrong(found: list[Finding]) -> str:
    if not found:
        return (
            '<p class="clear">Nothing was found. No measurement was rejected to a noticeable degree, no gap, '
            "no inconsistent innovation, no implausible bias.</p>"
        )
    heads = ("", "symptom", "likely cause", "what to do")
    rows = [
        (_WORDS[f.severity], [_WORDS[f.severity], text(f.symptom), text(f.cause), text(f.remedy)])
        for f in found
    ]
    lead = ""
    if all(f.severity is Severity.NOTE for f in found):
        lead = '<p class="lead">Nothing that matters. These are notes.</p>'
    return lead + table(heads, rows, css="findings")


def _track(result: Result, plots: Plots) -> str:
    if not len(result.run.t_ns):
        return ""
    about = "North is up, and the plot is to scale."
    if result.truth is not None or result.autopilot is not None:
        about += " The other estimates are shifted by their constant offset."
    if result.run.origin is not None:
        lat, lon, alt = result.run.origin
        about += f" Origin: {np.rad2deg(lat):.6f}°, {np.rad2deg(lon):.6f}°, {alt:.1f} m."
    return (
        f'<p class="lead">{about}</p>'
        '<div class="pair">'
        f"<div>{plots.place(figures.track(result), 'Track on the level plane')}</div>"
        f"<div>{plots.place(figures.height(result), 'Height over time')}</div></div>"
    )


def _estimate(result: Result, plots: Plots) -> str:
    if not len(result.run.t_ns):
        return ""
    if result.truth_errors is not None:
        about = (
            "Errors against the truth in the log. An honest filter stays inside its ±3 sigma band nearly "
            "always, and is not far inside it. The position is less its constant offset. Where the plot is "
            "wholly shaded, the band reaches beyond it."
        )
    else:
        about = "The log holds no truth, so the estimates themselves are shown, with their ±3 sigma band."
    out = [f'<p class="lead">{about}</p>', _ratio_table(result)]
    for title, draw in (
        ("Position", figures.position),
        ("Velocity", figures.velocity),
        ("Attitude", figures.attitude),
    ):
        out.append(f"<h3>{title}</h3>{plots.place(draw(result), f'{title} over time')}")
    return "".join(out)


def _ratio_table(result: Result) -> str:
    if result.at_autopilot is None:
        return ""
    from deckfix.reference import rms

    ratios = result.summary()["ratio"]
    ours, theirs = result.at_autopilot.ours, result.at_autopilot.autopilot
    inside = result.judged.inside(ours.t_ns)
    rows = []
    for name, quantity, axes in RATIOS:
        if name not in ratios:
            continue
        factor, unit = {"position_m": (1.0, "m"), "velocity_mps": (1.0, "m/s")}.get(
            quantity, (180 / np.pi, "deg")
        )
        size = np.sqrt(len(axes))
        both = [(rms(getattr(e, quantity)[inside][:, axes]) or 0.0) * factor * size for e in (ours, theirs)]
        cells = [
            _RATIO_WORDS.get(name, name.replace("_", " ")),
            f"{both[0]:.3f} {unit}",
            f"{both[1]:.3f} {unit}",
            f"{ratios[name]:.2f}",
        ]
        rows.append(("", cells))
    if not rows:
        return ""
    start, end = (result.seconds(v) for v in (result.judged.start_ns, result.judged.end_ns))
    return (
        table(("rms error", "deckfix", "autopilot's own", "ratio"), rows, numeric=(1, 2, 3))
        + f'<p class="lead">Between {start:.1f} s and {end:.1f} s'
        + (", contact less half a second" if result.judged.contact_ns is not None else "")
        + ".</p>"
    )


def _measurements(result: Result, plots: Plots) -> str:
    shown = [n for n in result.measured if (s := result.nis(n)) is not None and s.count > 1]
    if not shown:
        return ""
    rows = []
    for name in shown:
        s = result.nis(name)
        assert s is not None
        doubtful = s.count >= 30 and not 0.2 <= s.mean_over_dof <= 2.0
        mean = f'<span class="off">{s.mean_over_dof:.2f}</span>' if doubtful else f"{s.mean_over_dof:.2f}"
        rows.append(
            (
                "",
                [
                    _name(name),
                    f"{s.count:,}",
                    mean,
                    f"{100 * s.inside_95:.0f} %",
                    f"{100 * s.above_95:.1f} %",
                ],
            )
        )
    out = [
        '<p class="lead">An innovation is a measurement less its prediction. Its normalised square, the NIS, '
        "averages to one per degree of freedom when noise and latency are right, and lies in the green band "
        "95 % of the time.</p>",
        table(
            ("sensor", "innovations", "NIS / dof", "inside 95 % band", "above it"), rows, numeric=(1, 2, 3, 4)
        ),
    ]
    for name in shown[:MOST_SENSORS]:
        figure = sensor_figures.innovations(result, name)
        out.append(f"<h3>{text(name)}</h3>{plots.place(figure, f'Innovations and NIS of {name}')}")
    if len(shown) > MOST_SENSORS:
        out.append(f"<p>{len(shown) - MOST_SENSORS} further sensors are in the table only.</p>")
    return "".join(out)


def _outcomes(result: Result, plots: Plots) -> str:
    if not len(result.run.records):
        return ""
    counts = {name: result.outcomes(name) for name in result.measured}
    used = [o for o in Outcome if any(o in c for c in counts.values())]
    heads = ("sensor", *(o.name.lower().replace("_", " ") for o in used))
    rows = [("", [_name(n), *(f"{c[o]:,}" if o in c else "" for o in used)]) for n, c in counts.items()]
    out = ['<p class="lead">Every measurement ends in exactly one outcome.']
    if result.unused:
        names = ", ".join(text(n) for n in result.unused)
        out.append(f" Never tried, because switched off in the configuration or not ready: {names}.")
    out += [
        "</p>",
        plots.place(sensor_figures.outcomes(result), "Outcomes over time") if len(result.tried) else "",
    ]
    out.append(table(heads, rows, numeric=tuple(range(1, len(heads)))))
    if result.run.notes:
        lines = [
            f"<li>{result.seconds(int(t)):.1f} s: {text(note)}</li>" for t, note in result.run.notes[:200]
        ]
        out.append(f'<h3>Notes of the filter</h3><ul class="plain">{"".join(lines)}</ul>')
    return "".join(out)


def _states(result: Result, plots: Plots) -> str:
    if not len(result.run.t_ns):
        return ""
    known = {
        "gyro_bias": "Gyro bias",
        "accel_bias": "Accelerometer bias",
        "gps_bias": "GPS position bias",
        "baro_bias": "Barometer offset",
    }
    blocks = list(dict.fromkeys(n.split(".")[0] for n in result.run.state_names))
    blocks = [b for b in blocks if b not in ("position", "velocity", "attitude")]
    out = [
        '<p class="lead">What the filter estimates along with the motion: slow errors of the sensors first.</p>'
    ]
    for block in blocks:
        title = known.get(block, block.replace("_", " ").capitalize())
        out.append(f"<h3>{text(title)}</h3>{plots.place(sensor_figures.states(result, block), title)}")
    return "".join(out) if blocks else ""


def _inputs(result: Result, plots: Plots) -> str:
    if not result.streams:
        return ""
    rows = []
    for s in result.streams:
        start = f"{s.longest_gap_s:.2f} s" if s.gaps else ""
        cells = [_name(s.name), s.kind.name.lower().replace("_", " "), f"{s.count:,}", f"{s.rate_hz:.1f} Hz"]
        rows.append(("", [*cells, str(len(s.gaps)), start]))
    heads = ("sensor", "kind", "messages", "rate", "gaps", "longest gap")
    about = "A gap is an interval of more than five times the usual one."
    return (
        f'<p class="lead">{about}</p>'
        + plots.place(sensor_figures.coverage(result), "When each sensor spoke")
        + table(heads, rows, numeric=(2, 3, 4, 5))
    )


def _name(sensor: str) -> str:
    """Return a sensor's name that may break at its underscores."""
    return text(sensor).replace("_", "_<wbr>")


def _configuration(result: Result) -> str:
    out = [
        f'<p class="lead">Used: {text(result.config_source)}.</p>',
        f"<details><summary>All parameters</summary><pre>{text(result.config_text)}</pre></details>",
    ]
    for name, entries in sorted(result.metadata.items()):
        if not entries:
            continue
        lines = "\n".join(f"{key} = {_shorten(value)}" for key, value in sorted(entries.items()))
        out.append(f"<details><summary>From the log: {text(name)}</summary>")
        out.append(f"<pre>{text(lines[:60_000])}</pre></details>")
    if result.messages:
        said = "\n".join(
            f"{result.seconds(m.t_ns):9.2f} s  {m.source}: {_shorten(m.text)}" for m in result.messages[:2000]
        )
        out.append(f"<details><summary>Messages in the log</summary><pre>{text(said)}</pre></details>")
    return "".join(out)


def _shorten(value: str, longest: int = 2000) -> str:
    return value if len(value) <= longest else value[:longest] + " …"

"""The page of a fleet: what matters of each flight at a glance, and the way to its report. No script is in it."""

from __future__ import annotations

import html
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

from deckfix._version import __version__
from deckfix.page import table, text

STATUS = {"ok": "fine", "no estimate": "no estimate", "error": "cannot be used"}
SHORT = {
    "gps_position": "GPS position",
    "gps_velocity": "GPS velocity",
    "barometer": "barometer",
    "magnetometer": "compass",
    "vision": "vision",
}
HEADS = (
    "Flight", "Judgement", "Length", "IMU", "Gaps", "Fused", "NIS over its dof", "Error against truth", "Heave",
    "Landing",
)  # fmt: skip
STYLE = """
main, nav div { max-width: 1500px; }
.fleet td:first-child { overflow-wrap: anywhere; min-width: 12em; }
.fleet tr td:first-child { color: inherit; }
.fleet td { font-size: 14px; }
.fleet .why { color: var(--grey); font-size: 13px; max-width: 34em; margin: 2px 0 0; }
.fleet b.serious { color: var(--bad); } .fleet b.warning { color: var(--warn); } .fleet b.fine { color: var(--good); }
"""


def render(
    title: str,
    rows: Sequence[Mapping[str, Any]],
    links: Mapping[str, str],
    skipped: Sequence[tuple[str, str]],
) -> str:
    """Return the page of a fleet's rows; ``links`` are the reports' addresses by flight."""
    style = (resources.files("deckfix") / "report.css").read_text(encoding="utf-8") + STYLE
    policy = "default-src 'none'; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
    states = [_judgement(r)[0] for r in rows]
    hours = sum(float(r.get("duration_s") or 0.0) for r in rows) / 60.0
    figures = (
        ("flights", len(rows)),
        ("minutes recorded", f"{hours:.1f}"),
        ("without warnings", states.count("fine")),
        ("with warnings", states.count("warning")),
        ("serious, or without an estimate", states.count("serious")),
    )
    numbers = "".join(f"<div><dt>{text(k)}</dt><dd>{text(v)}</dd></div>" for k, v in figures)
    body = table(
        HEADS, ((_judgement(r)[0], _cells(r, links)) for r in rows), numeric=(2, 3, 4, 5), css="fleet"
    )
    left_out = ""
    if skipped:
        items = "".join(f"<li>{text(name)}: {text(why)}</li>" for name, why in skipped)
        left_out = f'<section><h2>Left out</h2><ul class="plain">{items}</ul></section>'
    return (
        '<!DOCTYPE html>\n<html lang="en"><head><meta charset="utf-8">'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f'<meta name="generator" content="deckfix {__version__}">'
        f"<title>{text(title)} - deckfix fleet</title><style>{style}</style></head><body>"
        f'<nav><div><b>deckfix</b><a href="flights.csv">flights.csv</a></div></nav><main>'
        f'<header><p class="eyebrow">Fleet</p><h1>{text(title)}</h1></header><dl class="figures">{numbers}</dl>'
        '<section><h2>Flights</h2><p class="lead">NIS over its degrees of freedom is 1 where the filter is honest, '
        "above it the filter is too sure. All numbers are in flights.csv.</p>"
        f"{body}</section>{left_out}"
        f"<footer>Written by deckfix {__version__}.</footer></main></body></html>\n"
    )


def _judgement(row: Mapping[str, Any]) -> tuple[str, str]:
    """Return the CSS class and the word of a row's judgement."""
    status = str(row.get("status"))
    if status != "ok":
        return "serious", STATUS.get(status, status)
    if row.get("serious"):
        return "serious", "serious"
    if row.get("warnings"):
        n = int(row["warnings"])
        return "warning", f"{n} warning" + ("" if n == 1 else "s")
    return "fine", "fine"


def _cells(row: Mapping[str, Any], links: Mapping[str, str]) -> list[str]:
    name = str(row["flight"])
    link = links.get(name)
    title = f'<a href="{html.escape(link)}">{text(name)}</a>' if link else text(name)
    kind, word = _judgement(row)
    why = row.get("error") or row.get("warning_texts") or row.get("log_problems") or ""
    why = why if len(why) <= 300 else why[:297] + "..."
    judgement = f'<b class="{kind}">{text(word)}</b>' + (f'<p class="why">{text(why)}</p>' if why else "")
    gaps = sum(int(v) for k, v in row.items() if k.startswith("events.") and k.endswith(".gaps") and v)
    present = row.get("duration_s") is not None
    return [
        title,
        judgement,
        _number(row.get("duration_s"), "{:.0f} s"),
        _number(row.get("events.imu.rate_hz"), "{:.0f} Hz"),
        str(gaps) if present else "",
        _fused(row),
        _by_sensor(row),
        _truth(row),
        _number(row.get("heave.hs_m"), "Hs {:.2f} m") + _number(row.get("heave.tp_s"), ", Tp {:.1f} s"),
        _landing(row),
    ]


def _number(value: Any, pattern: str) -> str:
    return "" if value is None else pattern.format(value)


def _fused(row: Mapping[str, Any]) -> str:
    """Return the share of the measurements that were fused, of the sensors that are in use."""
    fused = tried = 0
    for key, value in row.items():
        if not key.startswith("fusion.") or not value:
            continue
        _, sensor, outcome = key.split(".", 2)
        if f"nis.{sensor}.mean_over_dof" not in row:
            continue
        tried += value
        fused += value if outcome in ("FUSED", "FUSED_LATE", "DOWNWEIGHTED") else 0
    return f"{100.0 * fused / tried:.1f} %" if tried else ""


def _by_sensor(row: Mapping[str, Any]) -> str:
    out = []
    for key, value in row.items():
        if key.startswith("nis.") and key.endswith(".mean_over_dof") and value is not None:
            sensor = key[4 : -len(".mean_over_dof")]
            out.append(
                f"{SHORT.get(sensor, sensor)}&nbsp;{value:.2f}"
                if sensor in SHORT
                else f"{text(sensor)} {value:.2f}"
            )
    return "<br>".join(sorted(out))


def _truth(row: Mapping[str, Any]) -> str:
    parts = []
    for label, quantity, unit in (
        ("position", "position_rmse_m", "m"),
        ("velocity", "velocity_rmse_mps", "m/s"),
    ):
        axes = [row.get(f"truth.odometry.{quantity}.{a}") for a in ("north", "east", "down")]
        known = [float(a) for a in axes if a is not None]
        if len(known) == 3:
            parts.append(f"{label}&nbsp;{sum(a * a for a in known) ** 0.5:.3f}&nbsp;{unit}")
    relative = [row.get(f"truth.relative.position_rmse_m.{a}") for a in ("north", "east", "down")]
    if all(a is not None for a in relative):
        parts.append(f"relative&nbsp;{sum(float(a or 0.0) ** 2 for a in relative) ** 0.5:.3f}&nbsp;m")
    return "<br>".join(parts)


def _landing(row: Mapping[str, Any]) -> str:
    parts = []
    if row.get("landing.contact"):
        parts.append(f"contact&nbsp;at&nbsp;{row['landing.contact_s']:.1f}&nbsp;s")
    elif row.get("landing.contact") is False:
        parts.append("no contact")
    for key, pattern in (
        ("landing.closing_mps", "closing&nbsp;{:.2f}&nbsp;m/s"),
        ("landing.miss_m", "{:.2f}&nbsp;m&nbsp;off"),
        ("landing.last_mode", "mode&nbsp;{}"),
    ):
        if row.get(key) is not None:
            parts.append(pattern.format(text(row[key]) if isinstance(row[key], str) else row[key]))
    return "<br>".join(parts)

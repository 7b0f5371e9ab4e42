"""The report's figures of the measurements: innovations, outcomes, biases, and when each sensor spoke."""

from __future__ import annotations

import numpy as np

from deckfix.plotting import (
    AXES,
    BAD,
    GREY,
    OURS,
    TRUTH,
    Array,
    Figure,
    Trace,
    axis,
    band,
    label,
    layout,
    limits,
    line,
    points,
    rgba,
    stacked,
    time_axis,
)
from deckfix.result import Result, nis_band
from estimation.events import Kind
from estimation.outcome import Outcome

OUTCOME_COLOURS: dict[Outcome, str] = {
    Outcome.FUSED: "#2a7f62",
    Outcome.FUSED_LATE: "#86c2ac",
    Outcome.DOWNWEIGHTED: "#e3b341",
    Outcome.REJECTED_GATE: "#b3261e",
    Outcome.REJECTED_NOT_FINITE: "#5c1a66",
    Outcome.REJECTED_COVARIANCE: "#8a4fa3",
    Outcome.REJECTED_TOO_OLD: "#c2601a",
    Outcome.REJECTED_FUTURE: "#e58f55",
    Outcome.REJECTED_DUPLICATE: "#8d96a3",
    Outcome.REJECTED_NOT_READY: "#c9ced6",
}

INNOVATION_UNITS: dict[Kind, tuple[str, tuple[str, ...]]] = {
    Kind.GPS_POSITION: ("m", ("north", "east", "down")),
    Kind.GPS_VELOCITY: ("m/s", ("north", "east", "down")),
    Kind.BAROMETER: ("m", ("height",)),
    Kind.MAGNETOMETER: ("rad", ("heading",)),
    Kind.ATTITUDE: ("rad", ("x", "y", "z")),
    Kind.RANGEFINDER: ("m", ("range",)),
    Kind.VISION: ("m", ("x", "y", "z")),
    Kind.USER: ("own unit", ("1", "2", "3")),
}


def innovations(result: Result, sensor: str) -> Figure:
    """Return a sensor's innovations with their 3 sigma band, and its NIS with the 95 % band."""
    records = result.sensor_records(sensor)
    records = records[np.isfinite(records["nis"]) & (records["dof"] > 0)]
    kind = next((s.kind for s in result.streams if s.name == sensor), Kind.USER)
    unit, names = INNOVATION_UNITS.get(kind, ("own unit", ("1", "2", "3")))
    t = result.seconds_of(records["t_ns"])
    dof = int(records["dof"].max()) if len(records) else 1
    data: list[Trace] = []
    for i in range(dof):
        name = names[i] if i < len(names) else str(i + 1)
        sigma = 3.0 * records["sigma"][:, i]
        if dof == 1:
            data += band(t, -sigma, sigma, "±3 sigma", 1)
        else:
            for k, bound in enumerate((-sigma, sigma)):
                edge = line(t, bound, "±3 sigma", AXES[i % 3], 1, legend=i == k == 0, width=1, dash="dot")
                data.append(edge | {"hoverinfo": "skip"})
        data.append(points(t, records["innovation"][:, i], name, AXES[i % 3], 1, size=3.5))
    low, high = (float(v[0]) for v in nis_band(np.array([float(dof)])))
    refused = records["outcome"] > int(Outcome.DOWNWEIGHTED)
    nis = np.maximum(records["nis"], 1e-9)
    data.append(points(t[~refused], nis[~refused], "NIS", GREY, 2, size=3))
    if refused.any():
        data.append(points(t[refused], nis[refused], "NIS of rejected", BAD, 2, size=5, symbol="x"))
    if len(t) >= 20:
        data.append(line(t, _running_mean(nis, 41), "NIS, mean of 41", TRUTH, 2, width=1.6))
    reach = limits(
        *(records["innovation"][:, i] for i in range(dof)),
        *(3.0 * np.nanmedian(records["sigma"][:, i : i + 1], axis=0) for i in range(dof)),
        share=99.0,
        symmetric=True,
    )
    axes = stacked([f"innovation [{unit}]", "NIS"], [reach, None], result.duration_s)
    spread = np.log10(np.percentile(nis, (3.0, 99.9))) if len(nis) else np.zeros(2)
    bottom = max(min(np.log10(low) - 0.3, float(spread[0])), -4.0)
    top = max(float(spread[1]) + 0.2, np.log10(high) + 0.4)
    axes["yaxis2"] |= {"type": "log", "range": [bottom, top], "dtick": 1, "exponentformat": "power"}
    shape = {
        "type": "rect", "xref": "x2 domain", "yref": "y2", "x0": 0, "x1": 1, "y0": low, "y1": high,
        "fillcolor": rgba("#2a7f62", 0.13), "line": {"width": 0}, "layer": "below",
    }  # fmt: skip
    return {"data": data, "layout": layout(400, shapes=[shape], **axes)}


def outcomes(result: Result) -> Figure:
    """Return how many measurements met each outcome, stacked over time."""
    records = result.tried
    t = result.seconds_of(records["t_ns"])
    end = max(result.duration_s, 1.0)
    width = max(1.0, np.ceil(end / 90.0))
    edges = np.arange(0.0, end + width, width)
    data: list[Trace] = []
    for outcome in Outcome:
        mine = t[records["outcome"] == int(outcome)]
        if not len(mine):
            continue
        counts, _ = np.histogram(mine.clip(0.0, end), bins=edges)
        data.append(
            {
                "type": "bar",
                "x": (edges[:-1] + width / 2).astype(np.float32),
                "y": (counts / width).astype(np.float32),
                "width": float(width),
                "name": outcome.name.lower().replace("_", " "),
                "marker": {"color": OUTCOME_COLOURS[outcome], "line": {"width": 0}},
            }
        )
    axes = {"xaxis": time_axis(result.duration_s), "yaxis": axis("measurements per second")}
    return {"data": data, "layout": layout(330, barmode="stack", bargap=0, hovermode="x unified", **axes)}


_IN_DEGREES = {"rad": ("deg", 180.0 / np.pi), "rad/s": ("deg/s", 180.0 / np.pi)}


def states(result: Result, block: str) -> Figure:
    """Return the entries of one block of the state with their 3 sigma bands, one panel each."""
    t = result.t_s
    chosen = [i for i, n in enumerate(result.run.state_names) if n.split(".")[0] == block]
    data: list[Trace] = []
    ranges = []
    titles = []
    for row, i in enumerate(chosen, start=1):
        unit, factor = _IN_DEGREES.get(result.run.state_units[i], (result.run.state_units[i], 1.0))
        value = result.state_values[:, i] * factor
        sigma = 3.0 * result.run.sigma[:, i] * factor
        data += band(t, value - sigma, value + sigma, "±3 sigma", row, legend=row == 1)
        data.append(line(t, value, "estimate", OURS, row, legend=row == 1))
        late = t > 0.25 * t[-1] if len(t) else np.zeros(0, dtype=bool)
        ranges.append(limits(value, (value - sigma)[late], (value + sigma)[late]))
        component = result.run.state_names[i].split(".")[-1]
        titles.append(f"{label(component)} [{label(unit)}]")
    return {
        "data": data,
        "layout": layout(90 + 100 * len(chosen), **stacked(titles, ranges, result.duration_s)),
    }


def coverage(result: Result) -> Figure:
    """Return when each sensor spoke: one bar a sensor, white where nothing came."""
    data: list[Trace] = []
    names = [label(s.name, 24) for s in result.streams]
    for row, s in enumerate(result.streams):
        first = result.seconds(int(s.stamp_ns[0]))
        last = result.seconds(int(s.stamp_ns[-1]))
        longest = sorted(s.gaps, key=lambda g: -g[1])[:200]
        cuts = sorted((first + start, first + start + length) for start, length in longest)
        x: list[float | None] = [first]
        for a, b in cuts:
            x += [a, None, b]
        x.append(last)
        y = [None if v is None else float(row) for v in x]
        data.append(
            {
                "type": "scatter",
                "mode": "lines",
                "x": x,
                "y": y,
                "name": names[row],
                "line": {"color": OURS, "width": 11},
                "showlegend": False,
                "hovertemplate": "%{x:.1f} s<extra>" + names[row] + "</extra>",
            }
        )
    axes = {
        "xaxis": time_axis(result.duration_s),
        "yaxis": axis(
            "",
            tickvals=list(range(len(names))),
            ticktext=names,
            range=[len(names) - 0.4, -0.6],
            showgrid=False,
            automargin=True,
        ),
    }
    return {"data": data, "layout": layout(80 + 30 * len(names), hovermode="closest", **axes)}


def _running_mean(values: Array, width: int) -> Array:
    """Return the centred mean of up to ``width`` neighbours."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    n = len(values)
    low = np.maximum(np.arange(n) - width // 2, 0)
    high = np.minimum(np.arange(n) + width // 2 + 1, n)
    mean: Array = (total[high] - total[low]) / (high - low)
    return mean

"""The figures of the report, each from a ``Result``; see docs/report.md for how to read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from deckfix.plotting import (
    AUTOPILOT,
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
)
from deckfix.reference import Trajectory, euler_sigmas
from deckfix.result import Result, nis_band
from estimation.events import Kind
from estimation.outcome import Outcome

SECONDS = "seconds from the first inertial sample"

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


@dataclass(frozen=True, slots=True)
class _Curves:
    """One quantity: ours (n, 3) with sigma (n, 3) around ``centre`` and, where known, the autopilot's."""

    names: tuple[str, str, str]
    unit: str
    ours: Array
    sigma: Array
    centre: Array
    autopilot_s: Array | None
    autopilot: Array | None
    are_errors: bool


def track(result: Result) -> Figure:
    """Return the track on the level plane, east to the right and north up, to scale."""
    axes = {
        "xaxis": axis("east [m]", constrain="domain", zeroline=False),
        "yaxis": axis("north [m]", scaleanchor="x", scaleratio=1),
    }
    return {"data": _track_traces(result, 1), "layout": layout(420, hovermode="closest", **axes)}


def height(result: Result) -> Figure:
    """Return the height above the origin over time."""
    up = -result.run.position_m[:, 2]
    shown = limits(up, share=100.0)
    axes = {"xaxis": _time_axis(result), "yaxis": axis("height above origin [m]")}
    if shown is not None:
        margin = 0.15 * (shown[1] - shown[0])
        axes["yaxis"]["range"] = [shown[0] - margin, shown[1] + margin]
    figure: Figure = {"data": _height_traces(result, 1, legend=True), "layout": layout(420, **axes)}
    figure["layout"]["shapes"] = _contact_shapes(result)
    return figure


def position(result: Result) -> Figure:
    """Return the position's errors with their 3 sigma band, or the position itself without a truth."""
    return _three_panels(result, _curves(result, "position"))


def velocity(result: Result) -> Figure:
    """Return the same for the velocity."""
    return _three_panels(result, _curves(result, "velocity"))


def attitude(result: Result) -> Figure:
    """Return the same for roll, pitch and yaw, in degrees."""
    return _three_panels(result, _curves(result, "attitude"))


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
    axes = stacked([f"innovation [{unit}]", "NIS"], [reach, None], SECONDS, result.duration_s)
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
    axes = {"xaxis": _time_axis(result), "yaxis": axis("measurements per second")}
    return {"data": data, "layout": layout(330, barmode="stack", bargap=0, hovermode="x unified", **axes)}


def states(result: Result, block: str) -> Figure:
    """Return the entries of one block of the state with their 3 sigma bands, one panel each."""
    t = result.t_s
    chosen = [i for i, n in enumerate(result.run.state_names) if n.split(".")[0] == block]
    unit, factor = _block_unit(block)
    data: list[Trace] = []
    ranges = []
    titles = []
    for row, i in enumerate(chosen, start=1):
        value = result.state_values[:, i] * factor
        sigma = 3.0 * result.run.sigma[:, i] * factor
        data += band(t, value - sigma, value + sigma, "±3 sigma", row, legend=row == 1)
        data.append(line(t, value, "estimate", OURS, row, legend=row == 1))
        late = t > 0.25 * t[-1] if len(t) else np.zeros(0, dtype=bool)
        ranges.append(limits(value, (value - sigma)[late], (value + sigma)[late]))
        component = result.run.state_names[i].split(".")[-1]
        titles.append(f"{label(component)} [{unit}]")
    return {
        "data": data,
        "layout": layout(90 + 100 * len(chosen), **stacked(titles, ranges, SECONDS, result.duration_s)),
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
        "xaxis": _time_axis(result),
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


def overview(result: Result) -> Figure:
    """Return the track, the height and the position (its error, where truth is known) in one figure."""
    curves = _curves(result, "position")
    data = _track_traces(result, 1) + _height_traces(result, 2, legend=False)
    data += _curve_traces(result, curves, 3, legend=False)
    axes = {
        "xaxis": axis("east [m]", domain=[0.0, 0.46], constrain="domain"),
        "yaxis": axis("north [m]", domain=[0.56, 1.0], scaleanchor="x", scaleratio=1),
        "xaxis2": axis("s", domain=[0.56, 1.0], anchor="y2"),
        "yaxis2": axis("height [m]", domain=[0.56, 1.0], anchor="x2"),
    }
    for i, (title, limit) in enumerate(zip(_titles(curves), _ranges(result, curves), strict=True)):
        n = i + 3
        bottom = 0.32 - 0.16 * i
        axes[f"xaxis{n}"] = axis("s" if i == 2 else "", anchor=f"y{n}", showticklabels=i == 2, matches="x3")
        axes[f"yaxis{n}"] = axis(title, domain=[bottom, bottom + 0.135], anchor=f"x{n}", range=limit)
    del axes["xaxis3"]["matches"]
    return {"data": data, "layout": layout(860, title={"text": label(result.flight)}, **axes)}


def _track_traces(result: Result, axes: int) -> list[Trace]:
    data: list[Trace] = []
    for name, (_, xyz), colour, style in _others(result):
        data.append(_path(xyz, name, colour, axes, **style))
    data.append(_path(result.run.position_m, "deckfix", OURS, axes, width=1.8))
    if len(result.run.t_ns):
        ends = result.run.position_m[[0, -1]]
        for text, row, symbol in (("start", ends[0], "circle-open"), ("end", ends[1], "square-open")):
            marker = points(row[1:2], row[0:1], text, OURS, axes, size=10, symbol=symbol)
            data.append(marker | {"marker": {**marker["marker"], "line": {"width": 2}}})
    return data


def _path(xyz: Array, name: str, colour: str, axes: int, **style: Any) -> Trace:
    step = max(1, len(xyz) // 2400)
    trace = line(np.zeros(0), np.zeros(0), name, colour, axes, **style)
    return trace | {"x": xyz[::step, 1].astype(np.float32), "y": xyz[::step, 0].astype(np.float32)}


def _height_traces(result: Result, axes: int, *, legend: bool) -> list[Trace]:
    data: list[Trace] = []
    for name, (t, xyz), colour, style in _others(result):
        data.append(line(t, -xyz[:, 2], name, colour, axes, legend=legend, **style))
    up = -result.run.position_m[:, 2]
    sigma = 3.0 * np.sqrt(np.maximum(result.run.covariance[:, 2, 2], 0.0))
    data += band(result.t_s, up - sigma, up + sigma, "±3 sigma", axes, legend=legend)
    data.append(line(result.t_s, up, "deckfix", OURS, axes, legend=legend, width=1.8))
    return data


def _others(result: Result) -> list[tuple[str, tuple[Array, Array], str, dict[str, Any]]]:
    """Return name, (seconds, positions in the estimate's datum), colour and style of each reference."""
    out: list[tuple[str, tuple[Array, Array], str, dict[str, Any]]] = []
    known: tuple[tuple[str, Trajectory | None, str, dict[str, Any]], ...] = (
        ("truth", result.truth, TRUTH, {"dash": "dot"}),
        ("autopilot", result.autopilot, AUTOPILOT, {}),
    )
    for name, trajectory, colour, style in known:
        if trajectory is None or trajectory.position_m is None:
            continue
        own = trajectory.position_m
        datum = (
            np.nanmedian(result.run.position_m - own.at(result.run.t_ns), axis=0) if len(result.t_s) else 0.0
        )
        shifted = own.values + np.where(np.isfinite(datum), datum, 0.0)
        out.append((name, (result.seconds_of(own.t_ns), shifted), colour, dict(style)))
    return out


def _curves(result: Result, quantity: str) -> _Curves:
    run = result.run
    if quantity == "attitude":
        names, unit, factor = ("roll", "pitch", "yaw"), "deg", 180.0 / np.pi
        own = np.unwrap(result.euler_rad, axis=0)
        sigma = euler_sigmas(run.quaternion, run.covariance[:, 6:9, 6:9])
        field = "attitude_rad"
    else:
        names, factor = ("north", "east", "down"), 1.0
        first = 0 if quantity == "position" else 3
        unit = "m" if quantity == "position" else "m/s"
        own = run.position_m if quantity == "position" else run.velocity_mps
        field = "position_m" if quantity == "position" else "velocity_mps"
        diagonal = np.einsum("nii->ni", run.covariance)[:, first : first + 3]
        sigma = np.sqrt(np.maximum(diagonal, 0.0))
    errors = result.truth_errors
    if errors is not None and np.isfinite(getattr(errors, field)).any():
        ours = getattr(errors, field) * factor
        theirs = result.at_autopilot.autopilot if result.at_autopilot is not None else None
        return _Curves(
            names, unit, ours, sigma * factor, np.zeros_like(ours),
            None if theirs is None else result.seconds_of(theirs.t_ns),
            None if theirs is None else getattr(theirs, field) * factor,
            True,
        )  # fmt: skip
    seconds, theirs_values = _autopilot_values(result, quantity)
    ours = own * factor
    return _Curves(
        names, unit, ours, sigma * factor, ours, seconds,
        None if theirs_values is None else theirs_values * factor, False,
    )  # fmt: skip


def _autopilot_values(result: Result, quantity: str) -> tuple[Array | None, Array | None]:
    """Return seconds and values of the autopilot's own estimate, its position in our datum."""
    reference = result.autopilot
    if reference is None or not len(result.t_s):
        return None, None
    if quantity == "position":
        for name, (seconds, values), _, _ in _others(result):
            if name == "autopilot":
                return seconds, values
        return None, None
    if quantity == "velocity":
        if reference.velocity_mps is None:
            return None, None
        return result.seconds_of(reference.velocity_mps.t_ns), reference.velocity_mps.values
    if reference.quaternion is None:
        return None, None
    from estimation.frames import quat_to_euler_columns

    angles = quat_to_euler_columns(reference.quaternion_at(reference.quaternion.t_ns))
    angles = np.unwrap(angles, axis=0)
    seconds = result.seconds_of(reference.quaternion.t_ns)
    # Whole turns between the two unwrapped yaws say nothing.
    ours = np.interp(seconds, result.t_s, np.unwrap(result.euler_rad[:, 2]))
    angles[:, 2] += 2.0 * np.pi * np.round(np.median(ours - angles[:, 2]) / (2.0 * np.pi))
    return seconds, angles


def _titles(curves: _Curves) -> list[str]:
    what = " error" if curves.are_errors else ""
    return [f"{name}{what} [{curves.unit}]" for name in curves.names]


def _ranges(result: Result, curves: _Curves) -> list[tuple[float, float] | None]:
    out = []
    for i in range(3):
        typical = 3.0 * np.nanmedian(curves.sigma[:, i : i + 1], axis=0) if len(curves.sigma) else np.zeros(0)
        if curves.are_errors:
            judged = result.judged.inside(result.run.t_ns)
            shown = [curves.ours[judged, i]]
            if curves.autopilot is not None:
                shown.append(curves.autopilot[:, i])
            reach = limits(*shown, symmetric=True)
            wide = limits(*shown, typical, symmetric=True)
            # A band far wider than the errors would leave nothing of them to see.
            out.append(
                wide
                if reach is None or wide is None
                else (-min(wide[1], 5 * reach[1]), min(wide[1], 5 * reach[1]))
            )
        else:
            shown = [curves.ours[:, i], curves.ours[:, i] - typical, curves.ours[:, i] + typical]
            out.append(limits(*shown))
    return out


def _curve_traces(result: Result, curves: _Curves, first_axes: int, *, legend: bool) -> list[Trace]:
    data: list[Trace] = []
    t = result.t_s
    for i in range(3):
        axes, show = first_axes + i, legend and i == 0
        low, high = curves.centre[:, i] - 3 * curves.sigma[:, i], curves.centre[:, i] + 3 * curves.sigma[:, i]
        data += band(t, low, high, "±3 sigma", axes, legend=show)
        if curves.autopilot is not None and curves.autopilot_s is not None:
            data.append(
                line(curves.autopilot_s, curves.autopilot[:, i], "autopilot", AUTOPILOT, axes, legend=show)
            )
        data.append(line(t, curves.ours[:, i], "deckfix", OURS, axes, legend=show))
    return data


def _three_panels(result: Result, curves: _Curves) -> Figure:
    axes = stacked(_titles(curves), _ranges(result, curves), SECONDS, result.duration_s)
    shapes = [s for row in (1, 2, 3) for s in _contact_shapes(result, row)]
    return {
        "data": _curve_traces(result, curves, 1, legend=True),
        "layout": layout(500, shapes=shapes, **axes),
    }


def _contact_shapes(result: Result, row: int = 1) -> list[dict[str, object]]:
    """Return a line at the moment of contact, where it is known."""
    if result.judged.contact_ns is None:
        return []
    t = result.seconds(result.judged.contact_ns)
    suffix = "" if row == 1 else str(row)
    return [
        {
            "type": "line", "xref": f"x{suffix}", "yref": f"y{suffix} domain",
            "x0": t, "x1": t, "y0": 0, "y1": 1,
            "line": {"color": GREY, "width": 1, "dash": "dash"},
        }
    ]  # fmt: skip


def _time_axis(result: Result) -> dict[str, object]:
    return axis(SECONDS, range=[0.0, max(result.duration_s, 1e-3)])


def _block_unit(block: str) -> tuple[str, float]:
    if block == "gyro_bias":
        return "deg/s", 180.0 / np.pi
    units = {
        "accel_bias": "m/s²",
        "gps_bias": "m",
        "baro_bias": "m",
        "camera_latency": "s",
        "camera_mount": "rad",
    }
    return units.get(block, "-" if block == "range_scale" else "m"), 1.0


def _running_mean(values: Array, width: int) -> Array:
    """Return the centred mean of up to ``width`` neighbours."""
    total = np.concatenate([[0.0], np.cumsum(values)])
    n = len(values)
    low = np.maximum(np.arange(n) - width // 2, 0)
    high = np.minimum(np.arange(n) + width // 2 + 1, n)
    mean: Array = (total[high] - total[low]) / (high - low)
    return mean

"""The figures of the report, each from a ``Result``; see docs/report.md for how to read them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from deckfix.plotting import (
    AUTOPILOT,
    GREY,
    OURS,
    SMOOTHED,
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
    stacked,
    time_axis,
)
from deckfix.reference import Trajectory, euler_sigmas
from deckfix.result import Result


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
    axes = {"xaxis": time_axis(result.duration_s), "yaxis": axis("height above origin [m]")}
    if shown is not None:
        margin = 0.15 * (shown[1] - shown[0])
        axes["yaxis"]["range"] = [shown[0] - margin, shown[1] + margin]
    figure: Figure = {"data": _height_traces(result, 1, legend=True), "layout": layout(420, **axes)}
    figure["layout"]["shapes"] = contact_shapes(result)
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
    smoothed = result.smoothed
    if smoothed is not None and result.truth is None and len(smoothed.t_ns):
        own_path = (result.seconds_of(smoothed.t_ns), smoothed.position_m)
        out.append(("smoothed", own_path, SMOOTHED, {"dash": "dot"}))
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
    axes = stacked(_titles(curves), _ranges(result, curves), result.duration_s)
    shapes = [s for row in (1, 2, 3) for s in contact_shapes(result, row)]
    return {
        "data": _curve_traces(result, curves, 1, legend=True),
        "layout": layout(500, shapes=shapes, **axes),
    }


def contact_shapes(result: Result, row: int = 1) -> list[dict[str, object]]:
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

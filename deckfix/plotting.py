"""Parts of plotly figures, as plain dictionaries: lines, bands, axes, and decimation that keeps the
extremes.

A figure is ``{"data": [...], "layout": {...}}``; arrays in it are float32 NumPy arrays. Text that comes
from a log passes through ``label``, since plotly reads a little HTML in the text it is given.
"""

from __future__ import annotations

import html
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Figure = dict[str, Any]
Trace = dict[str, Any]

OURS = "#0b5cad"
AUTOPILOT = "#c2601a"
TRUTH = "#1c1f23"
SMOOTHED = "#2f7d5b"
BAD = "#b3261e"
AXES = ("#0b5cad", "#2a7f62", "#8a4fa3")
FONT = "system-ui, -apple-system, 'Segoe UI', Roboto, 'Noto Sans', 'DejaVu Sans', Arial, sans-serif"
INK = "#1c1f23"
GREY = "#5b6470"
GRID = "#e6e9ee"

BUCKETS = 800
SECONDS = "seconds from the first inertial sample"


def label(text: str, longest: int = 60) -> str:
    """Return text from a log as it may stand in a plot: one line, no control characters, no mark-up."""
    clean = "".join(c if c.isprintable() else "\N{REPLACEMENT CHARACTER}" for c in text)
    if len(clean) > longest:
        clean = clean[: longest - 1] + "…"
    return html.escape(clean)


def decimate(x: Array, y: Array, buckets: int = BUCKETS) -> tuple[Array, Array]:
    """Return at most 2 ``buckets`` points of a curve: the lowest and the highest of each bucket, in their
    order.

    ``x`` and ``y`` are (n,); NaN in ``y`` are kept as gaps only in buckets that hold nothing else.
    """
    n = len(x)
    if n <= 2 * buckets:
        return x, y
    edges = np.linspace(0, n, buckets + 1).astype(np.int64)[:-1]
    low = _first_of_bucket(np.where(np.isnan(y), np.inf, y), edges, np.minimum)
    high = _first_of_bucket(np.where(np.isnan(y), -np.inf, y), edges, np.maximum)
    index = np.stack([np.minimum(low, high), np.maximum(low, high)], axis=1).ravel()
    keep = np.append(True, index[1:] != index[:-1])
    index = index[keep]
    return x[index], y[index]


def _first_of_bucket(y: Array, edges: NDArray[np.int64], extreme: np.ufunc) -> NDArray[np.int64]:
    sizes = np.diff(np.append(edges, len(y)))
    hits = np.flatnonzero(y == np.repeat(extreme.reduceat(y, edges), sizes))
    return hits[np.searchsorted(hits, edges)]


def line(
    x: Array, y: Array, name: str, colour: str, axes: int = 1, *, legend: bool = True, **style: Any
) -> Trace:
    """Return a decimated curve on the axes with this number; ``style`` goes to plotly's ``line``."""
    x, y = decimate(np.asarray(x, np.float64), np.asarray(y, np.float64))
    return {
        "type": "scatter",
        "mode": "lines",
        "x": x.astype(np.float32),
        "y": y.astype(np.float32),
        "name": name,
        "legendgroup": name,
        "showlegend": legend,
        "line": {"color": colour, "width": 1.4, **style},
        **axis_names(axes),
    }


def points(
    x: Array, y: Array, name: str, colour: str, axes: int = 1, *, legend: bool = True, **style: Any
) -> Trace:
    """Return decimated points; ``style`` goes to plotly's ``marker``."""
    trace = line(x, y, name, colour, axes, legend=legend)
    del trace["line"]
    return {**trace, "mode": "markers", "marker": {"color": colour, "size": 4, **style}}


def band(
    x: Array, low: Array, high: Array, name: str, axes: int = 1, *, colour: str = OURS, legend: bool = True
) -> list[Trace]:
    """Return the filled area between two curves (the widest of each bucket)."""
    x, low, high = (np.asarray(v, np.float64) for v in (x, low, high))
    if len(x) > BUCKETS:
        edges = np.linspace(0, len(x), BUCKETS + 1).astype(np.int64)[:-1]
        x, low, high = x[edges], np.fmin.reduceat(low, edges), np.fmax.reduceat(high, edges)
    shared: Trace = {
        "type": "scatter",
        "mode": "lines",
        "x": x.astype(np.float32),
        "line": {"width": 0},
        "hoverinfo": "skip",
        "legendgroup": name,
        **axis_names(axes),
    }
    lower = {**shared, "y": low.astype(np.float32), "showlegend": False}
    fill = {"fill": "tonexty", "fillcolor": rgba(colour, 0.14)}
    return [lower, {**shared, "y": high.astype(np.float32), "name": name, "showlegend": legend, **fill}]


def rgba(colour: str, alpha: float) -> str:
    """Return a colour of the form #rrggbb with an opacity."""
    red, green, blue = (int(colour[i : i + 2], 16) for i in (1, 3, 5))
    return f"rgba({red},{green},{blue},{alpha:g})"


def axis_names(number: int) -> dict[str, str]:
    """Return the names of the pair of axes with this number, as a trace refers to them."""
    suffix = "" if number == 1 else str(number)
    return {"xaxis": f"x{suffix}", "yaxis": f"y{suffix}"}


def axis(title: str = "", **more: Any) -> dict[str, Any]:
    """Return an axis in the style of the report."""
    return {
        "title": {"text": title, "font": {"size": 12, "color": GREY}, "standoff": 6},
        "gridcolor": GRID,
        "zeroline": False,
        "linecolor": "#c9ced6",
        "ticks": "outside",
        "ticklen": 3,
        "tickcolor": "#c9ced6",
        "tickfont": {"size": 11, "color": GREY},
        **more,
    }


def time_axis(end: float) -> dict[str, Any]:
    """Return the time axis of a figure with one panel, from 0 to ``end`` seconds."""
    return axis(SECONDS, range=[0.0, max(end, 1e-3)])


def layout(height: int, **more: Any) -> dict[str, Any]:
    """Return the layout that all figures share; they are as wide as their place."""
    return {
        "height": height,
        "margin": {"l": 58, "r": 12, "t": 34, "b": 40},
        "paper_bgcolor": "#ffffff",
        "plot_bgcolor": "#ffffff",
        "font": {"family": FONT, "size": 12, "color": INK},
        "legend": {"orientation": "h", "x": 0, "y": 0.995, "yanchor": "top", "yref": "container"},
        "hovermode": "x",
        "hoverlabel": {"font": {"family": FONT, "size": 12}},
        "dragmode": "zoom",
        **more,
    }


def stacked(
    titles: Sequence[str], ranges: Sequence[tuple[float, float] | None], end: float
) -> dict[str, Any]:
    """Return axes for panels one above the other that share their time axis, 0 to ``end``, the first on
    top.
    """
    n = len(titles)
    gap = 0.035 if n > 1 else 0.0
    tall = (1.0 - gap * (n - 1)) / n
    out: dict[str, Any] = {}
    for i, (title, limits) in enumerate(zip(titles, ranges, strict=True)):
        suffix = "" if i == 0 else str(i + 1)
        top = 1.0 - i * (tall + gap)
        last = i == n - 1
        out[f"xaxis{suffix}"] = axis(
            SECONDS if last else "",
            anchor=f"y{suffix}",
            showticklabels=last,
            **({"range": [0.0, max(end, 1e-3)]} if i == 0 else {"matches": "x"}),
        )
        y = axis(title, anchor=f"x{suffix}", domain=[max(0.0, top - tall), top])
        if limits is not None:
            y["range"] = list(limits)
        out[f"yaxis{suffix}"] = y
    return out


def limits(*curves: Array, share: float = 99.5, symmetric: bool = False) -> tuple[float, float] | None:
    """Return a range that shows all but the wildest values of the curves; None where nothing is finite."""
    kept = [c[np.isfinite(c)] for c in curves]
    kept = [c for c in kept if len(c)]
    if not kept:
        return None
    if symmetric:
        reach = max(float(np.percentile(np.abs(c), share)) for c in kept)
        reach = 1.15 * reach if reach > 0.0 else 1.0
        return -reach, reach
    low = min(float(np.percentile(c, 100.0 - share)) for c in kept)
    high = max(float(np.percentile(c, share)) for c in kept)
    margin = 0.08 * (high - low) or max(abs(high), 1.0) * 0.1
    return low - margin, high + margin

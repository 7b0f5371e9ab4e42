"""The report's figures of the platform: relative position, height of the deck, clocks and latency over time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from deckfix.clock_track import ClockTrack
from deckfix.deck_reference import first_fix_ns, true_height, truth_of_deck
from deckfix.figures import contact_shapes
from deckfix.plotting import (
    OURS,
    TRUTH,
    Array,
    Figure,
    Trace,
    band,
    label,
    layout,
    limits,
    line,
    points,
    stacked,
)
from deckfix.result import Result
from estimation.state import CAMERA_LATENCY, NOMINAL

AXIS_NAMES = ("north", "east", "down")
FIX = "#8d96a3"


def relative(result: Result) -> Figure:
    """Return P_uav - P_platform with its 3 sigma band and the raw fixes; their errors where truth is known."""
    seen = _seen(result)
    t = result.t_s[seen]
    errors = result.deck_errors
    sigma = 3.0 * np.sqrt(np.maximum(result.run.deck_covariance[seen][:, range(3), range(3)], 0.0))
    centre = np.zeros_like(sigma)
    ours = result.run.deck[seen, :3]
    fixes = _fixes(result, as_errors=errors is not None)
    if errors is not None:
        ours = errors.relative.position_m[seen]
    else:
        centre = ours
    data: list[Trace] = []
    ranges, titles = [], []
    for i, name in enumerate(AXIS_NAMES):
        show = i == 0
        if fixes is not None:
            raw = points(fixes[0], fixes[1][:, i], "raw fix", FIX, i + 1, legend=show, size=3, opacity=0.55)
            data.append(raw | {"hoverinfo": "skip"})
        data += band(
            t, centre[:, i] - sigma[:, i], centre[:, i] + sigma[:, i], "±3 sigma", i + 1, legend=show
        )
        data.append(line(t, ours[:, i], "deckfix", OURS, i + 1, legend=show, width=1.6))
        shown = [ours[:, i]] if fixes is None else [ours[:, i], fixes[1][:, i]]
        wide = (
            [centre[:, i] + np.nanmedian(sigma[:, i]), centre[:, i] - np.nanmedian(sigma[:, i])]
            if len(t)
            else []
        )
        ranges.append(limits(*shown, *wide, share=99.8, symmetric=errors is not None))
        titles.append(f"{name}{' error' if errors is not None else ''} [m]")
    axes = stacked(titles, ranges, result.duration_s)
    return {"data": data, "layout": layout(500, shapes=_contact(result, 3), **axes)}


def deck_height(result: Result) -> Figure:
    """Return height and rate of the deck, up, with their bands and the truth.

    The height's band is that of its distance below the vehicle: the level of both hangs on GPS and barometer.
    """
    seen = _seen(result)
    t = result.t_s[seen]
    data: list[Trace] = []
    ranges: list[tuple[float, float] | None] = []
    truth = true_height(result.run, result.platform) if result.platform is not None else None
    speed = result.platform.velocity_mps if result.platform is not None else None
    true_columns = [
        None if truth is None else (truth.t_ns, truth.values[:, 0]),
        None if speed is None else (speed.t_ns, -speed.values[:, 2]),
    ]
    for row in (0, 1):
        value = result.run.deck[seen, 6 + row]
        k = 7 if row else 2
        sigma = 3.0 * np.sqrt(np.maximum(result.run.deck_covariance[seen, k, k], 0.0))
        data += band(t, value - sigma, value + sigma, "±3 sigma", row + 1, legend=row == 0)
        known = true_columns[row]
        if known is not None:
            s = result.seconds_of(known[0])
            data.append(line(s, known[1], "truth", TRUTH, row + 1, legend=row == 0, dash="dot"))
        data.append(line(t, value, "deckfix", OURS, row + 1, legend=row == 0, width=1.6))
        typical = np.nanmedian(sigma) if len(sigma) else 0.0
        ranges.append(limits(value, value + typical, value - typical, share=99.8))
    axes = stacked(["deck height [m, up]", "its rate [m/s, up]"], ranges, result.duration_s)
    return {"data": data, "layout": layout(440, shapes=_contact(result, 2), **axes)}


def clocks(result: Result) -> Figure:
    """Return how each clock's offset moved from its first value, and the age of the fixes, with 3 sigma bands."""
    rows: list[str] = []
    ranges: list[tuple[float, float] | None] = []
    data: list[Trace] = []
    for track in result.clock_tracks:
        rows.append(f"{label(track.clock, 16)} [ms]")
        ranges.append(_clock_traces(result, track, len(rows), data))
    latency = latency_track(result)
    if latency is not None:
        t, value, sigma = latency
        rows.append("latency of fixes [ms]")
        first = len(rows) == 1
        data += band(t, value - 3 * sigma, value + 3 * sigma, "±3 sigma", len(rows), legend=first)
        data.append(line(t, value, "estimate", OURS, len(rows), legend=first, width=1.6))
        ranges.append(limits(value, value + 3 * sigma, value - 3 * sigma, share=100.0))
    return {"data": data, "layout": layout(110 + 150 * len(rows), **stacked(rows, ranges, result.duration_s))}


def latency_track(result: Result) -> tuple[Array, Array, Array] | None:
    """Return seconds, age of a fix at its stamp [ms] and its 1 sigma [ms] from the first fix on; None without."""
    if not result.has_deck:
        return None
    seen = _seen(result)
    k = result.run.state_names.index("camera_latency.t")
    age = result.vision_latency_s + result.run.nominal[seen, NOMINAL[CAMERA_LATENCY]]
    return result.t_s[seen], 1e3 * age, 1e3 * result.run.sigma[seen, k]


def _clock_traces(
    result: Result, track: ClockTrack, row: int, data: list[Trace]
) -> tuple[float, float] | None:
    t = result.seconds_of(track.t_ns)
    moved = track.offset_ms - track.offset_ms[-1]
    sigma = 3.0 * np.where(np.isfinite(track.sigma_ms), track.sigma_ms, np.nan)
    data += band(t, moved - sigma, moved + sigma, "±3 sigma", row, legend=row == 1)
    data.append(line(t, moved, "estimate", OURS, row, legend=row == 1, width=1.6))
    late = t > 5.0
    return limits(moved, (moved - sigma)[late], (moved + sigma)[late])


def _seen(result: Result) -> NDArray[np.bool_]:
    """Return which estimates are from the first fix on: before it nothing is known of the platform."""
    first = first_fix_ns(result.run)
    mask: NDArray[np.bool_] = result.run.t_ns >= (first if first is not None else np.iinfo(np.int64).max)
    return mask


def fix_errors(result: Result) -> Array | None:
    """Return the raw fixes' errors (m, 3) of relative position; None without fixes or truth."""
    if result.fixes is None or result.truth is None or result.platform is None:
        return None
    truth = truth_of_deck(result.truth, result.platform)
    if truth is None or truth.position_m is None:
        return None
    errors: Array = result.fixes.relative_m - truth.position_m.at(result.fixes.t_ns)
    return errors


def _fixes(result: Result, *, as_errors: bool) -> tuple[Array, Array] | None:
    """Return seconds and relative positions of the raw fixes, or their errors."""
    if result.fixes is None:
        return None
    values = fix_errors(result) if as_errors else result.fixes.relative_m
    return None if values is None else (result.seconds_of(result.fixes.t_ns), values)


def _contact(result: Result, rows: int) -> list[dict[str, object]]:
    return [s for row in range(1, rows + 1) for s in contact_shapes(result, row)]

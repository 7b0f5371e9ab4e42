"""Heave forecast on real and simulated seas, against the optimal predictor and against what others do.

Real: twelve half-hours of a Datawell Waverider, scaled to Hs 0.6 m and put under a 2 m raft (``heave_series``).
Simulated: JONSWAP, Pierson-Moskowitz and swell under the same raft. Vision: 20 Hz, sigma 3 cm, 10 % dropped.
``ratio`` is the RMSE over that of the optimal predictor on the same windows, which knows the whole record's
spectrum; ``vs mean`` over that of the window's mean; NEES is the squared error over the stated variance.

    python benchmarks/heave.py [--windows 12] [--trials 20] [--span 60] [--json FILE]
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import heave_methods as methods
import numpy as np
from heave_series import HORIZONS_S, SIMULATED, Observation, find_data, real_windows, simulated_windows
from numpy.typing import NDArray
from targets import Target, Targets, provenance

from estimation import heave

Array = NDArray[np.float64]

TARGET_RATIO = {0.5: 1.20, 1.0: 1.20, 2.0: 1.15, 3.0: 1.10, 5.0: 1.10}
TARGET_MEAN = 1.05
TARGET_NEES = (0.8, 1.4)


@dataclass(slots=True)
class Cell:
    """Errors over the mean predictor's scale of one sea: method -> (windows, horizons) [m], and NEES terms."""

    name: str
    sd_m: float
    errors: dict[str, Array]
    nees: Array
    optimal_nees: Array
    covered: Array
    fit_ms: float
    hs_m: list[float]

    def rmse(self, method: str) -> Array:
        return np.asarray(np.sqrt(np.mean(self.errors[method] ** 2, axis=0)), np.float64)


def run_cell(name: str, observations: Iterable[Observation], everything: bool) -> Cell:
    """Every method on every window of one sea."""
    errors: dict[str, list[Array]] = {}
    nees, optimal_nees, covered, fits, hs, sd = [], [], [], [], [], 0.0
    for o in observations:
        sd = o.sd_m
        began = time.process_time()
        model = heave.fit(o.time_s, o.heave_m, o.sigma_m)
        fits.append(time.process_time() - began)
        mean, variance = model.forecast(HORIZONS_S)
        best, best_variance = methods.optimal(o)
        said = {"learned": mean, "optimal": best, "mean": methods.mean_level(o)}
        if everything:
            said["band-pass block"] = methods.band_pass(o, model)
            said["AR"] = methods.autoregressive(o)
            said["FFT oscillators"] = methods.peak_oscillators(o)
            said["constant velocity"] = methods.constant_velocity(o)
            for n in (1, 3):
                plain = heave.fit(o.time_s, o.heave_m, o.sigma_m, method="sinusoids", components=n)
                at = plain.coefficients.basis.values(HORIZONS_S) @ plain.coefficients.mean
                said[f"{n} sinusoid{'s' * (n > 1)}"] = plain.coefficients.offset_m + at
        for key, value in said.items():
            errors.setdefault(key, []).append(value - o.truth_m)
        nees.append((mean - o.truth_m) ** 2 / variance)
        optimal_nees.append((best - o.truth_m) ** 2 / best_variance)
        covered.append(np.abs(mean - o.truth_m) < 1.96 * np.sqrt(variance))
        hs.append(model.hs_m)
    arrays = {k: np.array(v) for k, v in errors.items()}
    return Cell(
        name,
        sd,
        arrays,
        np.array(nees),
        np.array(optimal_nees),
        np.array(covered),
        1e3 * float(np.median(fits)),
        hs,
    )


def pooled(cells: list[Cell]) -> Cell:
    """All windows of several cells as one, errors scaled by each cell's standard deviation."""
    keys = cells[0].errors.keys()
    return Cell(
        "all simulated",
        1.0,
        {k: np.vstack([c.errors[k] / c.sd_m for c in cells]) for k in keys},
        np.vstack([c.nees for c in cells]),
        np.vstack([c.optimal_nees for c in cells]),
        np.vstack([c.covered for c in cells]),
        float(np.median([c.fit_ms for c in cells])),
        [],
    )


def row(label: str, values: Array, form: str = "7.2f") -> None:
    print(f"  {label:30s}" + "".join(f" {v:{form}}" for v in values))


def show(cell: Cell) -> dict[str, Any]:
    """Print one cell's table and return its numbers."""
    n, sd, best = len(cell.nees), cell.sd_m, cell.rmse("optimal")
    print(f"\n{cell.name}: {n} windows, sd {100 * sd:.1f} cm, fit {cell.fit_ms:.0f} ms of CPU")
    row("horizon [s]", HORIZONS_S, "7.1f")
    row("optimal, RMSE / sd", best / sd)
    for key in cell.errors:
        if key != "optimal":
            row(f"ratio: {key}", cell.rmse(key) / best)
    row("learned vs mean", cell.rmse("learned") / cell.rmse("mean"))
    row("NEES learned", cell.nees.mean(axis=0))
    row("NEES optimal", cell.optimal_nees.mean(axis=0))
    row("inside 95 %", cell.covered.mean(axis=0))
    return {
        "windows": n,
        "sd_m": sd,
        "fit_ms": cell.fit_ms,
        "optimal_rmse_over_sd": (best / sd).round(4).tolist(),
        "ratio": {k: (cell.rmse(k) / best).round(4).tolist() for k in cell.errors if k != "optimal"},
        "vs_mean": (cell.rmse("learned") / cell.rmse("mean")).round(4).tolist(),
        "nees": cell.nees.mean(axis=0).round(3).tolist(),
        "nees_optimal": cell.optimal_nees.mean(axis=0).round(3).tolist(),
        "inside_95": cell.covered.mean(axis=0).round(4).tolist(),
    }


def targets(real: Cell) -> Targets:
    """Return the targets on real seas and what was reached."""
    ratio = real.rmse("learned") / real.rmse("optimal")
    versus = real.rmse("learned") / real.rmse("mean")
    nees = real.nees.mean(axis=0)
    out = Targets()
    for at, wanted in TARGET_RATIO.items():
        k = int(np.flatnonzero(at == HORIZONS_S)[0])
        out.add(Target(f"real seas: RMSE over the optimal at {at:g} s", float(ratio[k]), wanted))
    low, high = TARGET_NEES
    out.add(Target("real seas: RMSE over the mean predictor, worst", float(versus.max()), TARGET_MEAN))
    out.add(Target("real seas: NEES, least", float(nees.min()), low, at_least=True))
    out.add(Target("real seas: NEES, largest", float(nees.max()), high))
    return out


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split("\n", maxsplit=1)[0] if __doc__ else None)
    parser.add_argument("--windows", type=int, default=12, help="windows per real half-hour")
    parser.add_argument("--trials", type=int, default=20, help="trials per simulated sea")
    parser.add_argument("--span", type=float, default=60.0, help="length of a window [s]")
    parser.add_argument("--sigma", type=float, default=0.03, help="noise of a fix [m]")
    parser.add_argument("--json", type=Path)
    arguments = parser.parse_args()
    began = time.perf_counter()
    out: dict[str, Any] = {
        "benchmark": "heave",
        **provenance(),
        "horizon_s": HORIZONS_S.tolist(),
        "span_s": arguments.span,
        "cells": {},
    }
    folder = find_data()
    real = None
    if folder is None:
        print("real records not found: set DECKFIX_DATA; simulated seas only")
    else:
        windows = real_windows(folder, arguments.windows, arguments.span, arguments.sigma, seed=1)
        real = run_cell("Waverider records, 12 half-hours", windows, everything=True)
        out["cells"][real.name] = show(real)
    cells = []
    for seed, (name, waves) in enumerate(SIMULATED.items()):
        seas = simulated_windows(waves, arguments.trials, arguments.span, arguments.sigma, seed)
        cells.append(run_cell(name, seas, everything=True))
        out["cells"][name] = show(cells[-1])
    together = pooled(cells)
    out["cells"][together.name] = show(together)
    judged = Targets() if real is None else targets(real)
    good = judged.report()
    out["targets"] = judged.as_rows()
    print(f"\n{time.perf_counter() - began:.0f} s")
    if arguments.json:
        arguments.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())

"""Is the filter honest? Simulated flights of each scenario, NEES and NIS part by part, and the forecasts' coverage.

    python benchmarks/consistency.py [--full] [--flights 10] [--scenario NAME ...] [--first-seed 1000] [--jobs 1]
                                     [--json FILE] [--no-gate]

Two scenarios without vision, and landings on a raft in Beaufort 1, 2 and 3, with swell, and while GPS wanders by
metres: search without vision (climb, cruise), tracking (the first 12 s in sight), observation (hover), a loss of vision
of 5 s (blind), final descent. ``--full`` flies 50 of each. Sensors are drawn from what the filter is told.

Printed are means over the degrees of freedom; 1 is honest, above it the filter trusts itself too much, below too
little. A star marks a mean outside the 95 % band for so many runs; of many honest means some fall outside by chance, so
the targets are nine in ten inside it, and all inside that of 99.9 %.
The forecasts' 95 % intervals, of all models learned in flight and at each horizon, should hold 92 to 98 % of what then
happened, the true deck on the estimate's level. Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from targets import Target, Targets, provenance

from deckfix.deck_reference import true_height
from deckfix.forecasts import WIDTH_95, forecasts
from deckfix.reference import Trajectory, column
from estimation.consistency import RunsConsistency
from simulation.flight import load_scenario
from simulation.montecarlo import PARTS, FlightErrors, fly, nees_by_phase, nis_by_phase

SCENARIOS = (
    "consistency_default_2026_06",
    "consistency_survey_2026_06",
    "consistency_beaufort1_2026_11",
    "consistency_beaufort2_2026_11",
    "consistency_beaufort3_2026_11",
    "consistency_swell_2026_11",
    "consistency_wander_2026_11",
)
QUICK, FULL = 10, 50
HORIZONS_S = (0.5, 1.0, 2.0, 3.0, 5.0)
COVERAGE = (0.92, 0.98)


def rows(result: dict[tuple[str, str], RunsConsistency]) -> list[str]:
    lines = []
    for name in dict.fromkeys(name for name, _ in result):
        known = {phase: result[name, phase] for phase in PARTS if (name, phase) in result}
        band = next(iter(known.values())).band
        cells = [
            f"{known[p].mean_over_dof:7.2f}{' ' if known[p].consistent else '*'}"
            if p in known
            else "       -"
            for p in PARTS
        ]
        lines.append(f"{name:14s} {band.low:5.2f} to {band.high:4.2f} " + "".join(cells))
    return lines


def numbers(result: dict[tuple[str, str], RunsConsistency]) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for (name, phase), c in result.items():
        out.setdefault(name, {})[phase] = round(c.mean_over_dof, 4)
    return out


def coverage(flights: Sequence[FlightErrors]) -> list[dict[str, Any]]:
    """Return how many of all flights' forecasts hold the true height, by horizon; nothing where none were made."""
    held: list[np.ndarray] = []
    known: list[np.ndarray] = []
    for f in flights:
        if not f.run.heave:
            continue
        t = f.run.t_ns
        deck = f.flight.trajectory.platform.motion(f.flight.clock.true_s(t)).position[0]
        happened = true_height(f.run, Trajectory(column(t, deck), None, None))
        assert happened is not None
        end_ns = t[-1] - int(
            1e9 * (f.flight.trajectory.plan.duration_s - f.flight.trajectory.plan.touchdown_s)
        )
        made = forecasts([(due, m) for due, m in f.run.heave if due < end_ns], HORIZONS_S)
        at = made.origin_ns[:, None] + np.round(made.horizon_s * 1e9).astype(np.int64)
        seen = happened.at(at.ravel())[:, 0].reshape(at.shape)
        known.append(np.isfinite(seen) & np.isfinite(made.sigma_m) & (at < end_ns))
        held.append(known[-1] & (np.abs(made.heave_m - seen) <= WIDTH_95 * made.sigma_m))
    if not known:
        return []
    total, inside = np.concatenate(known).sum(axis=0), np.concatenate(held).sum(axis=0)
    return [
        {"horizon_s": h, "count": int(n), "coverage_95": float(k / n)}
        for h, n, k in zip(HORIZONS_S, total, inside, strict=True)
        if n
    ]


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--flights", type=int, help=f"of each scenario; {QUICK} without it, {FULL} with --full"
    )
    parser.add_argument("--first-seed", type=int, default=1000)
    parser.add_argument("--full", action="store_true", help="as many flights as the targets ask for")
    parser.add_argument("--jobs", type=int, default=1, help="processes")
    parser.add_argument("--scenario", nargs="+", default=list(SCENARIOS))
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 in any case")
    arguments = parser.parse_args()
    count = arguments.flights or (FULL if arguments.full else QUICK)
    document: dict[str, object] = {"benchmark": "consistency", **provenance(), "flights": count}
    targets = Targets()
    for name in arguments.scenario:
        scenario = load_scenario(name)
        begin = time.perf_counter()
        flights = Parallel(arguments.jobs)(
            delayed(fly)(scenario, arguments.first_seed + k) for k in range(count)
        )
        wall = time.perf_counter() - begin
        print(f"\n{name}: {scenario.description}; {len(flights)} flights in {wall:.0f} s")
        nees, nis = nees_by_phase(flights), nis_by_phase(flights)
        heading = "".join(f"{phase:>8s}" for phase in PARTS)
        for title, result in (("NEES / dof", nees), ("NIS / dof", nis)):
            print(f"{title:14s} band          {heading}")
            print("\n".join(rows(result)))
        judged = [*nees.values(), *nis.values()]
        inside = sum(c.consistent for c in judged)
        print(f"{inside} of {len(judged)} means inside their 95 % band")
        wide = [*nees_by_phase(flights, 0.999).values(), *nis_by_phase(flights, 0.999).values()]
        targets.add(Target(f"{name}: share inside 95 %", inside / len(judged), 0.9, at_least=True))
        targets.add(Target(f"{name}: outside 99.9 %", sum(not c.consistent for c in wide), 0))
        row = {"nees": numbers(nees), "nis": numbers(nis), "inside": inside, "judged": len(judged)}
        forecast = coverage(flights)
        if forecast:
            row["forecast"] = forecast
            print("forecast, coverage of the 95 % interval: ", end="")
            print(", ".join(f"{r['coverage_95']:.1%} at {r['horizon_s']:g} s" for r in forecast), end="")
            print(f" (n {forecast[0]['count']})")
        for r in forecast:
            label = f"{name}: coverage at {r['horizon_s']:g} s"
            targets.add(Target(f"{label}, at least", r["coverage_95"], COVERAGE[0], at_least=True))
            targets.add(Target(f"{label}, at most", r["coverage_95"], COVERAGE[1]))
        document[name] = row
    met = targets.report()
    document["targets"] = targets.as_rows()
    if arguments.json:
        arguments.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    if not met and not arguments.no_gate:
        sys.exit(1)


if __name__ == "__main__":
    main()

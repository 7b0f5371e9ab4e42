"""Is the filter honest? Simulated flights of each scenario, NEES and NIS part by part, and the forecasts' coverage.

    python benchmarks/consistency.py [--full] [--flights 10] [--scenario NAME ...] [--first-seed 1000] [--jobs 1]
                                     [--json FILE] [--no-gate]

Two scenarios without vision, and landings by plan on a raft in Beaufort 1, 2 and 3, with swell, and while GPS wanders
by metres: search without vision (climb, cruise), tracking (the first 12 s in sight), observation (hover), a loss of
vision of 5 s (blind), final descent. Then landings that were flown on their own estimates, following the deck, mode by
mode. ``--full`` flies 50 of each. Sensors are drawn from what the filter is told.

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

import msgspec
import numpy as np
from joblib import Parallel, delayed
from landings import MISSION, SEAS
from targets import Target, Targets, provenance

from deckfix.deck_reference import true_height
from deckfix.forecasts import WIDTH_95, forecasts
from deckfix.reference import Trajectory, column
from estimation.consistency import RunsConsistency
from simulation.flight import load_scenario
from simulation.mission import load_mission
from simulation.montecarlo import FlightErrors, fly, land, nees_by_phase, nis_by_phase

SCENARIOS = (
    "consistency_default_2026_06",
    "consistency_survey_2026_06",
    "consistency_beaufort1_2026_11",
    "consistency_beaufort2_2026_11",
    "consistency_beaufort3_2026_11",
    "consistency_swell_2026_11",
    "consistency_wander_2026_11",
)
LANDINGS = {
    "landing_beaufort2": "Beaufort 2",
    "landing_beaufort3": "Beaufort 3",
    "landing_swell": "Beaufort 3 + swell",
}
QUICK, FULL = 10, 50
HORIZONS_S = (0.5, 1.0, 2.0, 3.0, 5.0)
COVERAGE = (0.92, 0.98)


def width(part: str) -> int:
    """Return the width of a part's column."""
    return max(8, len(part) + 1)


def rows(result: dict[tuple[str, str], RunsConsistency], parts: Sequence[str]) -> list[str]:
    lines = []
    for name in dict.fromkeys(name for name, _ in result):
        known = {phase: result[name, phase] for phase in parts if (name, phase) in result}
        band = next(iter(known.values())).band
        cells = [
            f"{known[p].mean_over_dof:{width(p) - 1}.2f}{' ' if known[p].consistent else '*'}"
            if p in known
            else f"{'-':>{width(p)}s}"
            for p in parts
        ]
        lines.append(f"{name:14s} {band.low:5.2f} to {band.high:4.2f} " + "".join(cells))
    return lines


def numbers(result: dict[tuple[str, str], RunsConsistency]) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for (name, phase), c in result.items():
        out.setdefault(name, {})[phase] = round(c.mean_over_dof, 4)
    return out


def flown(name: str, seeds: Sequence[int], jobs: int) -> tuple[list[FlightErrors], str]:
    """Return the flights of a scenario, by plan or on their own estimates, and what it is."""
    if name in LANDINGS:
        mission = msgspec.structs.replace(load_mission(MISSION), sea=SEAS[LANDINGS[name]])
        work = [delayed(land)(mission, seed) for seed in seeds]
        description = f"Search to contact on its own estimates in {LANDINGS[name]}"
    else:
        scenario = load_scenario(name)
        work, description = [delayed(fly)(scenario, seed) for seed in seeds], scenario.description
    return Parallel(jobs)(work), description


def coverage(flights: Sequence[FlightErrors]) -> list[dict[str, Any]]:
    """Return how many of all flights' forecasts hold the true height, by horizon; nothing where none were made."""
    held: list[np.ndarray] = []
    known: list[np.ndarray] = []
    for f in flights:
        if not f.run.heave:
            continue
        happened = true_height(f.run, Trajectory(column(f.run.t_ns, f.known.deck_m), None, None))
        assert happened is not None
        end_ns = int(f.known.clock.stamp_ns(np.array([f.known.contact_s]))[0])
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
    parser.add_argument("--scenario", nargs="+", default=[*SCENARIOS, *LANDINGS])
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 in any case")
    arguments = parser.parse_args()
    count = arguments.flights or (FULL if arguments.full else QUICK)
    document: dict[str, object] = {"benchmark": "consistency", **provenance(), "flights": count}
    targets = Targets()
    for name in arguments.scenario:
        begin = time.perf_counter()
        flights, description = flown(
            name, range(arguments.first_seed, arguments.first_seed + count), arguments.jobs
        )
        wall = time.perf_counter() - begin
        print(f"\n{name}: {description}; {len(flights)} flights in {wall:.0f} s")
        nees, nis = nees_by_phase(flights), nis_by_phase(flights)
        parts = flights[0].known.parts
        heading = "".join(f"{part:>{width(part)}s}" for part in parts)
        for title, result in (("NEES / dof", nees), ("NIS / dof", nis)):
            print(f"{title:14s} band          {heading}")
            print("\n".join(rows(result, parts)))
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

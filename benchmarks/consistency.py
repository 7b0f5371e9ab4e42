"""Is the filter honest? Fifty simulated flights of each scenario, NEES and NIS phase by phase.

    python benchmarks/consistency.py [--flights 50] [--scenario NAME ...] [--json FILE] [--no-gate]

Sensors are drawn from what the filter is told. Printed are means over the degrees of freedom; 1 is honest, above it the
filter trusts itself too much, below too little. A star marks a mean outside the 95 % band for so many runs; of many
honest means some fall outside by chance, so the targets are nine in ten inside it, and all inside that of 99.9 %.
Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path

from targets import Target, Targets, provenance

from estimation.consistency import RunsConsistency
from simulation.flight import load_scenario
from simulation.montecarlo import fly, nees_by_phase, nis_by_phase
from simulation.trajectory import PHASES

SCENARIOS = ("consistency_default_2026_06", "consistency_survey_2026_06")


def rows(result: dict[tuple[str, str], RunsConsistency]) -> list[str]:
    lines = []
    for name in dict.fromkeys(name for name, _ in result):
        known = {phase: result[name, phase] for phase in PHASES if (name, phase) in result}
        band = next(iter(known.values())).band
        cells = [
            f"{known[p].mean_over_dof:7.2f}{' ' if known[p].consistent else '*'}"
            if p in known
            else "       -"
            for p in PHASES
        ]
        lines.append(f"{name:14s} {band.low:5.2f} to {band.high:4.2f} " + "".join(cells))
    return lines


def numbers(result: dict[tuple[str, str], RunsConsistency]) -> dict[str, dict[str, float]]:
    out: dict[str, dict[str, float]] = {}
    for (name, phase), c in result.items():
        out.setdefault(name, {})[phase] = round(c.mean_over_dof, 4)
    return out


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=50)
    parser.add_argument("--scenario", nargs="+", default=list(SCENARIOS))
    parser.add_argument("--json", type=Path, help="write the numbers here")
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 in any case")
    arguments = parser.parse_args()
    document: dict[str, object] = {"benchmark": "consistency", **provenance(), "flights": arguments.flights}
    targets = Targets()
    for name in arguments.scenario:
        scenario = load_scenario(name)
        begin = time.perf_counter()
        flights = [fly(scenario, 1000 + seed) for seed in range(arguments.flights)]
        wall = time.perf_counter() - begin
        print(f"\n{name}: {scenario.description}; {len(flights)} flights in {wall:.0f} s")
        nees, nis = nees_by_phase(flights), nis_by_phase(flights)
        heading = "".join(f"{phase:>8s}" for phase in PHASES)
        for title, result in (("NEES / dof", nees), ("NIS / dof", nis)):
            print(f"{title:14s} band          {heading}")
            print("\n".join(rows(result)))
        judged = [*nees.values(), *nis.values()]
        inside = sum(c.consistent for c in judged)
        print(f"{inside} of {len(judged)} means inside their 95 % band")
        wide = [*nees_by_phase(flights, 0.999).values(), *nis_by_phase(flights, 0.999).values()]
        targets.add(Target(f"{name}: share inside 95 %", inside / len(judged), 0.9, at_least=True))
        targets.add(Target(f"{name}: outside 99.9 %", sum(not c.consistent for c in wide), 0))
        document[name] = {"nees": numbers(nees), "nis": numbers(nis), "inside": inside, "judged": len(judged)}
    met = targets.report()
    document["targets"] = targets.as_rows()
    if arguments.json:
        arguments.json.write_text(json.dumps(document, indent=1) + "\n", encoding="utf-8")
    if not met and not arguments.no_gate:
        sys.exit(1)


if __name__ == "__main__":
    main()

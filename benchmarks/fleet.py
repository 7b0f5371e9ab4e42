"""A folder of short simulated flights replayed by ``deckfix fleet`` with one worker and with two.

Each run is the command as a user gives it, start-up and loading of machine code included (some seconds of each worker,
so that very short flights gain less from a second one); runs with one worker and with two take turns, after one that is
not counted. Speed is the ratio of their wall times, given as median (smallest..largest, n), wanted >= 1.8; the load of
the machine before each run is printed, since another's work on it shows in the ratio. The tables must be equal, byte
for byte, whoever did the work: one worker, two, and the two workers of a Dask cluster where dask is installed.

    python benchmarks/fleet.py [--flights 100] [--repetitions 2] [--no-reports] [--json FILE] [--no-gate]

Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from joblib import Parallel, delayed
from targets import Target, Targets, provenance

from logs.writer import FlightWriter
from simulation.flight import parse_scenario, simulate

FASTER = 1.8
FLIGHT = """
description = "a short landing in Beaufort 2"
[plan]
rest_s = 4.0
climb_s = 4.0
leg_s = 5.0
hover_s = 30.0
descent_s = 6.0
deck_s = 1.0
altitude_m = 6.0
start_m = [-12.0, -9.0, -1.0]
legs_m = []
yaw_rad = [0.6, 0.4]
[sea]
beaufort = 2
"""
Row = dict[str, Any]


def write_flight(folder: Path, seed: int) -> None:
    """Write the log of one flight."""
    with FlightWriter(folder / f"flight{seed:03d}.mcap") as writer:
        writer.write_recording(simulate(parse_scenario(FLIGHT), seed).recording())


def replayed(folder: Path, output: Path, options: Sequence[str]) -> tuple[float, bytes]:
    """Return the wall time [s] of the command, and its table."""
    command = [sys.executable, "-m", "deckfix.cli", "fleet", str(folder), "-o", str(output), *options]
    begin = time.perf_counter()
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    wall = time.perf_counter() - begin
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}: {done.stderr.strip()}")
    return wall, (output / "flights.csv").read_bytes()


def on_dask(folder: Path, output: Path, options: Sequence[str]) -> bytes | None:
    """Return the table that two workers of a Dask cluster make, or None where dask is not installed."""
    if not importlib.util.find_spec("distributed"):
        print("the Dask cluster is left out: dask is not installed (pip install 'deckfix[cluster]')")
        return None
    import distributed

    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, host="127.0.0.1", dashboard_address=None
    )
    with cluster:
        return replayed(folder, output, [*options, "--scheduler", cluster.scheduler_address])[1]


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the times; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=100)
    parser.add_argument("--repetitions", type=int, default=2)
    parser.add_argument("--no-reports", action="store_true", help="leave out the reports (5 MB each)")
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    begin = time.perf_counter()
    extra = ["--no-reports"] if options.no_reports else []
    walls: dict[int, list[float]] = {1: [], 2: []}
    loads: list[float] = []
    tables: dict[str, bytes] = {}
    with tempfile.TemporaryDirectory() as scratch:
        folder = Path(scratch) / "logs"
        folder.mkdir()
        Parallel(n_jobs=2)(delayed(write_flight)(folder, seed) for seed in range(options.flights))
        few = Path(scratch) / "few"
        few.mkdir()
        write_flight(few, 0)
        replayed(few, Path(scratch) / "first", extra)
        for k in range(options.repetitions):
            for jobs in (1, 2):
                loads.append(os.getloadavg()[0])
                wall, table = replayed(folder, Path(scratch) / f"{k}-{jobs}", [*extra, "--jobs", str(jobs)])
                walls[jobs].append(wall)
                tables[f"{jobs} workers, run {k + 1}"] = table
                print(f"{jobs} workers: {wall:.1f} s (load before {loads[-1]:.1f})", flush=True)
        clustered = on_dask(folder, Path(scratch) / "dask", extra)
    ratios = sorted(a / b for a, b in zip(walls[1], walls[2], strict=True))
    middle = statistics.median(ratios)
    n, size = options.repetitions, options.flights
    print(f"{size} flights, one worker over two: {middle:.2f}x ({ratios[0]:.2f}..{ratios[-1]:.2f}, n {n})")
    targets = Targets()
    spread = ratios[-1] - ratios[0]
    targets.add(Target("fleet: one worker over two", middle, FASTER, at_least=True, spread=spread))
    reference = next(iter(tables.values()))
    lines = reference.count(b"\n") - 1
    targets.add(Target("fleet: rows of the table less flights", float(abs(lines - size)), 0))
    if clustered is not None:
        tables["Dask, 2 workers"] = clustered
    for name, table in tables.items():
        same = table == reference
        print(f"table of {name}: {'the same bytes' if same else 'DIFFERS'}")
        targets.add(Target(f"fleet: table of {name} differs", float(not same), 0))
    good = targets.report()
    out: Row = {
        "benchmark": "fleet", **provenance(), "flights": size, "repetitions": n, "cores": os.cpu_count(),
        "wall_s": {str(jobs): v for jobs, v in walls.items()}, "load_before": loads,
        "ratio": [ratios[0], middle, ratios[-1]], "targets": targets.as_rows(),
    }  # fmt: skip
    print(f"{time.perf_counter() - begin:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


if __name__ == "__main__":
    raise SystemExit(main())

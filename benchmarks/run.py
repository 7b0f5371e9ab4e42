"""All benchmarks, one after the other, each compared with its committed baseline.

    python benchmarks/run.py [--full] [--only NAME ...] [--json FOLDER] [--write-baselines] [--list]

In minutes, or with ``--full`` with all flights, frames and repetitions (hours). Each benchmark is a program of its own
(``python benchmarks/NAME.py --help``) and prints its table here; what it lacks (recordings, a package) it says in one
line. Its numbers are compared with ``baselines/NAME.json``, which the quick runs wrote: one that has become worse by
more than its spread is named (``targets.missed_baselines``). Baselines of speed hold on the machine that they name;
they are ratios within one run, so that another machine comes near them. At the end a line for each benchmark: targets
met, and numbers behind their baseline. Exit status 1 when one has failed, missed a target, or fallen behind.
``--write-baselines`` replaces the baselines by what is found: with a reason, in a commit of its own.
"""

from __future__ import annotations

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from targets import BASELINES, load_baseline, missed_baselines

HERE = Path(__file__).parent


@dataclass(frozen=True, slots=True)
class Benchmark:
    """A script, its arguments in minutes and in full, and which number of the design it gives."""

    name: str
    gives: str
    quick: tuple[str, ...] = ()
    full: tuple[str, ...] = ()


ALL = (
    Benchmark("flights", "errors over the autopilot's own; real recordings"),
    Benchmark("consistency", "NEES, NIS and the forecasts' coverage, part by part", (), ("--full",)),
    Benchmark("deck", "relative position, heave, forecast, latency; real autopilot"),
    Benchmark("engines", "compiled engine over filterpy's, and that they are equal"),
    Benchmark("realtime", "share of a core in flight", ("--seconds", "20")),
    Benchmark("smoother", "smoothed errors over filtered", ("--flights", "12", "--deck-flights", "2"), ("--full",)),
    Benchmark("tune", "noises found again; a flight held out", ("--only", "simulated", "--flights", "3"), ("--full",)),
    Benchmark("fleet", "two workers over one", ("--flights", "40", "--repetitions", "1"), ("--repetitions", "3")),
    Benchmark(
        "long_flight", "ten minutes of flight; images on two cores",
        ("--seconds", "120", "--pictures", "200", "--repetitions", "1"),
    ),
    Benchmark("heave", "forecast over the optimal predictor", ("--trials", "5")),
    Benchmark("clock", "clock layer", ("--trials", "40"), ("--trials", "400")),
    Benchmark("latency", "the camera's latency", ("--flights", "4", "--offline", "1")),
    Benchmark("ship_section", "real heave and a real camera's offset"),
    Benchmark("rings", "vision against ArUco and AprilTag", ("--frames", "10", "--baseline"), ("--full", "--baseline")),
    Benchmark("thesis", "the thesis's method", ("--quick",)),
    Benchmark("rendering", "frames a second of the renderer", ("--frames", "10")),
    Benchmark("read_columns", "reading columns over the mcap reader", ("--duration", "60")),
    Benchmark("import_speed", "decoding .BIN over pymavlink"),
    Benchmark("fix_model", "what a camera's fixes are, against rendered pictures", ("--moments", "20")),
    Benchmark("landings", "landings flown in a closed loop", ("--landings", "8"), ("--full",)),
    Benchmark("onboard", "latency from frame to LANDING_TARGET", ("--seconds", "60"), ("--full",)),
    Benchmark("aided", "horizontal error against smsfusion's AidedINS"),
)  # fmt: skip


def run(benchmark: Benchmark, full: bool, folder: Path, write: bool) -> tuple[str, bool]:
    """Run one benchmark; return the line that sums it up, and whether all is well."""
    result = folder / f"{benchmark.name}.json"
    result.unlink(missing_ok=True)
    arguments = benchmark.full if full else benchmark.quick
    print(f"\n== {benchmark.name}: {benchmark.gives} {' '.join(arguments)}", flush=True)
    begin = time.perf_counter()
    command = [sys.executable, str(HERE / f"{benchmark.name}.py"), *arguments, "--json", str(result)]
    code = subprocess.run(command, check=False).returncode
    told = f"{benchmark.name:14} {time.perf_counter() - begin:6.0f} s  "
    if not result.is_file():
        return told + f"wrote nothing (exit status {code})", code == 0
    found = json.loads(result.read_text(encoding="utf-8"))
    judged = found.get("targets", [])
    told += f"{sum(t['met'] for t in judged):3d} of {len(judged):3d} targets met"
    baseline = load_baseline(benchmark.name)
    if write and judged:
        (BASELINES / result.name).write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")
        return told + "; baseline written", code == 0
    if full or baseline is None:
        return told + "; no baseline", code == 0
    behind = missed_baselines(found, baseline)
    for line in behind:
        print(f"  BEHIND the baseline of {baseline.get('commit', 'unknown')}: {line}")
    return told + f"; {len(behind)} behind the baseline", code == 0 and not behind


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what is asked for; return 0 when all is well, else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    names = [b.name for b in ALL]
    parser.add_argument("--full", action="store_true")
    parser.add_argument("--only", nargs="+", choices=names, default=names, metavar="NAME")
    parser.add_argument("--json", type=Path, metavar="FOLDER", help="keep what the benchmarks write")
    parser.add_argument("--write-baselines", action="store_true")
    parser.add_argument("--list", action="store_true", help="say what there is")
    options = parser.parse_args(arguments)
    if options.list:
        print("\n".join(f"{b.name:14} {b.gives}" for b in ALL))
        return 0
    if options.write_baselines and options.full:
        parser.error("--write-baselines: baselines are of the quick runs; leave out --full")
    # The matrices are small: threads of the linear algebra library only wait for each other.
    os.environ.setdefault("PYTHONUNBUFFERED", "1")
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    lines, good = [], True
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.json or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        for benchmark in ALL:
            if benchmark.name in options.only:
                line, well = run(benchmark, options.full, folder, options.write_baselines)
                lines.append(line + ("" if well else "  <--"))
                good &= well
    print("\n== all\n" + "\n".join(lines))
    return 0 if good else 1


if __name__ == "__main__":
    raise SystemExit(main())

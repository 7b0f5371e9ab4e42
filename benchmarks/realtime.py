"""Does the estimator keep up in flight? One flight's events, one by one, as they would arrive.

A simulated flight over a heaving raft: IMU 200 Hz, vision fixes 30 Hz that arrive 100 ms after their content, GPS 5 Hz,
barometer 20 Hz, compass 25 Hz, exchanges of time 10 Hz, the platform's states on and its heave learned on the way.
Printed is the process time (CPU seconds of this process) of ``LandingEstimator.step`` from the first estimate on over
the flight's time: the share of one core, rewinding included; the time of a step by kind of event, and the longest.
Compilation is excluded by a run beforehand.

    python benchmarks/realtime.py [--seconds S] [--engine compiled filterpy] [--json FILE] [--no-gate]

Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from targets import Target, Targets, provenance

from estimation.estimator import EngineName, LandingEstimator
from estimation.events import Event, Kind, TimeSync
from simulation.flight import SimulatedFlight, parse_scenario, simulate

SHARE = {"compiled": 0.03, "filterpy": 0.25}
FLIGHT = """
description = "a hover over a raft in Beaufort 3, with late fixes"
[plan]
rest_s = 4.0
climb_s = 6.0
leg_s = 8.0
hover_s = 40.0
descent_s = 10.0
deck_s = 1.0
altitude_m = 6.0
start_m = [-12.0, -9.0, -1.0]
legs_m = []
yaw_rad = [0.6, 0.4]
[sea]
beaufort = 3
[streams]
timesync = { rate_hz = 10.0, delay_s = 0.001, delay_spread_s = 0.0005 }
vision = { rate_hz = 30.0, delay_s = 0.06 }
[clocks]
companion = { offset_s = 700.0, skew_ppm = 30.0 }
[filter.platform]
use = true
[filter.vision]
latency_s = 0.04
latency_sigma_s = 1e-4
"""
Row = dict[str, Any]


def stepped(flight: SimulatedFlight, events: list[Event], engine: EngineName) -> Row:
    """Step through the events; return the share of a core and the times of the steps."""
    estimator = LandingEstimator(flight.scenario.config, engine=engine, facts=flight.facts)
    first = 0
    while not estimator.ready:
        estimator.step(events[first])
        first += 1
    rest = events[first:]
    wall = np.empty(len(rest))
    begin = time.process_time()
    for i, event in enumerate(rest):
        before = time.perf_counter()
        estimator.step(event)
        wall[i] = time.perf_counter() - before
    used = time.process_time() - begin
    # Exchanges of stamps arrive on another clock.
    arrivals = [e.arrival_ns for e in rest if not isinstance(e, TimeSync)]
    seconds = (arrivals[-1] - arrivals[0]) * 1e-9
    kinds = np.array([type(e).__name__ for e in rest])
    return {
        "engine": engine,
        "events": len(rest),
        "flight_s": seconds,
        "cpu_s": used,
        "share": used / seconds,
        "step_us": {k: float(np.median(wall[kinds == k]) * 1e6) for k in sorted(set(kinds))},
        "longest_ms": float(wall.max() * 1e3),
        "above_5_ms": int(np.count_nonzero(wall > 5e-3)),
    }


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seconds", type=float, default=1e6, help="only so much of the flight")
    parser.add_argument("--engine", nargs="+", default=list(SHARE), choices=list(SHARE))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    flight = simulate(parse_scenario(FLIGHT), 1)
    rows = flight.batch.rows
    until = rows["arrival_ns"][rows["kind"] != Kind.TIMESYNC].min() + int(options.seconds * 1e9)
    kept = (rows["kind"] == Kind.TIMESYNC) | (rows["arrival_ns"] <= until)
    events = [e for e, keep in zip(flight.batch, kept, strict=True) if keep]
    targets = Targets()
    out: Row = {"benchmark": "realtime", **provenance(), "engines": []}
    for engine in options.engine:
        stepped(flight, events[: min(len(events), 4000)], engine)
        row = stepped(flight, events, engine)
        out["engines"].append(row)
        print(
            f"{engine}: {row['events']} events of {row['flight_s']:.1f} s in {row['cpu_s']:.2f} s of CPU: "
            f"{row['share'] * 100:.1f} % of a core; longest step {row['longest_ms']:.1f} ms, "
            f"{row['above_5_ms']} above 5 ms"
        )
        print(
            "  median step [us]: " + ", ".join(f"{k} {v:.0f}" for k, v in row["step_us"].items()), flush=True
        )
        targets.add(Target(f"{engine}: share of a core", row["share"], SHARE[engine]))
    good = targets.report()
    out["targets"] = targets.as_rows()
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


if __name__ == "__main__":
    raise SystemExit(main())

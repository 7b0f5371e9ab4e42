"""The two engines on real flights: same results, and how much faster the compiled one is.

Every flight of ``flights.py`` goes through both engines with the default configuration. Equality: the largest
absolute difference of states, sigmas and covariances (wanted <= 1e-9), and whether every measurement met
the same outcome. Speed: process time (CPU seconds of this process) of ``LandingEstimator.run`` in the steady
state, that is from the first estimate on (alignment is the same Python code for both), over the first part
of two flights, the engines in turn, several repetitions; the ratio is of each pair, given as median
(smallest..largest), wanted >= 15. Compilation is excluded by a run beforehand, whose wall time is printed
(it loads the cached machine code where there is some). The ratios in the table of equality are of single
whole runs, alignment included. Steps: one event at a time gives the bits of the whole batch. Memory: the peak
of what Python and NumPy hold while events are taken one at a time, over two lengths of a flight (wanted: the
same), and for whole batches the bytes for each event.

    python benchmarks/engines.py [--repetitions N] [--json FILE] [--no-gate]

Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import statistics
import tempfile
import time
import tracemalloc
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from realdata import RTK_FLIGHTS, SITL_FLIGHTS, data_folder, imported, read_px4_tables, read_rtk
from targets import Target, Targets, provenance

from deckfix.replaying import facts
from estimation.config import Config, parse_config
from estimation.estimator import EngineName, LandingEstimator
from estimation.events import EventBatch, Kind, unpack
from estimation.output import Facts, Run

EQUAL = 1e-9
FASTER = 15.0
SHORT_S = 10.0
"""Length [s] of the part of a flight that is taken event by event, and of half the part that memory is measured on."""
TIMED = {"calm.BIN": 20.0, "px4_real_flight": 40.0}
"""Flights whose first seconds are timed (the PX4 flight is aligned after 23 s)."""
Row = dict[str, Any]
Case = tuple[str, EventBatch, Facts, Config]


def cases(folder: Path) -> Iterator[Case]:
    """Yield the flights, one at a time: name, events, what the log itself states, configuration."""
    with tempfile.TemporaryDirectory() as scratch:
        files = [folder / "ardupilot_sitl" / f"{name}.BIN" for name in SITL_FLIGHTS]
        for file in (*files, folder / "ulog" / "sample_log_small.ulg"):
            flight = imported([file], Path(scratch))
            yield file.name, flight.events(), facts(flight), Config()
    no_barometer = parse_config("[barometer]\nuse = false\n")
    for name in RTK_FLIGHTS:
        yield name, read_rtk(folder / "quadrotor_rtk" / name).events(), Facts(), no_barometer
    yield "px4_real_flight", read_px4_tables(folder / "px4_real_flight"), Facts(), Config()


def beginning(batch: EventBatch, seconds: float) -> EventBatch:
    """Return the events of the first seconds of inertial samples, in their order."""
    imu = np.flatnonzero(batch.rows["kind"] == Kind.IMU)
    t = batch.rows["stamp_ns"][imu]
    last = int(np.searchsorted(t, t[0] + int(seconds * 1e9)))
    end = int(imu[last]) if last < len(imu) else len(batch)
    return EventBatch(batch.rows[:end], batch.sensors, batch.clocks, batch.timesync_reference)


def timed(case: Case, engine: EngineName) -> tuple[float, Run]:
    """Return the process time [s] of a run, and the run."""
    _, batch, stated, config = case
    estimator = LandingEstimator(config, engine, stated)
    begin = time.process_time()
    run = estimator.run(batch)
    return time.process_time() - begin, run


def steady(case: Case, engine: EngineName) -> float:
    """Return the process time [s] of a run from the first estimate on; the alignment before is not timed."""
    _, batch, stated, config = case
    estimator = LandingEstimator(config, engine, stated)
    first = 0
    while not estimator.ready:
        estimator.step(unpack(batch.rows[first], batch.sensors, batch.clocks, batch.timesync_reference))
        first += 1
    rest = EventBatch(batch.rows[first:], batch.sensors, batch.clocks, batch.timesync_reference)
    begin = time.process_time()
    estimator.run(rest)
    return time.process_time() - begin


def differences(a: Run, b: Run) -> Row:
    """Return the largest absolute differences of two runs, and whether their outcomes agree."""
    if not np.array_equal(a.t_ns, b.t_ns):
        return {"same_times": False, "state": None, "sigma": None, "covariance": None, "same_outcomes": False}

    def largest(name: str) -> float:
        x, y = getattr(a, name), getattr(b, name)
        return float(np.abs(x - y).max()) if x.size else 0.0

    same = len(a.records) == len(b.records) and all(
        np.array_equal(a.records[k], b.records[k]) for k in ("t_ns", "sensor", "outcome", "dof")
    )
    return {
        "same_times": True,
        "state": largest("nominal"),
        "sigma": largest("sigma"),
        "covariance": largest("covariance"),
        "same_outcomes": bool(same and a.imu_outcomes == b.imu_outcomes and a.notes == b.notes),
    }


def equality(case: Case) -> Row:
    """Return the comparison of both engines on a whole flight."""
    compiled_s, compiled = timed(case, "compiled")
    reference_s, reference = timed(case, "filterpy")
    return {
        "flight": case[0],
        "inertial_samples": int(np.count_nonzero(case[1].rows["kind"] == Kind.IMU)),
        "estimates": len(compiled.t_ns),
        "compiled_s": compiled_s,
        "filterpy_s": reference_s,
        "ratio": reference_s / compiled_s,
        **differences(compiled, reference),
    }


def speed(case: Case, repetitions: int) -> Row:
    """Return the ratio of process times in the steady state, over interleaved repetitions."""
    pairs = [(steady(case, "compiled"), steady(case, "filterpy")) for _ in range(repetitions)]
    ratios = sorted(reference / compiled for compiled, reference in pairs)
    return {
        "flight": case[0],
        "events": len(case[1]),
        "repetitions": repetitions,
        "compiled_s": statistics.median(c for c, _ in pairs),
        "filterpy_s": statistics.median(r for _, r in pairs),
        "ratio": [ratios[0], statistics.median(ratios), ratios[-1]],
    }


def same_bits(case: Case, engine: EngineName) -> bool:
    """Tell whether one event at a time gives the estimates and the records of the batch, to the last bit."""
    _, batch, stated, config = case
    run = LandingEstimator(config, engine, stated).run(batch)
    stepped = LandingEstimator(config, engine, stated)
    outputs = [stepped.step(event) for event in batch]
    estimates = [o.estimate for o in outputs if o.estimate is not None]
    if [e.t_ns for e in estimates] != run.t_ns.tolist():
        return False
    bits = (
        np.array([e.nominal for e in estimates]).tobytes() == run.nominal.tobytes()
        and np.array([e.covariance for e in estimates]).tobytes() == run.covariance.tobytes()
        and np.array([e.sigma for e in estimates]).tobytes() == run.sigma.tobytes()
    )
    # What is still in the window at the end becomes final only when the batch is finished.
    records = np.concatenate([o.records for o in outputs])
    order = list(dict.fromkeys(event.sensor for event in batch))
    records["sensor"] = np.array([run.sensors.index(name) for name in order])[records["sensor"]]
    records = records[np.lexsort((records["sensor"], records["t_ns"]))]
    settled = run.records[np.isin(_key(run.records), _key(records))]
    return bool(bits and len(records) and settled.tobytes() == records.tobytes())


def _key(records: NDArray[np.void]) -> NDArray[np.int64]:
    key: NDArray[np.int64] = records["t_ns"] * 64 + records["sensor"]
    return key


def memory(case: Case) -> Row:
    """Return peaks of memory [bytes] beyond what is there before: stepping a half and a whole, and a batch."""
    name, batch, stated, config = case
    half = EventBatch(batch.rows[: len(batch) // 2], batch.sensors, batch.clocks, batch.timesync_reference)
    row: Row = {"flight": name, "events": len(batch)}
    for key, part in (("step_half", half), ("step_whole", batch)):
        estimator = LandingEstimator(config, "compiled", stated)
        tracemalloc.start()
        for event in part:
            estimator.step(event)
        row[key] = tracemalloc.get_traced_memory()[1]
        tracemalloc.stop()
    tracemalloc.start()
    run = LandingEstimator(config, "compiled", stated).run(batch)
    row["batch"] = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    arrays = (run.t_ns, run.nominal, run.sigma, run.covariance, run.records)
    row["batch_result"] = sum(a.nbytes for a in arrays)
    return row


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--repetitions", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    folder = data_folder()
    if folder is None:
        parser.error("real data not found: set DECKFIX_DATA")
    began = time.perf_counter()
    targets = Targets()
    out: Row = {"benchmark": "engines", **provenance(), "equality": [], "speed": []}
    print(
        f"{'flight':24}{'samples':>9}{'estimates':>10}  {'state':>8} {'sigma':>8} {'covar.':>8}  outcomes {'ratio':>7}"
    )
    for case in cases(folder):
        name = case[0]
        short = (name, beginning(case[1], SHORT_S), *case[2:])
        if not out["equality"]:
            begin = time.perf_counter()
            timed(short, "compiled")
            timed(short, "filterpy")
            out["first_run_s"] = time.perf_counter() - begin
        row = equality(case)
        out["equality"].append(row)
        largest = [row[k] for k in ("state", "sigma", "covariance")]
        cells = " ".join("       -" if v is None else f"{v:8.1e}" for v in largest)
        print(
            f"{name:24}{row['inertial_samples']:9d}{row['estimates']:10d}  {cells}  "
            f"{'same' if row['same_outcomes'] else 'DIFFER':8} {row['ratio']:7.1f}",
            flush=True,
        )
        for k, v in zip(("states", "sigmas", "covariances"), largest, strict=True):
            targets.add(Target(f"{name}: {k}, largest difference", v, EQUAL))
        targets.add(Target(f"{name}: outcomes differ", float(not row["same_outcomes"]), 0))
        if name in TIMED:
            timed_part = (name, beginning(case[1], TIMED[name]), *case[2:])
            out["speed"].append(speed(timed_part, options.repetitions))
        if name == "calm.BIN":
            out["step_equals_run"] = {e: same_bits(short, e) for e in ("compiled", "filterpy")}
            out["memory"] = memory((name, beginning(case[1], 2.0 * SHORT_S), *case[2:]))
    print(
        f"first run of both engines (compiles or loads from the cache): {out['first_run_s']:.1f} s wall, excluded"
    )
    for row in out["speed"]:
        low, middle, high = row["ratio"]
        print(
            f"{row['flight']:24} filterpy {row['filterpy_s']:.3f} s, compiled {row['compiled_s']:.4f} s of CPU for "
            f"{row['events']} events: {middle:.1f}x ({low:.1f}..{high:.1f}, n {row['repetitions']})"
        )
        name = f"{row['flight']}: filterpy over compiled"
        targets.add(Target(name, middle, FASTER, at_least=True, spread=high - low))
    for engine, same in out["step_equals_run"].items():
        print(f"one event at a time, {engine}: {'the same bits' if same else 'DIFFERS'}")
        targets.add(Target(f"one event at a time, {engine}: differs from the batch", float(not same), 0))
    m = out["memory"]
    print(
        f"memory, one event at a time: peak {m['step_half'] / 1e6:.2f} MB over {m['events'] // 2} events, "
        f"{m['step_whole'] / 1e6:.2f} MB over {m['events']}; "
        f"batch {m['batch'] / m['events']:.0f} bytes/event, its result {m['batch_result'] / m['events']:.0f}"
    )
    targets.add(Target("memory of stepping, whole over half", m["step_whole"] / m["step_half"], 1.1))
    good = targets.report()
    out["targets"] = targets.as_rows()
    print(f"{time.perf_counter() - began:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


if __name__ == "__main__":
    raise SystemExit(main())

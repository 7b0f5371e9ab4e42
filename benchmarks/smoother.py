"""Is the smoothed trajectory nearer to the truth than the filter's, and does it know how near?

Simulated flights: two scenarios whose sensors are as the filter is told (errors, and NEES phase by phase against its
95 % band over the flights, as in ``consistency.py``), one with vibration that it is not told of (errors), and hovers
over a swaying, heaving raft (errors of the vehicle relative to the deck). Errors are over the time that both estimates
have, position less its constant datum (the mean), which no smoother can know: it is the GPS's. Then, where they are,
the flights of ArduPilot's simulator, judged as by ``replay`` (from 10 s after the start to 0.5 s before contact), with
the default configuration and, with ``--tuned``, with one that was tuned on the other two of them (``deckfix tune``):
this simulator's GPS does not wander, and a smoother believes what it is told of the wander over the whole flight. What
that does is seen first on a linear model of one axis with the default's rates, an exact filter and an exact smoother,
once with a wander as they are told and once without any. It also says on how many single flights an exact smoother is
above its filter: it is the best on the average, and of a slow error, such as the wander or the heading's, a flight is
one draw, to which the filter can be nearer by luck.

    python benchmarks/smoother.py [--flights 50] [--deck-flights 6] [--jobs N] [--tuned] [--full] [--json FILE]
                                  [--no-gate]

Printed are pooled RMSE, filtered and smoothed, their ratio with its range over the flights, and on how many flights it
is above 1. Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from joblib import Parallel, delayed
from numpy.typing import NDArray
from realdata import SITL_FLIGHTS, data_folder, imported
from targets import Target, Targets, provenance

import deckfix
from deckfix.deck_reference import compare_deck
from deckfix.reference import Errors, Trajectory, Window, column, quaternion_column, window
from deckfix.tune import TuneOptions, run_tune
from estimation.config import Config
from estimation.estimator import LandingEstimator
from estimation.output import Run
from simulation.flight import Scenario, SimulatedFlight, load_scenario, simulate
from simulation.known import known_of_flight
from simulation.montecarlo import FlightErrors, errors, kinematic_errors, nees_by_phase
from simulation.trajectory import PHASES

Array = NDArray[np.float64]
Row = dict[str, Any]

HONEST = ("consistency_default_2026_06", "consistency_survey_2026_06")
SHAKEN = "landing_2026_06"
DECK = "latency_windy_2026_11"
FIRST_SEED = 5000
QUANTITIES: dict[str, slice] = {
    "position [m]": slice(0, 3),
    "velocity [m/s]": slice(3, 6),
    "attitude [rad]": slice(6, 9),
    "roll and pitch [rad]": slice(6, 8),
}
MOVING = ("position", "velocity", "attitude", "kinematics")
TUNED = (
    "gps.bias_sigma_m",
    "gps.position_sigma_m",
    "gps.velocity_sigma_mps",
    "gps.climb_sigma_mps",
    "barometer.*",
)
"""What is tuned of the simulator's flights: its receiver and its barometer are what differs from real ones."""
RELATIVE = {"relative position [m]": "position_m", "relative velocity [m/s]": "velocity_mps"}
PARTS: dict[str, tuple[str, tuple[int, ...]]] = {
    "horizontal position [m]": ("position_m", (0, 1)),
    "height [m]": ("position_m", (2,)),
    "horizontal velocity [m/s]": ("velocity_mps", (0, 1)),
    "vertical velocity [m/s]": ("velocity_mps", (2,)),
    "roll and pitch [rad]": ("attitude_rad", (0, 1)),
    "yaw [rad]": ("attitude_rad", (2,)),
}


@dataclass(frozen=True, slots=True)
class Smoothed:
    """One flight: squared errors, filtered and smoothed, by quantity, and the smoothed estimates' NEES."""

    squares: dict[str, tuple[float, float]]
    nees: FlightErrors | None


def one(name: str, seed: int, deck: bool) -> Smoothed:
    """Simulate, filter and smooth one flight."""
    scenario: Scenario = load_scenario(name)
    flight = simulate(scenario, seed)
    estimator = LandingEstimator(scenario.config, facts=flight.facts, smooth=True)
    run = estimator.run(flight.batch)
    if not len(run.t_ns):
        raise SystemExit(f"{name}, seed {seed}: the filter did not start; it waited for {run.missing}")
    smoothed = estimator.smoothed(run)
    squares = dict[str, tuple[float, float]]()
    if deck:
        pair = [_relative(flight, r) for r in (run, smoothed)]
        for label, attribute in RELATIVE.items():
            squares[label] = _pair([getattr(e, attribute)[w.inside(e.t_ns)] for e, w in pair])
        return Smoothed(squares, None)
    first = run.t_ns[0]
    known = known_of_flight(flight, smoothed)
    kept = [
        kinematic_errors(r, k)[0][r.t_ns >= first]
        for r, k in ((run, known_of_flight(flight, run)), (smoothed, known))
    ]
    for label, part in QUANTITIES.items():
        squares[label] = _pair(
            [e[:, part] - (e[:, part].mean(axis=0) if part.start == 0 else 0.0) for e in kept]
        )
    return Smoothed(squares, errors(smoothed, known))


def _pair(both: Sequence[Array]) -> tuple[float, float]:
    filtered, smoothed = (float(np.mean(np.sum(e[np.isfinite(e).all(axis=1)] ** 2, axis=1))) for e in both)
    return filtered, smoothed


def _relative(flight: SimulatedFlight, run: Run) -> tuple[Errors, Window]:
    t = np.arange(0.0, flight.trajectory.plan.duration_s, 0.02)
    stamp, m, raft = (
        flight.clock.stamp_ns(t),
        flight.trajectory.motion(t),
        flight.trajectory.platform.motion(t),
    )
    vehicle = Trajectory(
        column(stamp, m.position_m), column(stamp, m.velocity_mps), quaternion_column(stamp, m.quaternion)
    )
    place = Trajectory(column(stamp, raft.position[0]), column(stamp, raft.position[1]), None)
    found = compare_deck(run, vehicle, place, window(int(stamp[0]), int(stamp[-1]), None))
    if found is None:
        raise SystemExit(f"seed {flight.seed}: no deck was estimated")
    return found.relative, found.judged


def compared(name: str, flights: list[Smoothed], targets: Targets) -> Row:
    """Print and return filtered against smoothed of one scenario."""
    out: Row = {"flights": len(flights)}
    for label in flights[0].squares:
        filtered, smoothed = np.sqrt(np.array([f.squares[label] for f in flights])).T
        ratios = smoothed / filtered
        pooled = [float(np.sqrt(np.mean(v**2))) for v in (filtered, smoothed)]
        worse = int(np.count_nonzero(ratios >= 1.0))
        out[label] = {
            "filtered": pooled[0],
            "smoothed": pooled[1],
            "ratio": pooled[1] / pooled[0],
            "ratios": [float(ratios.min()), float(np.median(ratios)), float(ratios.max())],
            "above_1": worse,
        }
        print(
            f"  {label:26} {pooled[0]:8.4f} -> {pooled[1]:8.4f}  {pooled[1] / pooled[0]:5.2f} "
            f"({ratios.min():.2f}..{ratios.max():.2f}, n {len(flights)}); above 1 on {worse}"
        )
        targets.add(Target(f"{name}: {label}: flights with smoothed above filtered", worse, 0))
    return out


def honest(name: str, flights: list[Smoothed], targets: Targets) -> Row:
    """Print and return the smoothed NEES of one scenario, phase by phase."""
    judged = [f.nees for f in flights if f.nees is not None]
    usual, wide = nees_by_phase(judged), nees_by_phase(judged, 0.999)
    rows: Row = {}
    band = next(iter(usual.values())).band
    print(f"  smoothed NEES / dof; band for {len(judged)} flights of 3 dof {band.low:.2f} to {band.high:.2f}")
    print(f"  {'':14}" + "".join(f"{p:>9}" for p in PHASES))
    for quantity in dict.fromkeys(q for q, _ in usual):
        cells = {p: usual[quantity, p] for p in PHASES if (quantity, p) in usual}
        rows[quantity] = {p: round(c.mean_over_dof, 4) for p, c in cells.items()}
        marks = [f"{c.mean_over_dof:8.2f}{' ' if c.consistent else '*'}" for c in cells.values()]
        print(f"  {quantity:14}" + "".join(marks))
    # Phases of one flight are no independent draws of an error that a smoother takes as one: the kinematics, which
    # change, are asked for in every phase; what is nearly constant is judged by the wider band.
    moving = {k: c for k, c in usual.items() if k[0] in MOVING}
    inside = sum(c.consistent for c in moving.values())
    print(f"  {inside} of {len(moving)} means of {', '.join(MOVING)} inside their 95 % band")
    targets.add(Target(f"{name}: smoothed NEES of what moves outside 95 %", len(moving) - inside, 0))
    outside = sum(not c.consistent for c in wide.values())
    targets.add(Target(f"{name}: smoothed NEES outside 99.9 %", outside, 0))
    return {"nees": rows, "inside": inside, "judged": len(moving)}


def wander(trials: int, wanders: bool, seed: int = 1) -> tuple[Array, Array]:
    """Return RMSE (trials,) [m] of position less its median, filtered and smoothed, of a linear model of one axis.

    States are position, velocity, tilt and the GPS's wander, over 95 s at 5 Hz, with the default's rates. Filter and
    smoother are exact; ``wanders`` says whether the truth does what they are told of the wander, or stands still.
    """
    c, rng = Config(), np.random.default_rng(seed)
    dt, g, steps = 0.2, 9.8, 475
    kept = float(np.exp(-dt / c.gps.bias_time_s))
    F = np.eye(4)
    F[0, 1], F[1, 2], F[0, 2], F[3, 3] = dt, g * dt, 0.5 * g * dt**2, kept
    accel = c.imu.accel_noise**2
    Q = np.diag([0.0, accel * dt, c.imu.gyro_noise**2 * dt, c.gps.bias_sigma_m**2 * (1.0 - kept**2)])
    H = np.array([[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0]])
    sigma = np.array([c.gps.position_sigma_m, c.gps.velocity_sigma_mps])
    # Where it starts is the first fix: position and wander are known in sum.
    P0 = np.diag([c.gps.bias_sigma_m**2 + sigma[0] ** 2, 0.01, 1e-4, c.gps.bias_sigma_m**2])
    P0[0, 3] = P0[3, 0] = -(c.gps.bias_sigma_m**2)
    squares = np.zeros((2, trials))
    for trial in range(trials):
        x = np.array([0.0, 0.0, 0.0, c.gps.bias_sigma_m * rng.standard_normal()])
        true, z = np.empty((steps, 4)), np.empty((steps, 2))
        for k in range(steps):
            standing = x[3]
            x = F @ x + np.sqrt(np.diag(Q)) * rng.standard_normal(4)
            x[3] = x[3] if wanders else standing
            true[k], z[k] = x, H @ x + sigma * rng.standard_normal(2)
        m, P = np.zeros(4), P0
        after, before = [], []
        for reading in z:
            m, P = F @ m, F @ P @ F.T + Q
            before.append((m, P))
            K = P @ H.T @ np.linalg.inv(H @ P @ H.T + np.diag(sigma**2))
            m, P = m + K @ (reading - H @ m), P - K @ H @ P
            after.append((m, P))
        smooth = [after[-1][0]]
        for (m, P), (predicted, P_predicted) in zip(after[-2::-1], before[:0:-1], strict=True):
            smooth.append(m + P @ F.T @ np.linalg.inv(P_predicted) @ (smooth[-1] - predicted))
        for i, estimate in enumerate((np.array([a[0] for a in after]), np.array(smooth[::-1]))):
            error = (estimate - true)[50:, 0]
            squares[i, trial] = np.mean((error - np.median(error)) ** 2)
    filtered, smoothed = np.sqrt(squares)
    return filtered, smoothed


def linear(trials: int) -> Row:
    """Print and return what an exact smoother does where the wander is as it is told, and where there is none."""
    out: Row = {"trials": trials}
    print("exact linear model of one axis, horizontal position [m]:")
    for label, wanders in (("wander as told", True), ("no wander", False)):
        single = wander(trials, wanders)
        a, b = (float(np.sqrt(np.mean(v**2))) for v in single)
        worse = int(np.count_nonzero(single[1] >= single[0]))
        out[label] = {"filtered": a, "smoothed": b, "ratio": b / a, "above_1": worse}
        print(f"  {label:26} {a:8.4f} -> {b:8.4f}  {b / a:5.2f} (n {trials}); above 1 on {worse}")
    return out


def sitl(folder: Path, with_tuned: bool, jobs: int, targets: Targets) -> list[Row]:
    """Print and return the flights of ArduPilot's simulator."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        logs = {}
        for name in SITL_FLIGHTS:
            files = [folder / "ardupilot_sitl" / f"{name}{s}" for s in (".BIN", ".tlog")]
            logs[name] = str(imported(files, Path(scratch)).path)
        for name in SITL_FLIGHTS:
            rows.append(of_simulator(name, "default", logs[name], None, targets))
            if not with_tuned:
                continue
            tuned = Path(scratch) / f"{name}.toml"
            others = [logs[n] for n in SITL_FLIGHTS if n != name]
            options = TuneOptions(parameters=TUNED, starts=1, jobs=jobs)
            text, written = run_tune(others, [logs[name]], tuned, options)
            print(text)
            if written:
                rows.append(of_simulator(name, "tuned on the others", logs[name], tuned, targets))
    return rows


def of_simulator(name: str, config_name: str, log: str, config: Path | None, targets: Targets) -> Row:
    """Print and return filtered against smoothed of one flight and configuration."""
    result = deckfix.replay(log, config, smooth=True, images=False)
    assert result.truth_errors is not None
    assert result.smoothed_errors is not None
    row: Row = {"flight": name, "configuration": config_name}
    print(f"{name}, {config_name}:")
    for label, (attribute, axes) in PARTS.items():
        pair = [
            getattr(e, attribute)[result.judged.inside(e.t_ns)][:, axes]
            for e in (result.truth_errors, result.smoothed_errors)
        ]
        a, b = np.sqrt(_pair(pair))
        row[label] = {"filtered": float(a), "smoothed": float(b), "ratio": float(b / a)}
        print(f"  {label:26} {a:8.4f} -> {b:8.4f}  {b / a:5.2f}")
        targets.add(Target(f"{name}, {config_name}: {label}: smoothed over filtered", float(b / a), 1.0))
    return row


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=50)
    parser.add_argument("--deck-flights", type=int, default=6)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--tuned", action="store_true", help="tune on the simulator's other flights as well")
    parser.add_argument(
        "--full", action="store_true", help="100 flights of each scenario, 50 over the deck; --tuned"
    )
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    flights, deck_flights = (100, 50) if options.full else (options.flights, options.deck_flights)
    begin = time.perf_counter()
    targets = Targets()
    out: Row = {"benchmark": "smoother", **provenance(), "scenarios": {}, "sitl": []}
    out["linear"] = linear(60)
    with Parallel(n_jobs=options.jobs) as pool:
        for name in (*HONEST, SHAKEN, DECK):
            count = deck_flights if name == DECK else flights if name in HONEST else max(2, flights // 5)
            done = pool(delayed(one)(name, FIRST_SEED + k, name == DECK) for k in range(count))
            print(f"{name}: RMSE, filtered -> smoothed", flush=True)
            out["scenarios"][name] = compared(name, done, targets)
            if name in HONEST:
                out["scenarios"][name] |= honest(name, done, targets)
    folder = data_folder()
    if folder is None:
        print("the flights of ArduPilot's simulator are left out: not found, set DECKFIX_DATA")
    else:
        out["sitl"] = sitl(folder, options.tuned or options.full, options.jobs, targets)
    good = targets.report()
    out["targets"] = targets.as_rows()
    print(f"{time.perf_counter() - begin:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


if __name__ == "__main__":
    raise SystemExit(main())

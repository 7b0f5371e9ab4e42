"""Real flights, end to end: how good and how honest the estimates are.

Four tables, each against what its recording offers:

* ``sitl``: three flights of a real autopilot in its simulator, .BIN alone and merged with .tlog, imported to MCAP
  and replayed with the default configuration from IMU, GPS, barometer and magnetometer; errors against the
  simulator's truth, over those of the autopilot's own EKF3 in the same log and window (from 10 s after the log's
  start to 0.5 s before contact, position less its constant datum, both at the times of EKF3).
* ``rtk``: three real quadrotor flights with RTK. One fix in ten is given, as position only; the predicted position
  is compared with the nine that are withheld, by the time since the last fix, beside (a) holding the last fix and
  (b) the straight line through the last two.
* ``px4``: a real flight with heavy vibration and without magnetometer: start, gaps, NIS, position against GPS.
* ``ulog``: two short real PX4 logs: what starts, and what does not and why.

    python benchmarks/flights.py [--only sitl rtk px4 ulog] [--json FILE] [--no-gate]

Exit status 1 when a target is missed, unless --no-gate is given.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from realdata import (
    RTK_FLIGHTS,
    RTK_ORIGIN,
    SITL_FLIGHTS,
    RtkFlight,
    data_folder,
    fit_mounting,
    imported,
    read_px4_tables,
    read_rtk,
)
from targets import Target, Targets, nis_row, nis_rows, provenance

import deckfix
from deckfix.reference import RATIOS, rms
from estimation.config import Config, parse_config
from estimation.estimator import LandingEstimator
from estimation.events import EventBatch, Kind
from estimation.frames import geodetic_to_ned, quat_to_euler_columns
from estimation.output import Run

Array = NDArray[np.float64]
Row = dict[str, Any]

RATIO_TARGETS = {
    "horizontal_position": 1.05,
    "height": 0.4,
    "horizontal_velocity": 0.95,
    "vertical_velocity": 0.5,
    "roll_pitch": 0.7,
    "yaw": 0.4,
}
KINDER = """SITL is kinder than a flight: its magnetometer is calibrated to the last digit, its horizontal GPS
position is right to 1 cm (a filter that only repeated it would beat most), its barometer knows no
propeller wash and no delay, the propellers shake nothing and the inertial sensor has no misalignment.
EKF3 flies parameters for real sensors and learns a field that is not there; the ratios flatter us by that.
NIS far below 1 is the other side of it: the default noises are for real receivers."""

WITHOUT_VISION = "[platform]\nuse = false\n"
"""The merged logs hold vision fixes, of which EKF3 makes no use."""
RTK_CONFIG = """\
[gps]               # RTK: centimetres, no slow error to carry, stamped at its own time
bias = false
position_sigma_m = 0.05
height_sigma_m = 0.1
latency_s = 0.0
[barometer]
use = false         # the recording has none
"""
RTK_EVERY = 10
RTK_PHASES = (0, 2, 4, 6, 8)


def sitl(folder: Path, targets: Targets) -> list[Row]:
    """Print and return the table of the simulated flights of a real autopilot."""
    print(f"\n== ardupilot_sitl: RMSE (ours/EKF3) = ratio, default configuration ==\n{'':15}", end="")
    print("".join(f"{name.replace('_', ' '):>27}" for name in RATIO_TARGETS))
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        for name in SITL_FLIGHTS:
            alone: Run | None = None
            for suffixes in ((".BIN",), (".BIN", ".tlog")):
                files = [folder / "ardupilot_sitl" / (name + s) for s in suffixes]
                flight = imported(files, Path(scratch))
                result = deckfix.replay(flight, parse_config(WITHOUT_VISION))
                row = sitl_row(name, "+".join(s[1:] for s in suffixes), result)
                if alone is not None:
                    row["position_alone_less_merged_m"] = largest_difference(alone, result.run)
                alone = result.run
                rows.append(row)
                print_sitl(row)
                label = f"{name} {row['files']}"
                for key, bound in RATIO_TARGETS.items():
                    targets.add(Target(f"{label}: {key} over EKF3", row["ratio"].get(key), bound))
                targets.add(Target(f"{label}: NEES/dof (not over-confident)", row["nees_over_dof"], 1.3))
                lost = sum(n for outcome, n in row["imu"].items() if outcome != "FUSED")
                targets.add(Target(f"{label}: inertial samples not used", lost, 0))
    print(KINDER)
    return rows


def sitl_row(name: str, files: str, result: deckfix.Result) -> Row:
    """Return the numbers of one replay."""
    pair, judged = result.at_autopilot, result.judged
    assert pair is not None
    inside = judged.inside(pair.ours.t_ns)
    absolute: Row = {}
    for key, attribute, axes in RATIOS:
        scale = 180.0 / np.pi if attribute == "attitude_rad" else 1.0
        both = [
            getattr(e, attribute)[:, axes][inside] * scale * len(axes) ** 0.5
            for e in (pair.ours, pair.autopilot)
        ]
        finite = np.isfinite(both[0]).all(axis=1) & np.isfinite(both[1]).all(axis=1)
        absolute[key] = [rms(b[finite]) for b in both]
    summary = result.summary()
    return {
        "flight": name,
        "files": files,
        "window_s": summary["ratio"].pop("window_s"),
        "contact_s": summary["ratio"].pop("contact_s", None),
        "ratio": summary["ratio"],
        "rmse_ours_and_ekf3": absolute,
        "nees_over_dof": summary["truth"]["odometry"]["nees_over_dof"],
        "nis": nis_rows(result.run),
        "imu": {outcome.name: n for outcome, n in result.run.imu_outcomes.items()},
        "notes": [text for _, text in result.run.notes],
    }


def print_sitl(row: Row) -> None:
    """Print one replay."""
    cells = []
    for key in RATIO_TARGETS:
        ours, theirs = row["rmse_ours_and_ekf3"][key]
        cells.append(f"{ours:.3f}/{theirs:.3f} = {row['ratio'][key]:.2f}".rjust(27))
    print(f"{row['flight'] + ' ' + row['files']:15}" + "".join(cells))
    nis = ", ".join(
        f"{s} {v['mean_over_dof']:.3f} ({v['above_95']:.1%} above)" for s, v in row["nis"].items()
    )
    print(f"{'':15} NEES/dof {row['nees_over_dof']:.2f}; NIS/dof {nis}")
    if "position_alone_less_merged_m" in row:
        print(f"{'':15} alone less merged: {row['position_alone_less_merged_m'] * 1e3:.3f} mm at most")


def largest_difference(a: Run, b: Run) -> float:
    """Return the largest difference [m] of two runs' positions, the second at the times of the first."""
    at = np.column_stack([np.interp(a.t_ns, b.t_ns, b.position_m[:, i]) for i in range(3)])
    return float(np.abs(a.position_m - at).max())


def rtk(folder: Path, targets: Targets) -> list[Row]:
    """Print and return the table of the RTK flights."""
    print(
        "\n== quadrotor_rtk: predicted position against withheld RTK fixes, 1 fix in 10 given, as position only =="
    )
    rows: list[Row] = []
    for name in RTK_FLIGHTS:
        flight = read_rtk(folder / "quadrotor_rtk" / name)
        mounting = fit_mounting(flight)
        print(
            f"{name}: sensor forward-left-up within {mounting.angle_deg:.1f} deg of the body, its clock within "
            f"{abs(mounting.offset_s) * 1e3:.0f} ms; {mounting.unexplained:.1%} of the angular velocity unexplained"
        )
        row: Row = {
            "flight": name,
            "mounting_deg": mounting.angle_deg,
            "clock_offset_s": mounting.offset_s,
            "unexplained": mounting.unexplained,
        }
        for label, text in (
            ("rtk settings", RTK_CONFIG),
            ("default, no barometer", "[barometer]\nuse = false\n"),
        ):
            row[label] = rtk_errors(flight, parse_config(text))
            print_rtk(label, row[label])
        rows.append(row)
        tuned = row["rtk settings"]
        late = [k for k in tuned["horizontal_m"]["ours"] if float(k) >= 0.5]
        for axis, bound in (("horizontal_m", 0.75), ("height_m", 0.5)):
            ours, line = (np.sqrt(np.mean([tuned[axis][m][k] ** 2 for k in late])) for m in ("ours", "line"))
            targets.add(
                Target(
                    f"{name}: {axis[:-2]} 0.5-0.9 s after a fix over the straight line", ours / line, bound
                )
            )
        targets.add(Target(f"{name}: NEES/dof horizontal (not over-confident)", tuned["nees_over_dof"], 1.3))
    print("RTK settings: " + "; ".join(line.split("#")[0].strip() for line in RTK_CONFIG.splitlines()))
    print(
        "The start takes its attitude from the quadrotor's own estimator, its velocity from the first two fixes. "
        "Height is recorded in steps of 0.1 m."
    )
    return rows


def rtk_errors(flight: RtkFlight, config: Config, phases: Sequence[int] = RTK_PHASES) -> Row:
    """Return RMSE by the time since the last fix, over several choices (phases) of which fixes are given.

    ``ours``, ``held`` and ``line`` are 2-D for ``horizontal_m`` and 1-D for ``height_m``; errors begin 2 s after the
    first estimate. Predicted positions are those that came out at the time, before the next fix was known.
    """
    errors: dict[str, dict[int, list[Array]]] = {
        m: {k: [] for k in range(1, RTK_EVERY)} for m in ("ours", "held", "line")
    }
    normalised: list[float] = []
    nis: list[NDArray[np.void]] = []
    for first in phases:
        run = LandingEstimator(config).run(flight.events(RTK_EVERY, first))
        if not len(run.t_ns) or run.origin is None:
            raise SystemExit(f"{flight.name}: did not start; waits for {run.missing}")
        latitude, longitude, altitude = run.origin
        shift = geodetic_to_ned(latitude, longitude, altitude, RTK_ORIGIN)
        nis.append(run.records)
        for i in range(first + 2 * RTK_EVERY, len(flight.fix_ns)):
            k = (i - first) % RTK_EVERY
            t = int(flight.fix_ns[i]) - round(config.gps.latency_s * 1e9)
            if k == 0 or t < run.t_ns[0] + 2_000_000_000 or t > run.t_ns[-1]:
                continue
            truth, last, before = (flight.position_m[j] for j in (i, i - k, i - k - RTK_EVERY))
            ours = np.array([np.interp(t, run.t_ns, run.position_m[:, j]) for j in range(3)]) + shift
            errors["ours"][k].append(ours - truth)
            errors["held"][k].append(last - truth)
            errors["line"][k].append(last + (last - before) * (k / RTK_EVERY) - truth)
            P = run.covariance[int(np.searchsorted(run.t_ns, t)) - 1, :2, :2]
            normalised.append(float((ours - truth)[:2] @ np.linalg.solve(P, (ours - truth)[:2])) / 2.0)

    def by_time(axes: list[int]) -> Row:
        return {
            method: {
                f"{k / 10:.1f}": float(np.sqrt(np.mean(np.sum(np.array(e)[:, axes] ** 2, axis=1))))
                for k, e in of.items()
            }
            for method, of in errors.items()
        }

    gps = np.concatenate(nis)
    return {
        "horizontal_m": by_time([0, 1]),
        "height_m": by_time([2]),
        "withheld": len(normalised),
        "nees_over_dof": float(np.mean(normalised)),
        "nis": nis_row(gps[gps["dof"] > 0]),
    }


def print_rtk(label: str, row: Row) -> None:
    """Print one flight and configuration."""
    times = ("0.1", "0.3", "0.5", "0.7", "0.9")
    print(f"  {label:28}" + "".join(f"{t + ' s':>8}" for t in times))
    for axis in ("horizontal_m", "height_m"):
        for method in ("ours", "line", "held"):
            cells = "".join(f"{row[axis][method][t]:8.3f}" for t in times)
            print(f"  {'':13}{axis[:-2]:11}{method:>4}{cells}")
    honest = f"NEES/dof horizontal {row['nees_over_dof']:.2f}, NIS/dof {row['nis']['mean_over_dof']:.2f}"
    print(f"  {'':13}n {row['withheld']}, {honest}")


def px4(folder: Path, targets: Targets) -> Row:
    """Print and return the numbers of the flight with heavy vibration."""
    print(
        "\n== px4_real_flight: no magnetometer, heavy vibration, two gaps in the log; default configuration =="
    )
    batch = read_px4_tables(folder / "px4_real_flight")
    run = LandingEstimator(Config()).run(batch)
    if run.origin is None:
        raise SystemExit(f"px4_real_flight: did not start; waits for {run.missing}")
    begin = int(batch.rows["stamp_ns"].min())
    imu = batch.rows[batch.rows["kind"] == Kind.IMU]
    steps = np.diff(imu["stamp_ns"]) * 1e-9
    gaps = [
        [float((imu["stamp_ns"][i] - begin) * 1e-9), float(steps[i])] for i in np.flatnonzero(steps > 0.1)
    ]
    horizontal, vertical = against_gps(run, batch)
    euler = np.degrees(quat_to_euler_columns(run.quaternion))
    row: Row = {
        "notes": [[(t - begin) * 1e-9, text] for t, text in run.notes],
        "start_s": float((run.t_ns[0] - begin) * 1e-9),
        "duration_s": float((imu["stamp_ns"][-1] - begin) * 1e-9),
        "force_scatter_mps2": np.std(np.diff(imu["value"][:, 3:6], axis=0), axis=0).tolist(),
        "gaps_s": gaps,
        "nis": nis_rows(run),
        "horizontal_less_gps_m": {"rms": rms(horizontal), "largest": float(horizontal.max())},
        "height_less_gps_m": {"rms": rms(vertical), "largest": float(np.abs(vertical).max())},
        "largest_tilt_deg": float(np.abs(euler[:, :2]).max()),
        "imu": {outcome.name: n for outcome, n in run.imu_outcomes.items()},
    }
    for at, text in row["notes"]:
        print(f"{at:7.1f} s: {text}")
    print("gaps of the inertial sensor: " + ", ".join(f"{length:.2f} s at {at:.1f} s" for at, length in gaps))
    for sensor, v in row["nis"].items():
        inside, above = v["inside_95"], v["above_95"]
        print(f"{sensor:13} NIS/dof {v['mean_over_dof']:6.3f}  inside 95 % {inside:6.1%}", end="")
        print(f"  above {above:5.1%}  n {v['count']}")
        targets.add(Target(f"px4_real_flight: {sensor} innovations above their 95 % band", above, 0.05))
    for key in ("horizontal_less_gps_m", "height_less_gps_m"):
        print(f"{key[:-2].replace('_', ' ')}: rms {row[key]['rms']:.2f} m, ", end="")
        print(f"largest {row[key]['largest']:.2f} m (less its median, gaps left out)")
    targets.add(Target("px4_real_flight: barometer NIS/dof", row["nis"]["barometer"]["mean_over_dof"], 1.3))
    targets.add(
        Target(
            "px4_real_flight: horizontal position less GPS, rms [m]", row["horizontal_less_gps_m"]["rms"], 0.5
        )
    )
    targets.add(Target("px4_real_flight: restarts and resets", len(run.notes) - 1, 0))
    print(
        "GPS innovations lie below their band, not above: a receiver's fixes are smooth (their errors are slow), and "
        "the default noises allow for that. There is no truth in this recording."
    )
    return row


def against_gps(run: Run, batch: EventBatch) -> tuple[Array, Array]:
    """Return horizontal distance and difference in height [m] to the fixes, less their medians.

    Begins 5 s after the first estimate; fixes in a gap of the inertial sensor, and within 1 s after one, are left
    out: there the estimate is a guess of metres, and its sigma says so.
    """
    assert run.origin is not None
    fixes = batch.rows[batch.rows["kind"] == Kind.GPS_POSITION]
    t = fixes["stamp_ns"] - round(Config().gps.latency_s * 1e9)
    good = (t > run.t_ns[0] + 5_000_000_000) & (t < run.t_ns[-1])
    for i in np.flatnonzero(np.diff(run.t_ns) > 100_000_000):
        good &= (t < run.t_ns[i]) | (t > run.t_ns[i + 1] + 1_000_000_000)
    origin = np.array(run.origin)
    gps = np.array([geodetic_to_ned(v[0], v[1], v[2], origin) for v in fixes["value"][good]])
    ours = np.column_stack([np.interp(t[good], run.t_ns, run.position_m[:, i]) for i in range(3)])
    difference = ours - gps
    difference -= np.median(difference, axis=0)
    return np.linalg.norm(difference[:, :2], axis=1), difference[:, 2]


def ulog(folder: Path, targets: Targets) -> list[Row]:
    """Print and return what becomes of the short PX4 logs."""
    print("\n== ulog: import and replay of short PX4 logs ==")
    rows: list[Row] = []
    with tempfile.TemporaryDirectory() as scratch:
        for path in sorted((folder / "ulog").glob("*.ulg")):
            flight = imported([path], Path(scratch))
            result = deckfix.replay(flight)
            run, counts = result.run, {s.name: s.count for s in result.streams}
            row: Row = {
                "file": path.name,
                "events": counts,
                "problems": list(flight.problems),
                "estimates": len(run.t_ns),
                "notes": [text for _, text in run.notes],
                "waits_for": run.missing,
                "nis": nis_rows(run),
            }
            rows.append(row)
            print(f"{path.name}: {counts}")
            for problem in flight.problems:
                print(f"  import: {problem}")
            if run.missing:
                print(f"  does not start: waits for {run.missing}")
            else:
                nis = ", ".join(
                    f"{s} {v['mean_over_dof']:.2f} ({v['above_95']:.1%} above)" for s, v in row["nis"].items()
                )
                print(f"  {'; '.join(row['notes'])}; {len(run.t_ns)} estimates; NIS/dof {nis}")
            # A log without GPS has nothing to start from, and must say so; one with GPS must start.
            good = bool(len(run.t_ns)) if "gps_position" in counts else "GPS" in run.missing
            targets.add(Target(f"{path.name}: starts, or says what it lacks", float(not good), 0))
    return rows


TABLES: dict[str, Callable[[Path, Targets], Any]] = {"sitl": sitl, "rtk": rtk, "px4": px4, "ulog": ulog}


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the tables; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--only", nargs="+", choices=list(TABLES), default=list(TABLES))
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    folder = data_folder()
    if folder is None:
        parser.error("real data not found: set DECKFIX_DATA")
    begin = time.perf_counter()
    targets = Targets()
    out: Row = {"benchmark": "flights", **provenance()}
    for name in options.only:
        out[name] = TABLES[name](folder, targets)
    good = targets.report()
    out["targets"] = targets.as_rows()
    print(f"{time.perf_counter() - begin:.0f} s")
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


if __name__ == "__main__":
    raise SystemExit(main())

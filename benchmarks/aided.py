"""The same inertial samples, positions and headings through deckfix and through smsfusion's AidedINS.

Simulated landings: inertial sensor 100 Hz, position 5 Hz (2 cm and 4 cm, white, without delay, lever arm 0.4 m) and
heading 10 Hz, errors as both filters are told. Neither gets velocity, barometer or the receiver's statements. Printed
is the RMSE over the flights from 10 s on, ours over theirs, with its range; ours is wanted at or below theirs.
Theirs takes a measurement at the inertial sample that follows it. Where smsfusion is not installed (pip install
smsfusion), that is said and only ours is printed.

    python benchmarks/aided.py [--flights 5] [--json FILE] [--no-gate]
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import math
from collections.abc import Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from targets import Target, Targets, provenance

from estimation.estimator import LandingEstimator
from estimation.events import EventBatch, Kind
from estimation.frames import (
    geodetic_to_ned,
    normal_gravity,
    quat_conjugate,
    quat_log,
    quat_multiply,
    quat_to_euler,
)
from simulation.flight import SimulatedFlight, parse_scenario, simulate
from simulation.sensors import truth_at

Array = NDArray[np.float64]
Row = dict[str, Any]

FLIGHT = """
description = "a landing in Beaufort 2 with a survey receiver"
[plan]
rest_s = 8.0
climb_s = 7.0
leg_s = 9.0
hover_s = 10.0
descent_s = 12.0
deck_s = 2.0
altitude_m = 12.0
start_m = [-20.0, -12.0, -2.0]
legs_m = [[15.0, 20.0]]
yaw_rad = [0.6, 1.2, -0.5]
[sea]
beaufort = 2
[streams]
imu = { rate_hz = 100.0 }
gps = { rate_hz = 5.0 }
magnetometer = { rate_hz = 10.0 }
[filter.imu]
accel_noise = 0.01
gyro_noise = 5e-4
accel_bias_walk = 1e-4
gyro_bias_walk = 1e-5
accel_bias_sigma = 0.03
[filter.gps]
bias = false
latency_s = 0.0
lever_arm_m = [0.1, -0.05, -0.4]
position_sigma_m = 0.02
height_sigma_m = 0.04
[filter.barometer]
use = false
[filter.attitude]
use = "off"
"""
FIRST_SEED, FROM_S = 9000, 10.0
QUANTITIES = {
    "horizontal position [m]": slice(0, 2),
    "height [m]": slice(2, 3),
    "velocity [m/s]": slice(3, 6),
    "roll and pitch [rad]": slice(6, 8),
}


def given(flight: SimulatedFlight) -> EventBatch:
    """Return inertial samples, positions without the receiver's statement, and the field; nothing else."""
    rows = flight.batch.rows.copy()
    rows["covariance"][rows["kind"] == Kind.GPS_POSITION] = np.nan
    kept = np.isin(rows["kind"], (Kind.IMU, Kind.GPS_POSITION, Kind.MAGNETOMETER))
    return EventBatch(rows[kept], flight.batch.sensors, flight.batch.clocks)


def errors(flight: SimulatedFlight, t_ns: NDArray[np.int64], state: Array) -> Array:
    """Return truth less estimates (n, 9) of position and velocity (NED) and attitude (body) from ``FROM_S`` on."""
    m = truth_at(flight.trajectory, flight.clock, t_ns)
    turned = np.array(
        [
            quat_log(quat_multiply(quat_conjugate(a), b))
            for a, b in zip(state[:, 6:10], m.quaternion, strict=True)
        ]
    )
    e = np.hstack([m.position_m - state[:, :3], m.velocity_mps - state[:, 3:6], turned])
    late: Array = e[flight.clock.true_s(t_ns) >= FROM_S]
    return late


def ours(flight: SimulatedFlight, batch: EventBatch) -> Array:
    """Return our errors."""
    run = LandingEstimator(flight.scenario.config, facts=flight.facts).run(batch)
    if run.origin is None:
        raise SystemExit(f"seed {flight.seed}: did not start; it waited for {run.missing}")
    shift = geodetic_to_ned(*run.origin, flight.place.origin)
    return errors(flight, run.t_ns, np.hstack([run.position_m + shift, run.velocity_mps, run.quaternion]))


def theirs(flight: SimulatedFlight, batch: EventBatch) -> Array:
    """Return the errors of AidedINS with the same noises and initial sigmas, started level and still."""
    from smsfusion import AidedINS

    c, rows = flight.scenario.config, batch.rows
    imu = rows[rows["kind"] == Kind.IMU]
    fixes = rows[rows["kind"] == Kind.GPS_POSITION]
    fields = rows[rows["kind"] == Kind.MAGNETOMETER]
    place = np.array([geodetic_to_ned(*v[:3], flight.place.origin) for v in fixes["value"]])
    f0, b0 = imu["value"][:100, 3:].mean(axis=0), fields["value"][:10, :3].mean(axis=0)
    roll, pitch = math.atan2(-f0[1], -f0[2]), math.atan2(f0[0], math.hypot(f0[1], f0[2]))
    q0 = _quaternion(roll, pitch, 0.0)
    yaw = flight.place.declination_rad - _bearing(b0, roll, pitch)
    q0 = _quaternion(roll, pitch, yaw)
    tau = 1e4
    fs = 1e9 / float(np.median(np.diff(imu["stamp_ns"])))
    gravity = normal_gravity(float(flight.place.origin[0]), float(flight.place.origin[2]))
    x0 = np.concatenate([place[0], np.zeros(3), q0, np.zeros(3), imu["value"][:100, :3].mean(axis=0)])
    tilt, turn = c.initialisation.tilt_sigma_rad, c.initialisation.yaw_sigma_rad
    sigma = (
        [1.0] * 3
        + [0.1] * 3
        + [tilt, tilt, turn]
        + [c.imu.accel_bias_sigma] * 3
        + [c.imu.gyro_bias_sigma] * 3
    )
    walks = {
        "acc": (c.imu.accel_noise, c.imu.accel_bias_walk),
        "gyro": (c.imu.gyro_noise, c.imu.gyro_bias_walk),
    }
    # A Gauss-Markov bias of a long correlation time walks as ours does.
    told = {k: {"N": n, "B": w * math.sqrt(tau / 2.0), "tau_cb": tau} for k, (n, w) in walks.items()}
    filter_ = AidedINS(
        fs, x0, np.diag(np.square(sigma)), told["acc"], told["gyro"], g=gravity,
        lever_arm=np.array(c.gps.lever_arm_m), ignore_bias_acc=False, cold_start=False,
    )  # fmt: skip
    at_fix = dict(zip(np.searchsorted(imu["stamp_ns"], fixes["stamp_ns"]).tolist(), place, strict=True))
    at_field = dict(
        zip(
            np.searchsorted(imu["stamp_ns"], fields["stamp_ns"]).tolist(), fields["value"][:, :3], strict=True
        )
    )
    variance = np.square([c.gps.position_sigma_m, c.gps.position_sigma_m, c.gps.height_sigma_m])
    out = np.empty((len(imu), 10))
    for k, value in enumerate(imu["value"]):
        aiding: dict[str, Any] = {}
        if k in at_fix:
            aiding |= {"pos": at_fix[k], "pos_var": variance}
        if k in at_field:
            own = quat_to_euler(np.asarray(filter_.quaternion(), dtype=np.float64))
            head = flight.place.declination_rad - _bearing(at_field[k], float(own[0]), float(own[1]))
            head = (head + math.pi) % (2.0 * math.pi) - math.pi
            aiding |= {"head": head, "head_var": c.magnetometer.heading_sigma_rad**2, "head_degrees": False}
        filter_.update(value[3:6], value[:3], degrees=False, **aiding)
        out[k] = np.concatenate([filter_.position(), filter_.velocity(), filter_.quaternion()])
    return errors(flight, imu["stamp_ns"], out)


def _quaternion(roll: float, pitch: float, yaw: float) -> Array:
    from estimation.frames import euler_to_quat

    return euler_to_quat(roll, pitch, yaw)


def _bearing(field: Array, roll: float, pitch: float) -> float:
    """Return the direction of the field (3,), body axes, in the level plane, from forwards to the right [rad]."""
    from estimation.frames import quat_to_matrix

    level = quat_to_matrix(_quaternion(roll, pitch, 0.0)) @ field
    return math.atan2(level[1], level[0])


def main(arguments: Sequence[str] | None = None) -> int:
    """Print the table; return 0 when the targets are met (or not asked for), else 1."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--flights", type=int, default=5)
    parser.add_argument("--json", type=Path)
    parser.add_argument("--no-gate", action="store_true", help="exit with 0 also where a target is missed")
    options = parser.parse_args(arguments)
    there = importlib.util.find_spec("smsfusion") is not None
    if not there:
        print("the peer is left out: smsfusion is not installed (pip install smsfusion)")
    targets = Targets()
    scenario = parse_scenario(FLIGHT)
    found: dict[str, list[Array]] = {"ours": [], "theirs": []}
    for k in range(options.flights):
        flight = simulate(scenario, FIRST_SEED + k)
        batch = given(flight)
        found["ours"].append(_rms(ours(flight, batch)))
        if there:
            found["theirs"].append(_rms(theirs(flight, batch)))
    out: Row = {"benchmark": "aided", **provenance(), "flights": options.flights}
    out["smsfusion"] = version("smsfusion") if there else None
    for j, label in enumerate(QUANTITIES):
        a = np.array([v[j] for v in found["ours"]])
        row: Row = {"ours": float(np.sqrt(np.mean(a**2)))}
        text = f"{label:26} ours {row['ours']:.4f}"
        if there:
            b = np.array([v[j] for v in found["theirs"]])
            row["theirs"] = float(np.sqrt(np.mean(b**2)))
            ratios = np.sort(a / b)
            row["ratio"] = [float(ratios[0]), float(row["ours"] / row["theirs"]), float(ratios[-1])]
            text += (
                f", AidedINS {row['theirs']:.4f}: {row['ratio'][1]:.2f} ({ratios[0]:.2f}..{ratios[-1]:.2f})"
            )
            spread = float(ratios[-1] - ratios[0])
            targets.add(Target(f"{label}: ours over AidedINS", row["ratio"][1], 1.0, spread=spread))
        out[label] = row
        print(f"{text}, n {options.flights}")
    good = targets.report()
    out["targets"] = targets.as_rows()
    if options.json:
        options.json.write_text(json.dumps(out, indent=1) + "\n")
    return 0 if good or options.no_gate else 1


def _rms(e: Array) -> Array:
    return np.array(
        [float(np.sqrt(np.mean(np.sum(e[:, part] ** 2, axis=1)))) for part in QUANTITIES.values()]
    )


if __name__ == "__main__":
    raise SystemExit(main())

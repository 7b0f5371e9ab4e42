"""A small result made by hand, for tests of what presents results."""

from __future__ import annotations

from dataclasses import fields, replace
from typing import Any

import numpy as np

from deckfix.reference import Column, Trajectory, compare, window
from deckfix.result import AtReference, LogMessage, Result
from deckfix.streams import stream
from estimation.config import Config
from estimation.events import Kind
from estimation.frames import euler_to_quat
from estimation.outcome import Outcome
from estimation.output import RECORD_DTYPE, Run
from estimation.state import NOMINAL_SIZE, Layout

T0 = 41_550_000_000


def synthetic_run(seed: int = 1, seconds: float = 76.0, rate_hz: float = 50.0) -> tuple[Run, Trajectory]:
    """Return a flight up, along and down with white errors of known sigma, and its truth."""
    rng = np.random.default_rng(seed)
    n = int(seconds * rate_hz)
    s = np.arange(n) / rate_hz
    t = T0 + (s * 1e9).astype(np.int64)
    climb = np.clip((s - 4) / 10, 0, 1) - np.clip((s - 50) / 22, 0, 1)
    position = np.stack([20 * np.sin(s / 12), 12 * (1 - np.cos(s / 9)), -15 * climb], axis=1)
    velocity = np.gradient(position, s, axis=0)
    roll, pitch, yaw = 0.06 * np.sin(s), 0.05 * np.cos(0.7 * s), 0.4 + 0.01 * s
    q = np.array([euler_to_quat(a, b, c) for a, b, c in zip(roll, pitch, yaw, strict=True)])
    truth = Trajectory(Column(t, position), Column(t, velocity), Column(t, q))
    sigma = np.array([0.12, 0.12, 0.08, 0.05, 0.05, 0.03, 0.003, 0.003, 0.01])
    noise = rng.normal(size=(n, 9)) * sigma
    smooth = np.apply_along_axis(lambda c: np.convolve(c, np.ones(25) / 5.0, mode="same"), 0, noise)
    error_q = np.hstack([np.ones((n, 1)), smooth[:, 6:] / 2])
    q_est = np.array([_multiply(a, b) for a, b in zip(q, error_q, strict=True)])
    q_est /= np.linalg.norm(q_est, axis=1, keepdims=True)
    layout = Layout.of(Config())
    walk = np.cumsum(rng.normal(size=(n, 6)), axis=0) * 2e-5
    measured = position + smooth[:, :3] + np.array([0.3, -0.2, 0.5])
    nominal = np.zeros((n, NOMINAL_SIZE))
    nominal[:, 0:3], nominal[:, 3:6], nominal[:, 6:10] = measured, velocity + smooth[:, 3:6], q_est
    nominal[:, 10:16] = walk
    values: dict[str, Any] = {
        "engine": "filterpy",
        "t_ns": t,
        "position_m": measured,
        "velocity_mps": velocity + smooth[:, 3:6],
        "quaternion": q_est,
        "covariance": np.repeat(np.diag(sigma**2)[None], n, axis=0),
        "gyro_bias": walk[:, :3],
        "accel_bias": walk[:, 3:6],
        "nominal": nominal,
        "sigma": np.exp(-s / 15)[:, None] * 4e-3 + np.full(layout.size, 1e-3),
        "state_names": layout.names,
        "state_units": layout.units,
        "records": _records(rng, seconds),
        "sensors": ("gps_position", "gps_velocity", "barometer", "magnetometer"),
        "notes": [(int(t[0]), "initialised at rest")],
        "imu_outcomes": {Outcome.FUSED: n},
        "origin": (float(np.deg2rad(54.0)), float(np.deg2rad(7.5)), 12.0),
        "declination_rad": 0.05,
        "missing": "",
        "deck": np.zeros((n, 0)),
        "deck_covariance": np.zeros((n, 0, 0)),
        "heave": [],
        "clocks": [],
    }
    run = Run(**{f.name: values[f.name] for f in fields(Run)})
    return run, truth


def _multiply(a: Any, b: Any) -> Any:
    w = a[0] * b[0] - a[1:] @ b[1:]
    return np.concatenate([[w], a[0] * b[1:] + b[0] * a[1:] + np.cross(a[1:], b[1:])])


def _records(rng: np.random.Generator, seconds: float) -> Any:
    parts = []
    for sensor, (rate, dof, sigma) in enumerate([(5, 3, 0.7), (5, 3, 0.2), (20, 1, 0.2), (30, 1, 0.06)]):
        n = int(seconds * rate)
        rows = np.zeros(n, dtype=RECORD_DTYPE)
        rows["t_ns"] = T0 + (np.arange(n) / rate * 1e9).astype(np.int64)
        rows["stamp_ns"] = rows["arrival_ns"] = rows["t_ns"]
        rows["sensor"], rows["dof"] = sensor, dof
        z = rng.normal(size=(n, 3))
        z[:, dof:] = np.nan
        rows["innovation"], rows["sigma"] = z * sigma, np.where(np.isfinite(z), sigma, np.nan)
        rows["nis"] = np.nansum(z**2, axis=1)
        rows["outcome"] = np.where(rng.random(n) < 0.03, int(Outcome.FUSED_LATE), int(Outcome.FUSED))
        parts.append(rows)
    return np.concatenate(parts)


def synthetic_result(*, with_truth: bool = True, seed: int = 1, **changes: Any) -> Result:
    """Return a result of the synthetic flight; ``changes`` replace fields."""
    run, truth = synthetic_run(seed)
    assert truth.position_m is not None
    start, end = int(run.t_ns[0]), int(run.t_ns[-1])
    judged = window(start, end, None)
    rng = np.random.default_rng(seed + 1)
    times = run.t_ns[::2]
    theirs = Trajectory(
        Column(times, truth.position_m.values[::2] + 0.2 * np.sin(times * 1e-9)[:, None]),
        Column(times, truth.velocity_mps.values[::2] + rng.normal(size=(len(times), 3)) * 0.1),  # type: ignore[union-attr]
        Column(times, truth.quaternion.values[::2]),  # type: ignore[union-attr]
    )
    events = {
        "imu": (Kind.IMU, 200.0),
        "gps_position": (Kind.GPS_POSITION, 5.0),
        "barometer": (Kind.BAROMETER, 20.0),
    }
    events["gps_velocity"], events["magnetometer"] = (Kind.GPS_VELOCITY, 5.0), (Kind.MAGNETOMETER, 30.0)
    streams = tuple(
        stream(name, kind, start + (np.arange(0, 76, 1 / rate) * 1e9).astype(np.int64))
        for name, (kind, rate) in events.items()
    )
    result = Result(
        flight="synthetic.mcap",
        run=run,
        streams=streams,
        start_ns=start,
        end_ns=end,
        judged=judged,
        config_text="[gps]\nlatency_s = 0.105\n",
        config_source="default configuration",
        wall_s=1.5,
        autopilot=theirs,
        messages=(LogMessage(start + 10**9, 20, "autopilot", "Arming motors"),),
        metadata={"import": {"file": "synthetic"}},
    )
    if with_truth:
        own = (run.t_ns, run.position_m, run.velocity_mps, run.quaternion)
        q = theirs.quaternion_at(times)
        result.truth = truth
        result.truth_errors = compare(*own, truth, judged, run.covariance)
        result.at_autopilot = AtReference(
            ours=compare(*(v[::2] for v in own), truth, judged),  # type: ignore[arg-type]
            autopilot=compare(times, theirs.position_m.values, theirs.velocity_mps.values, q, truth, judged),  # type: ignore[union-attr]
        )
    return replace(result, **changes) if changes else result

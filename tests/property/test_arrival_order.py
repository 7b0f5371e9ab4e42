"""Any order of arrival inside the window gives the same estimate, to the last bit."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st

from estimation.config import Config, parse_config
from estimation.estimator import LandingEstimator
from estimation.events import EVENT_DTYPE, EventBatch, Kind
from estimation.outcome import Outcome
from estimation.output import Run

SENSORS = ("imu", "gps_position", "gps_velocity", "barometer", "magnetometer")
DURATION_S = 4.0
MS = 1_000_000


def make_flight(seed: int) -> EventBatch:
    """A vehicle that hangs in the air and shivers: every sensor, stamps that coincide, latencies as configured."""
    rng = np.random.default_rng(seed)
    rows = []

    def add(t_ms: int, sensor: int, kind: Kind, value: list[float], own: list[float] | None = None) -> None:
        row = np.zeros((), dtype=EVENT_DTYPE)
        row["stamp_ns"] = row["arrival_ns"] = 10_000 * MS + t_ms * MS
        row["sensor"], row["kind"] = sensor, kind
        row["value"] = [*value, *[math.nan] * (6 - len(value))]
        row["covariance"] = own or [math.nan] * 6
        rows.append(row)

    for t in range(0, int(DURATION_S * 1000), 10):
        shiver = rng.normal(size=6) * [0.02, 0.02, 0.02, 0.1, 0.1, 0.1]
        add(t, 0, Kind.IMU, list(shiver + np.array([0, 0, 0, 0, 0, -9.81])))
        if t % 200 == 0:
            add(t, 1, Kind.GPS_POSITION, [0.94 + rng.normal() * 1e-8, 0.13, 50.0 + rng.normal(), 1.0])
            add(t, 2, Kind.GPS_VELOCITY, [*(rng.normal(size=3) * 0.1), 1.0], [0.01, 0, 0, 0.01, 0, 0.04])
        if t % 50 == 7 * (t % 50 == 7):
            add(t, 3, Kind.BAROMETER, [101325.0 - 600 + rng.normal() * 2])
        if t % 30 == 0:
            add(t + 3, 4, Kind.MAGNETOMETER, [0.18e-4 + rng.normal() * 1e-7, 0.0, 0.45e-4])
    batch = np.array(rows, dtype=EVENT_DTYPE)
    return EventBatch(batch[np.argsort(batch["arrival_ns"], kind="stable")], SENSORS)


def shuffled(batch: EventBatch, rng: np.random.Generator, spread_ms: float, duplicates: int) -> EventBatch:
    """Delay each event by up to the spread, and send some of them twice."""
    rows = batch.rows
    again = rows[rng.choice(len(rows), size=duplicates, replace=False)]
    rows = np.concatenate((rows, again))
    delay = rng.uniform(0.0, spread_ms * MS, size=len(rows)).astype(np.int64)
    return EventBatch(rows[np.argsort(rows["stamp_ns"] + delay, kind="stable")], batch.sensors)


def final(run: Run, estimator: LandingEstimator) -> tuple[bytes, bytes, bytes]:
    """The state at the end, and every comparison that was made, as bytes."""
    assert estimator._engine is not None
    state = estimator._engine.state
    tried = run.records[run.records["dof"] > 0]
    comparisons = np.column_stack([tried["t_ns"], tried["sensor"]]).tobytes()
    return state.x.tobytes(), state.P.tobytes(), comparisons + tried["nis"].tobytes()


@pytest.fixture(scope="module")
def config() -> Config:
    return parse_config("[filter]\noutput_rate_hz = 0.0\n[gps]\nlatency_s = 0.1\n")


@pytest.fixture(scope="module")
def flight() -> EventBatch:
    return make_flight(3)


@pytest.mark.parametrize("engine", ["filterpy", "compiled"])
@settings(
    max_examples=8,
    deadline=None,
    phases=[Phase.explicit, Phase.generate],
    suppress_health_check=list(HealthCheck),
)
@given(seed=st.integers(0, 2**32 - 1), spread_ms=st.floats(0.0, 380.0), duplicates=st.integers(0, 20))
def test_order_of_arrival_does_not_matter(
    engine: str, seed: int, spread_ms: float, duplicates: int, config: Config, flight: EventBatch
) -> None:
    if engine == "compiled":
        pytest.importorskip("numba", reason="the compiled engine needs numba")
    in_order = LandingEstimator(config, engine)  # type: ignore[arg-type]
    expected = final(in_order.run(flight), in_order)
    disordered = LandingEstimator(config, engine)  # type: ignore[arg-type]
    run = disordered.run(shuffled(flight, np.random.default_rng(seed), spread_ms, duplicates))
    assert final(run, disordered) == expected
    repeated = np.count_nonzero(run.records["outcome"] == Outcome.REJECTED_DUPLICATE)
    assert repeated <= duplicates
    assert not np.any(run.records["outcome"] == Outcome.REJECTED_TOO_OLD)
    # Only the magnetometer's last reading, which no inertial sample follows.
    assert np.count_nonzero(run.records["outcome"] == Outcome.REJECTED_FUTURE) == 1


@pytest.mark.parametrize("engine", ["filterpy", "compiled"])
def test_stepping_equals_running(engine: str, config: Config, flight: EventBatch) -> None:
    if engine == "compiled":
        pytest.importorskip("numba", reason="the compiled engine needs numba")
    disordered = shuffled(flight, np.random.default_rng(5), 200.0, 10)
    run = LandingEstimator(config, engine).run(disordered)  # type: ignore[arg-type]
    stepped = LandingEstimator(config, engine)  # type: ignore[arg-type]
    estimates = [o.estimate for o in (stepped.step(e) for e in disordered) if o.estimate is not None]
    assert len(estimates) == len(run.t_ns) > 50
    assert np.array_equal(np.array([e.nominal for e in estimates]), run.nominal)
    assert np.array_equal(np.array([e.covariance for e in estimates]), run.covariance)


def test_a_microsecond_and_a_last_bit_change_little(config: Config, flight: EventBatch) -> None:
    expected = LandingEstimator(config, "filterpy").run(flight)
    rows = flight.rows.copy()
    rows["stamp_ns"][rows["kind"] != Kind.IMU] += 1000
    rows["value"][:, 0] = np.nextafter(rows["value"][:, 0], np.inf)
    moved = LandingEstimator(config, "filterpy").run(EventBatch(rows, flight.sensors))
    assert len(moved.t_ns) == len(expected.t_ns)
    assert np.abs(moved.position_m - expected.position_m).max() < 1e-4
    assert np.abs(moved.velocity_mps - expected.velocity_mps).max() < 1e-4
    assert np.abs(moved.nominal[:, 6:10] - expected.nominal[:, 6:10]).max() < 1e-6

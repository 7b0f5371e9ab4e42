"""A sensor of the user's: from a log's /user through gate, records and report back into a log."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from small_flight import BOOT, UTC, small_recording

import deckfix
from deckfix.files import InputError
from estimation.config import Config, ConfigError
from estimation.consistency import check_jacobian
from estimation.events import EventBatch, UserMeasurement
from estimation.frames import Array
from estimation.outcome import Outcome
from estimation.state import P0, POSITION, Layout
from logs import FlightWriter
from logs.events import series_of_batch

BEACON = np.array([30.0, -40.0, 0.0])
SIGMA_M, LATENCY_S = 0.05, 0.03
OUTLIER_S = 10.0


def beacon(value: Array, nominal: Array, layout: Layout) -> tuple[Array, Array, Array]:
    apart = nominal[P0 : P0 + 3] - BEACON
    distance = np.linalg.norm(apart)
    jacobian = np.zeros((1, layout.size))
    at = layout.offsets[POSITION]
    jacobian[0, at : at + 3] = apart / distance
    return np.array([value[0] - distance]), jacobian, np.array([[SIGMA_M**2]])


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Write a flight at rest, within some decimetres of the origin, with a beacon 50 m away; one reading is wrong."""
    rng = np.random.default_rng(3)
    recording = small_recording(14.0)
    events = []
    for seconds in np.arange(0.5, 13.5, 0.1):
        stamp = BOOT + round((seconds + LATENCY_S) * 1e9)
        wrong = 20.0 if abs(seconds - OUTLIER_S) < 0.01 else 0.0
        distance = 50.0 + float(rng.normal()) * SIGMA_M + wrong
        events.append(UserMeasurement(stamp, stamp + UTC, (distance,), "beacon"))
    recording.series += series_of_batch(EventBatch.from_events(events))
    path = tmp_path_factory.mktemp("own") / "flight.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
    return path


def test_it_is_fused_gated_and_reported(log: Path, tmp_path: Path) -> None:
    with_it = deckfix.replay(log, sensors={"beacon": (beacon, LATENCY_S)})
    without = deckfix.replay(log, engine="filterpy")
    assert with_it.run.engine == "filterpy"
    outcomes = with_it.summary()["fusion"]["beacon"]
    assert outcomes["REJECTED_GATE"] == 1
    assert outcomes.get("FUSED", 0) + outcomes["FUSED_LATE"] > 80
    towards = BEACON / np.linalg.norm(BEACON)
    sigma = [np.sqrt(towards @ r.run.covariance[-1][:3, :3] @ towards) for r in (with_it, without)]
    assert sigma[0] < 0.1 < sigma[1]
    distance = np.linalg.norm(with_it.run.position_m[-1] - BEACON)
    assert abs(distance - 50.0) < 4.0 * sigma[0]
    assert "beacon" in with_it.report()
    with_it.write(tmp_path / "estimate.mcap")
    flight = deckfix.open(tmp_path / "estimate.mcap")
    (records,) = [s for s in flight.series("/fusion") if s.strings["sensor"] == "beacon"]
    assert np.count_nonzero(records.data["outcome"] == Outcome.REJECTED_GATE) == 1
    assert len(flight.series("/user")[0]) == len(deckfix.open(log).series("/user")[0])


def test_its_latency_is_that_of_its_content(log: Path) -> None:
    late = deckfix.replay(log, sensors={"beacon": (beacon, LATENCY_S)})
    at_once = deckfix.replay(log, sensors={"beacon": (beacon, 0.0)})

    def times(result: deckfix.Result) -> Array:
        k = result.run.sensors.index("beacon")
        return np.sort(result.run.records["t_ns"][result.run.records["sensor"] == k])

    assert np.array_equal(times(late), times(at_once) - round(LATENCY_S * 1e9))


def test_without_a_model_it_is_not_ready(log: Path) -> None:
    outcomes = deckfix.replay(log, engine="filterpy").summary()["fusion"]["beacon"]
    assert set(outcomes) == {"REJECTED_NOT_READY"}


def test_a_name_that_the_log_lacks_is_told(log: Path) -> None:
    with pytest.raises(InputError, match="no measurements of the sensor 'becon'"):
        deckfix.replay(log, sensors={"becon": (beacon, 0.0)})


def test_the_compiled_engine_has_no_models_of_the_users(log: Path) -> None:
    pytest.importorskip("numba", reason="the compiled engine needs numba")
    with pytest.raises(ConfigError, match="needs engine='filterpy'"):
        deckfix.replay(log, engine="compiled", sensors={"beacon": (beacon, 0.0)})


def test_the_check_names_the_wrong_entry(log: Path) -> None:
    def wrong(value: Array, nominal: Array, layout: Layout) -> tuple[Array, Array, Array]:
        r, H, R = beacon(value, nominal, layout)
        H[0, layout.offsets[POSITION] + 1] *= -1.0
        return r, H, R

    result = deckfix.replay(log, sensors={"beacon": (beacon, LATENCY_S)})
    layout = Layout.of(Config())
    x = result.run.nominal[-1]
    assert check_jacobian(beacon, np.array([50.0]), x, layout).correct
    told = check_jacobian(wrong, np.array([50.0]), x, layout)
    assert not told.correct
    assert "position.e" in str(told)

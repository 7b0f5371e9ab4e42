"""The platform in a result: errors against its truth, forecasts and how they are judged, clocks, topics."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from small_flight import BOOT, COMPANION_AHEAD_NS, HEAVE_M, HEAVE_S, deck_down_m, deck_recording

import deckfix
from deckfix.commands import finite
from deckfix.deck_reference import ARRIVED_S, fused_fixes_ns, height_seen_later, slow, true_height
from deckfix.forecasts import HORIZONS_S, Forecasts, judge
from deckfix.reference import Column, Trajectory, column
from deckfix.result import Result
from estimation.config import parse_config
from logs.writer import FlightWriter

CONFIG = "[platform]\nuse = true\nlearn_s = 2.0\n"


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("deck") / "deck.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording())
    return path


@pytest.fixture(scope="module")
def result(log: Path) -> Result:
    return deckfix.replay(log, parse_config(CONFIG), engine="auto")


@pytest.fixture(scope="module")
def written(result: Result, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("written") / "estimate.mcap"
    result.write(path)
    return path


def test_relative_position_and_heave_are_judged_against_the_truth(result: Result) -> None:
    truth = result.summary()["truth"]
    assert set(truth["relative"]) == {"position_rmse_m", "velocity_rmse_mps", "nees_over_dof"}
    assert max(truth["relative"]["position_rmse_m"]) < 0.06
    assert truth["relative"]["nees_over_dof"] < 3.0
    assert truth["platform"]["heave_rmse_m"] < 0.1
    assert result.deck_errors is not None
    first = result.deck_errors.judged.start_ns
    assert result.seconds(first) == pytest.approx(result.t_s[0] + 5.0, abs=0.5)


def test_the_height_that_was_seen_begins_with_the_first_fix(result: Result) -> None:
    """Before it the height is the prior's: a sample of it beside the others is no heave."""
    records = result.run.records
    run = replace(result.run, records=records[records["t_ns"] > result.run.t_ns[0] + 3_000_000_000])
    height, fixes = height_seen_later(run), fused_fixes_ns(run)
    assert height is not None and fixes[0] > run.t_ns[0] + 3_000_000_000
    known = fixes[0] + round(ARRIVED_S * 1e9)
    assert height.t_ns[0] == run.t_ns[np.searchsorted(run.t_ns, known)]
    assert np.all(np.isin(run.t_ns[run.t_ns > known], height.t_ns))


def test_the_truth_is_put_on_the_level_that_fixes_told(result: Result) -> None:
    """The prior's level, metres away, moves neither the truth before the first fix nor that of the seconds after."""
    records = result.run.records
    late = result.run.t_ns[0] + 3_000_000_000
    deck = result.run.deck.copy()
    deck[result.run.t_ns <= late, 6] = 0.0
    deck[result.run.t_ns > late, 6] = 5.0
    run = replace(result.run, records=records[records["t_ns"] > late], deck=deck)
    down = np.zeros((len(run.t_ns), 3))
    position = column(run.t_ns, down)
    assert position is not None
    height = true_height(run, Trajectory(position, None, None))
    assert height is not None
    assert np.allclose(height.at(run.t_ns)[:, 0], 5.0)
    assert true_height(replace(run, records=records[:0]), Trajectory(position, None, None)) is None


def test_raw_fixes_are_shown_in_the_same_frame(result: Result) -> None:
    assert result.fixes is not None
    seconds = (result.fixes.t_ns - BOOT) * 1e-9
    error = result.fixes.relative_m[:, 2] + deck_down_m(seconds)
    assert np.sqrt(np.mean(error**2)) == pytest.approx(0.02, abs=0.01)
    assert np.mean(result.fixes.relative_m[:, :2], axis=0) == pytest.approx([-0.4, 0.3], abs=0.05)


def test_heave_block_tells_model_window_and_scores(result: Result) -> None:
    heave = result.summary()["heave"]
    assert heave["dominant_period_s"] == pytest.approx(HEAVE_S, rel=0.05)
    assert heave["hs_m"] == pytest.approx(4.0 * HEAVE_M / np.sqrt(2.0), rel=0.2)
    assert list(heave["skill"]) == [f"{h:g}" for h in HORIZONS_S if h > 0]
    assert set(heave["window"]["probability"]) == {f"{h:g}" for h in HORIZONS_S}
    scores = heave["forecast"]
    assert scores["against"] == "truth"
    one = scores["horizons"]["1"]
    assert one["rmse_m"] < 0.6 * one["level_rmse_m"]
    assert one["level_rmse_m"] == pytest.approx(HEAVE_M / np.sqrt(2.0), rel=0.3)
    json.dumps(finite(result.summary()), allow_nan=False)


def test_without_truth_the_later_estimate_judges(log: Path, tmp_path: Path) -> None:
    path = tmp_path / "bare.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording(truth=False))
    bare = deckfix.replay(path, parse_config(CONFIG), engine="auto")
    assert "truth" not in bare.summary()
    assert bare.summary()["heave"]["forecast"]["against"] == "estimate"


def test_the_clock_block_states_its_sign(result: Result) -> None:
    clock = result.summary()["clock"]["companion"]
    assert clock["offset_ms"] == pytest.approx(COMPANION_AHEAD_NS * 1e-6, abs=0.1)
    assert "older than its stamp" in clock["latency_convention"]
    track = result.clock_tracks[0]
    assert track.clock == "companion"
    assert track.offset_ms[-1] == pytest.approx(COMPANION_AHEAD_NS * 1e-6, abs=0.1)
    assert np.all(np.diff(track.t_ns) > 0)


def test_forecasts_are_written_and_read_back(result: Result, written: Path) -> None:
    flight = deckfix.open(written)
    models = flight.series("/heave/model")
    assert sum(len(s) for s in models) == len(result.run.heave)
    forecast = flight.series("/heave/forecast")[0]
    assert np.array_equal(forecast.data["heave_m"], result.forecasts.heave_m)
    assert np.array_equal(forecast.stamp_ns, result.forecasts.origin_ns)
    assert "positive up" in forecast.metadata["heave"]
    due, model = result.run.heave[-1]
    last = models[-1]
    assert last.stamp_ns[-1] == due + round(model.last_s * 1e9)
    row = last.data[-1]
    at_stamp = row["level_m"] + np.sum(row["amplitude_m"] * np.sin(row["phase_rad"]))
    assert at_stamp == pytest.approx(float(model.forecast(0.0)[0]), abs=1e-9)


def test_other_readers_read_the_heave_topics(written: Path) -> None:
    from mcap_ros2.reader import read_ros2_messages
    from rosbags.highlevel import AnyReader
    from rosbags.typesys import Stores, get_typestore

    theirs = [m.ros_msg for m in read_ros2_messages(str(written), topics=["/heave/forecast"])]
    assert [round(h, 3) for h in theirs[-1].horizon_s] == list(HORIZONS_S)
    with AnyReader([written], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader:
        chosen = [c for c in reader.connections if c.topic == "/heave/model"]
        read = [reader.deserialize(raw, c.msgtype) for c, _, raw in reader.messages(connections=chosen)]
    assert read[-1].method == "bhr"
    assert len(read[-1].amplitude_m) == len(read[-1].period_s) > 10


def test_a_written_replay_checks_against_itself(written: Path) -> None:
    from deckfix.check import compare_recorded

    again = deckfix.replay(written, engine="auto")
    assert again.source is not None
    differing, count = compare_recorded(again, again.source) or (["none"], 0)
    assert differing == []
    assert count > 1000


def made(heave: float, sigma: float, n: int = 20) -> Forecasts:
    h = np.array([0.0, 1.0])
    full = np.full((n, 2), heave)
    origins = np.arange(n, dtype=np.int64) * 100_000_000
    zeros = np.zeros((n, 2))
    return Forecasts(
        origins, h, np.zeros(n), full, np.full((n, 2), sigma), zeros, zeros + 0.1, zeros, zeros > 1, zeros
    )


def test_judging_counts_errors_and_coverage() -> None:
    t = np.arange(0, 2_000_000_001, 100_000_000, dtype=np.int64)
    happened = Column(t, np.full((len(t), 1), 0.5))
    scores = judge(made(0.4, 0.06), happened, "truth")
    assert scores.rmse_m[0] == pytest.approx(0.1)
    assert scores.level_rmse_m[0] == pytest.approx(0.5)
    assert scores.coverage_95[0] == 1.0
    assert scores.count.tolist() == [20, 11]
    assert judge(made(0.4, 0.04), happened, "truth").coverage_95[0] == 0.0
    unknown = judge(made(0.4, np.inf), happened, "truth")
    assert unknown.count.tolist() == [0, 0]
    assert np.isnan(unknown.rmse_m).all()
    assert unknown.block()["horizons"] == {}


def test_slow_takes_drift_and_leaves_heave() -> None:
    t = np.arange(0, 60_000_000_000, 20_000_000, dtype=np.int64)
    s = t * 1e-9
    drift, heave = 0.01 * s, 0.3 * np.sin(2.0 * np.pi * s / 4.0)
    left = drift + heave - slow(t, drift + heave)
    middle = (s > 10) & (s < 50)
    assert np.max(np.abs(left - heave)[middle]) < 0.01
    holes = np.where(s < 20, np.nan, drift)
    assert np.isfinite(slow(t, holes)[s > 25]).all()

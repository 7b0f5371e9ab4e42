"""``replay --smooth``: the smoothed estimates in the result, the summary, the log and the figures."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from small_flight import deck_recording, small_log

import deckfix
from deckfix.cli import main
from deckfix.result import Result
from logs.estimates import odometry_columns
from logs.writer import FlightWriter

TOPICS = ("/smoothed/odometry", "/smoothed/relative", "/smoothed/platform")


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> Result:
    path = tmp_path_factory.mktemp("logs") / "deck.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording(16.0))
    config = path.with_suffix(".toml")
    config.write_text("[platform]\nuse = true\n")
    return deckfix.replay(path, config, smooth=True)


def test_the_summary_has_the_smoothed_errors_beside_the_filters(result: Result) -> None:
    summary = result.summary()
    block = summary["smoothed"]
    assert set(block) == {"estimates", *summary["truth"]}
    assert {"odometry", "relative", "platform"} < set(block)
    filtered, smoothed = (
        np.linalg.norm(b["odometry"]["velocity_rmse_mps"]) for b in (summary["truth"], block)
    )
    assert smoothed < filtered
    assert block["platform"]["heave_rmse_m"] < summary["truth"]["platform"]["heave_rmse_m"]


def test_the_log_has_the_smoothed_topics_once(result: Result, tmp_path: Path) -> None:
    out, again = tmp_path / "out.mcap", tmp_path / "again.mcap"
    result.write(out)
    flight = deckfix.open(out)
    assert result.smoothed is not None
    for topic in TOPICS:
        (series,) = flight.series(topic)
        assert len(series) == len(result.smoothed.t_ns)
    (series,) = flight.series("/smoothed/odometry")
    columns = odometry_columns(series)
    assert np.array_equal(columns.stamp_ns, result.smoothed.t_ns)
    assert np.allclose(columns.velocity_mps, result.smoothed.velocity_mps)
    deckfix.replay(out, engine=result.run.engine).write(again)  # type: ignore[arg-type]
    assert not any(topic in deckfix.open(again).topics for topic in TOPICS)


def test_without_a_truth_the_smoothed_track_is_the_reference(tmp_path: Path) -> None:
    log = small_log(tmp_path / "bare.mcap", 8.0, truth=False)
    result = deckfix.replay(log, engine="filterpy", smooth=True)
    block = result.summary()["smoothed"]
    assert set(block) == {"estimates", "filter_less_smoothed"}
    assert 0.0 < max(block["filter_less_smoothed"]["velocity_rmse_mps"]) < 0.2
    assert "smoothed" in {trace.name for trace in result.figure().data}
    plain = deckfix.replay(log, engine="filterpy")
    assert "smoothed" not in plain.summary()
    assert "smoothed" not in {trace.name for trace in plain.figure().data}


def test_the_command(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    log = small_log(tmp_path / "flight.mcap", 6.0)
    out, summary = tmp_path / "out.mcap", tmp_path / "s.json"
    wanted = ["replay", str(log), "--smooth", "-o", str(out), "--json", str(summary), "--engine", "filterpy"]
    assert main([*wanted, "--check"]) == 0, capsys.readouterr().err
    assert "two replays gave equal files" in capsys.readouterr().out
    assert json.loads(summary.read_text())["smoothed"]["estimates"] > 100
    assert "/smoothed/odometry" in deckfix.open(out).topics

"""``deckfix.replay`` and its ``Result``: what comes out, where it comes from, and that it can be written."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest
from small_flight import UTC, small_log, small_recording

import deckfix
from deckfix.result import Result
from estimation.config import parse_config
from estimation.events import Kind
from logs.errors import LogError
from logs.writer import FlightWriter


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_log(tmp_path_factory.mktemp("logs") / "flight.mcap")


@pytest.fixture(scope="module")
def result(log: Path) -> Result:
    return deckfix.replay(log, engine="filterpy")


def test_the_public_names_are_there() -> None:
    assert sorted(deckfix.__all__) == ["Result", "__version__", "open", "replay"]
    assert deckfix.Result is Result
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        deckfix.nothing  # noqa: B018


def test_the_summary_has_the_documented_keys(result: Result) -> None:
    summary = result.summary()
    assert list(summary) == [
        "flight", "duration_s", "engine", "wall_s", "events", "fusion", "nis", "truth", "autopilot", "ratio",
    ]  # fmt: skip
    assert summary["duration_s"] == pytest.approx(15.99)
    assert summary["events"]["imu"] == {"count": 1600, "rate_hz": pytest.approx(100.0), "gaps": 0}
    assert set(summary["nis"]["barometer"]) == {"mean_over_dof", "inside_95", "above_95"}
    fused = summary["fusion"]["gps_position"]
    assert sum(fused.values()) == 80
    errors = summary["truth"]["odometry"]
    assert set(errors) == {"position_rmse_m", "velocity_rmse_mps", "attitude_rmse_deg", "nees_over_dof"}
    assert max(errors["velocity_rmse_mps"]) < 0.1
    assert summary["autopilot"]["velocity_rmse_mps"] == pytest.approx([0.2, 0.2, 0.2])
    assert summary["ratio"]["horizontal_velocity"] < 0.5


def test_what_is_absent_is_absent(tmp_path: Path) -> None:
    bare = deckfix.replay(small_log(tmp_path / "bare.mcap", truth=False), engine="filterpy")
    assert {"truth", "autopilot", "ratio", "heave"}.isdisjoint(bare.summary())


def test_the_table_has_every_estimate(result: Result) -> None:
    table = result.to_pandas()
    assert len(table) == len(result.run.t_ns)
    assert table.index.name == "t_s"
    assert table["t_ns"].iloc[0] == result.run.t_ns[0]
    assert {"position_n_m", "yaw_rad", "state gyro_bias.x", "sigma gyro_bias.x"} <= set(table.columns)
    assert np.array_equal(table["state position.n"], result.run.position_m[:, 0])


def test_without_pandas_the_remedy_is_told(result: Result, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(ImportError, match="pip install pandas"):
        result.to_pandas()


def test_the_figure_is_plotlys(result: Result) -> None:
    figure = result.figure()
    names = {t.name for t in figure.data}
    assert {"truth", "autopilot", "deckfix"} <= names


def test_what_is_written_reads_back(result: Result, log: Path, tmp_path: Path) -> None:
    first, second = tmp_path / "a.mcap", tmp_path / "b.mcap"
    result.write(first)
    result.write(second)
    assert first.read_bytes() == second.read_bytes()
    flight, source = deckfix.open(first), deckfix.open(log)
    assert flight.complete
    a, b = flight.events(), source.events()
    assert a.rows.tobytes() == b.rows.tobytes()
    assert a.sensors == b.sensors
    odometry = flight.series("/estimate/odometry")[0]
    assert np.array_equal(odometry.stamp_ns, result.run.t_ns)
    assert np.array_equal(odometry.arrival_ns, result.run.t_ns + UTC)
    assert np.array_equal(odometry.data["pose_pose_position"], result.run.position_m)
    assert flight.metadata["deckfix.source"] == source.metadata["deckfix.source"]
    assert flight.metadata["deckfix.estimate"]["engine"] == "filterpy"
    assert len(flight.series("/truth/odometry")[0]) == len(source.series("/truth/odometry")[0])


def test_a_log_carries_its_configuration(log: Path, tmp_path: Path) -> None:
    config = parse_config("[gps]\nlatency_s = 0.05\n")
    first = deckfix.replay(log, config, "filterpy")
    assert first.config_source == "the configuration given"
    first.write(tmp_path / "out.mcap")
    again = deckfix.replay(tmp_path / "out.mcap", engine="filterpy")
    assert again.config_source == "the configuration in the log"
    assert "latency_s = 0.05" in again.config_text
    assert again.run.position_m.tobytes() == first.run.position_m.tobytes()
    again.write(tmp_path / "out2.mcap")
    assert (tmp_path / "out2.mcap").read_bytes() == (tmp_path / "out.mcap").read_bytes()


def test_the_log_tells_delay_and_declination(tmp_path: Path) -> None:
    from deckfix.replaying import facts

    recording = small_recording(2.0)
    for series in recording.series:
        if series.topic == "/imu":
            series.metadata["latency_s"] = "0.01125"
        if series.topic == "/magnetic_field":
            series.metadata["autopilot_declination_rad"] = "nan"
    with FlightWriter(tmp_path / "a.mcap") as writer:
        writer.write_recording(recording)
    told = facts(deckfix.open(tmp_path / "a.mcap"))
    assert told.imu_latency_s == 0.01125
    assert told.declination_rad is None


def test_a_log_without_imu_is_refused(tmp_path: Path) -> None:
    recording = small_recording(2.0)
    recording.series = [s for s in recording.series if s.topic != "/imu"]
    with FlightWriter(tmp_path / "a.mcap") as writer:
        writer.write_recording(recording)
    with pytest.raises(LogError, match=r"a\.mcap: holds no inertial samples"):
        deckfix.replay(tmp_path / "a.mcap")


def test_a_log_without_gps_gives_no_estimate_and_says_why(tmp_path: Path) -> None:
    from deckfix.findings import findings

    recording = small_recording(4.0)
    recording.series = [s for s in recording.series if not s.topic.startswith("/gps")]
    with FlightWriter(tmp_path / "a.mcap") as writer:
        writer.write_recording(recording)
    got = deckfix.replay(tmp_path / "a.mcap", engine="filterpy")
    assert len(got.run.t_ns) == 0
    assert got.summary()["events"]["imu"]["count"] == 400
    told = [f.symptom for f in findings(got)]
    assert "no estimate came out" in told
    assert "no gps position in the log" in told
    got.write(tmp_path / "out.mcap")
    assert deckfix.open(tmp_path / "out.mcap").events().rows["kind"].max() == int(Kind.MAGNETOMETER)

"""Real flights through import, log and replay: the numbers that the benchmarks print are kept here."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

import deckfix
from deckfix.replaying import facts
from estimation.config import Config, parse_config
from estimation.estimator import LandingEstimator
from estimation.outcome import Outcome
from estimation.output import Facts

sys.path.insert(0, str(Path(__file__).parents[2] / "benchmarks"))

import engines
import flights
import realdata

SITL_LATENCY_S = 0.01125
"""Group delay of a second-order low-pass at 20 Hz: sqrt(2) / (2 pi 20)."""


@pytest.mark.parametrize("name", realdata.SITL_FLIGHTS)
def test_errors_over_those_of_the_autopilot(name: str, data_dir: Path, tmp_path: Path) -> None:
    flight = realdata.imported([data_dir / "ardupilot_sitl" / f"{name}.BIN"], tmp_path)
    row = flights.sitl_row(name, "BIN", deckfix.replay(flight))
    assert set(row["ratio"]) == set(flights.RATIO_TARGETS)
    for key, bound in flights.RATIO_TARGETS.items():
        assert row["ratio"][key] <= bound, key
    assert row["nees_over_dof"] < 1.3
    assert set(row["imu"]) == {"FUSED"}
    assert all(v["above_95"] < 0.05 for v in row["nis"].values())


def test_what_the_log_says_reaches_the_estimator(data_dir: Path, tmp_path: Path) -> None:
    """The filter's delay is of the log's INS_GYRO_FILTER, the declination of its COMPASS_DEC."""
    flight = realdata.imported([data_dir / "ardupilot_sitl" / "heave06.BIN"], tmp_path)
    stated = facts(flight)
    assert stated.imu_latency_s == pytest.approx(SITL_LATENCY_S, abs=1e-5)
    assert stated.declination_rad is not None
    assert np.degrees(stated.declination_rad) == pytest.approx(3.02, abs=0.02)
    run = deckfix.replay(flight).run
    assert run.declination_rad == stated.declination_rad


def test_a_merged_log_gives_the_same_flight(data_dir: Path, tmp_path: Path) -> None:
    """The telemetry adds clocks and fixes (not used here), arrives in another order, and ends with a late message."""
    blind = parse_config(flights.WITHOUT_VISION)
    files = [data_dir / "ardupilot_sitl" / f"sea3a{suffix}" for suffix in (".BIN", ".tlog")]
    alone = deckfix.replay(realdata.imported(files[:1], tmp_path), blind).run
    merged = deckfix.replay(realdata.imported(files, tmp_path), blind).run
    assert flights.largest_difference(alone, merged) < 1e-3
    assert merged.imu_outcomes == alone.imu_outcomes == {Outcome.FUSED: sum(alone.imu_outcomes.values())}


@pytest.mark.parametrize("name", realdata.RTK_FLIGHTS)
def test_prediction_between_thinned_rtk_fixes(name: str, data_dir: Path) -> None:
    flight = realdata.read_rtk(data_dir / "quadrotor_rtk" / name)
    mounting = realdata.fit_mounting(flight)
    assert mounting.angle_deg < 2.5
    assert mounting.unexplained < 0.01
    assert abs(mounting.offset_s) <= 0.05
    row = flights.rtk_errors(flight, parse_config(flights.RTK_CONFIG), phases=(0,))
    for axis, share in (("horizontal_m", 0.75), ("height_m", 0.5)):
        for time in ("0.5", "0.7", "0.9"):
            assert row[axis]["ours"][time] < share * row[axis]["line"][time]
            assert row[axis]["ours"][time] < share * row[axis]["held"][time]
    assert row["nees_over_dof"] < 1.3


def test_vibration_without_magnetometer(data_dir: Path) -> None:
    batch = realdata.read_px4_tables(data_dir / "px4_real_flight")
    run = LandingEstimator(Config()).run(batch)
    assert [text for _, text in run.notes] == ["initialised in flight, heading from horizontal acceleration"]
    nis = flights.nis_rows(run)
    assert set(nis) == {"gps_position", "gps_velocity", "barometer"}
    assert all(v["above_95"] < 0.05 for v in nis.values())
    assert 0.7 < nis["barometer"]["mean_over_dof"] < 1.3
    assert nis["barometer"]["inside_95"] > 0.9
    horizontal, vertical = flights.against_gps(run, batch)
    assert np.sqrt(np.mean(horizontal**2)) < 0.2
    assert np.abs(vertical).max() < 1.0


def test_short_px4_logs(data_dir: Path, tmp_path: Path) -> None:
    pytest.importorskip("pyulog")
    started = deckfix.replay(realdata.imported([data_dir / "ulog" / "sample_log_small.ulg"], tmp_path)).run
    assert len(started.t_ns) > 200
    assert np.abs(started.velocity_mps).max() < 0.5  # it stands still
    lacking = realdata.imported([data_dir / "ulog" / "sample_appended_multiple.ulg"], tmp_path)
    run = deckfix.replay(lacking).run
    assert len(run.t_ns) == 0
    assert "GPS" in run.missing
    assert any("no GPS" in problem for problem in lacking.problems)


@pytest.fixture(scope="module")
def pieces(data_dir: Path, tmp_path_factory: pytest.TempPathFactory) -> list[engines.Case]:
    """Return the beginnings of three flights, long enough to start and to fuse everything they have."""
    pytest.importorskip("numba")
    flight = realdata.imported(
        [data_dir / "ardupilot_sitl" / "heave06.BIN"], tmp_path_factory.mktemp("engines")
    )
    rtk = realdata.read_rtk(data_dir / "quadrotor_rtk" / "vertical_path_7")
    px4 = realdata.read_px4_tables(data_dir / "px4_real_flight")
    return [
        ("heave06", engines.beginning(flight.events(), 6.0), facts(flight), Config()),
        ("rtk", rtk.events(), Facts(), parse_config(flights.RTK_CONFIG)),
        ("px4", engines.beginning(px4, 30.0), Facts(), Config()),
    ]


def test_engines_agree(pieces: list[engines.Case]) -> None:
    for case in pieces:
        row = engines.equality(case)
        assert row["estimates"] > 100
        assert row["same_outcomes"]
        assert max(row["state"], row["sigma"], row["covariance"]) <= engines.EQUAL


def test_one_event_at_a_time_gives_the_same_bits(pieces: list[engines.Case]) -> None:
    for engine in ("compiled", "filterpy"):
        assert engines.same_bits(pieces[0], engine)

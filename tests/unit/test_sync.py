"""The latency of vision fixes from a whole flight: found where it can be, and said where it cannot."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from small_flight import deck_recording

from deckfix import sync
from deckfix.cli import main
from deckfix.replaying import facts
from deckfix.sync import KEY_DTYPE, LatencyStatus, Replay, latency_profile, profile_of, rotation_radps
from deckfix.sync_command import digest, with_latency
from estimation.clock import SyncStatus
from estimation.clockbank import ClockSummary
from estimation.config import load_config, parse_config
from estimation.deck import prior_motion
from estimation.estimator import LandingEstimator
from estimation.events import COMPANION, EventBatch, Kind
from logs.reader import open_flight
from logs.writer import FlightWriter
from simulation.flight import SimulatedFlight, parse_scenario, simulate

ROCKED = """
description = "a short flight that rocks over its target"
[plan]
rest_s = 3.0
climb_s = 3.0
leg_s = 3.0
hover_s = 10.0
descent_s = 4.0
deck_s = 0.5
altitude_m = 5.0
start_m = [-3.0, -2.0, -1.0]
legs_m = []
yaw_rad = [0.4, 0.4]
[rock]
start_s = 9.0
duration_s = 10.0
[sea]
beaufort = 2
[streams]
imu = { rate_hz = 100.0 }
barometer = { rate_hz = 5.0 }
magnetometer = { rate_hz = 5.0 }
timesync = { rate_hz = 10.0, delay_s = 0.001 }
vision = { rate_hz = 20.0, delay_s = 0.03, delay_spread_s = 0.005, view = { hidden_s = [[0.0, 9.0], [19.0, 99.0]] } }
[clocks]
autopilot = { offset_s = 12.5 }
companion = { offset_s = 700.0, skew_ppm = 30.0 }
[filter.platform]
use = true
[filter.attitude]
use = "off"
[filter.vision]
latency_s = 0.04
latency_sigma_s = 0.01
floor_m = 0.003
"""


@pytest.fixture(scope="module")
def flight() -> SimulatedFlight:
    return simulate(parse_scenario(ROCKED), 5)


@pytest.fixture(scope="module")
def truth_s(flight: SimulatedFlight) -> float:
    rows = flight.batch.rows
    seen_s = flight.scenario.clocks[COMPANION].true_s(rows["stamp_ns"][rows["kind"] == Kind.VISION])
    return 0.04 + float(flight.slow["camera_latency"].at(seen_s).mean())


@pytest.fixture(scope="module")
def log(flight: SimulatedFlight, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("sync") / "rocked.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(flight.recording())
    return path


def parabolas(
    peaks_s: NDArray[np.float64], sigma_s: float, count: int = 100, floor: float = -np.inf
) -> Replay:
    """A replay whose measurements, in the order of time, each have a parabola about one of the peaks, in turn."""
    keys = np.zeros(count, dtype=KEY_DTYPE)
    keys["stamp_ns"], keys["kind"] = np.arange(count), Kind.VISION
    place = peaks_s[np.arange(count) * len(peaks_s) // count]

    def replay(latency_s: float) -> tuple[NDArray[np.void], NDArray[np.float64]]:
        return keys, np.maximum(-0.5 * ((latency_s - place) / sigma_s) ** 2 / count, floor)

    return replay


@settings(max_examples=12, deadline=None)
@given(peak_ms=st.floats(-29.0, 149.0), sigma_ms=st.floats(0.05, 4.0))
def test_a_parabola_gives_its_peak_and_its_sigma(peak_ms: float, sigma_ms: float) -> None:
    found = profile_of(parabolas(np.array([peak_ms * 1e-3]), sigma_ms * 1e-3), jobs=1)
    assert found.status is LatencyStatus.ESTIMATED, found.reason
    assert found.latency_s * 1e3 == pytest.approx(peak_ms, abs=1e-3)
    assert found.sigma_s * 1e3 == pytest.approx(sigma_ms, rel=1e-3)
    assert found.log_likelihood.max() == 0.0
    assert np.all(np.diff(found.grid_s) > 0.0)


@pytest.mark.parametrize(
    ("least_ms", "status"), [(2.0, LatencyStatus.ESTIMATED), (8.0, LatencyStatus.UNOBSERVABLE)]
)
def test_no_profile_is_surer_than_it_is_told_to_be(least_ms: float, status: LatencyStatus) -> None:
    replay = parabolas(np.array([0.05]), 5e-4)
    found = profile_of(replay, jobs=1, least_sigma_s=least_ms * 1e-3)
    assert found.latency_s == profile_of(replay, jobs=1).latency_s
    assert found.sigma_s == pytest.approx(least_ms * 1e-3)
    assert found.status is status


def test_parts_that_scatter_widen_the_sigma() -> None:
    rng = np.random.default_rng(4)
    peaks = 0.05 + 0.01 * rng.standard_normal(20)
    found = profile_of(parabolas(peaks, 5e-4), jobs=1)
    assert found.latency_s == pytest.approx(peaks.mean(), abs=1e-5)
    assert found.sigma_s == pytest.approx(peaks.std() / np.sqrt(20), rel=1e-3)


@pytest.mark.parametrize(
    ("replay", "status", "reason"),
    [
        (
            parabolas(np.array([0.03, 0.09]), 5e-4),
            LatencyStatus.INCONSISTENT,
            "halves of the flight disagree",
        ),
        (parabolas(np.array([-0.02]), 5e-4), LatencyStatus.ESTIMATED, "below zero"),
        (parabolas(np.array([-0.04]), 5e-4), LatencyStatus.INCONSISTENT, "still rises at the end"),
        (parabolas(np.array([0.17]), 5e-4), LatencyStatus.INCONSISTENT, "still rises at the end"),
        (parabolas(np.array([-0.0005]), 5e-4), LatencyStatus.ESTIMATED, "flight agree"),
        (parabolas(np.array([0.06]), 9e-3), LatencyStatus.UNOBSERVABLE, "turned too little"),
        (parabolas(np.array([0.06]), 1e9), LatencyStatus.UNOBSERVABLE, "turned too little"),
        (parabolas(np.array([0.06]), 5e-4, count=50), LatencyStatus.UNOBSERVABLE, "only 50 fixes"),
    ],
)
def test_what_is_wrong_is_named(replay: Replay, status: LatencyStatus, reason: str) -> None:
    found = profile_of(replay, jobs=1)
    assert (found.status, reason in found.reason) == (status, True), found.reason
    assert ("below zero" in found.reason) == (reason == "below zero")
    assert np.isfinite(found.latency_s)
    assert 0.0 < found.sigma_s < 0.05


def test_a_second_peak_is_a_contradiction() -> None:
    """Half of the measurements, all over the flight, speak for 20 ms and half for 120 ms, each up to a bound."""
    replay = parabolas(np.tile([0.02, 0.12], 40), 1e-3, floor=-0.2)
    found = profile_of(replay, jobs=1)
    assert found.status is LatencyStatus.INCONSISTENT
    assert "second peak" in found.reason


def test_the_latency_is_found_where_the_vehicle_rocks(flight: SimulatedFlight, truth_s: float) -> None:
    found = latency_profile(flight.batch, flight.scenario.config, flight.facts, jobs=1)
    assert found.status is LatencyStatus.ESTIMATED, found.reason
    assert found.sigma_s < 1.5e-3
    assert abs(found.latency_s - truth_s) < 4.0 * found.sigma_s
    assert np.degrees(found.rotation_radps) > 15.0
    assert [c.clock for c in found.clocks] == [COMPANION]
    assert found.clocks[0].skew_ppm == pytest.approx(30.0, abs=4.0 * found.clocks[0].skew_sigma_ppm + 1.0)


def test_a_motion_that_is_known_foresees_the_fixes_better_than_any_sea(flight: SimulatedFlight) -> None:
    c = msgspec.structs.replace
    config = flight.scenario.config
    learning = LandingEstimator(config)
    assert np.array_equal(learning.motion, prior_motion(config.platform))
    learning.run(flight.batch)
    assert not np.array_equal(learning.motion, prior_motion(config.platform))

    def likelihood(motion: tuple[float, ...] | None) -> float:
        held = c(config, platform=c(config.platform, learn_s=0.0, motion=motion))
        estimator = LandingEstimator(held)
        run = estimator.run(flight.batch)
        assert np.array_equal(estimator.motion, prior_motion(held.platform))
        r = run.records[(run.records["sensor"] == run.sensors.index("vision")) & (run.records["dof"] > 0)]
        return -0.5 * float(np.sum(r["nis"] + r["log_det"]))

    known = tuple(learning.motion.tolist())
    assert prior_motion(c(config.platform, motion=known)).tolist() == list(known)
    assert likelihood(known) > likelihood(None) + 5.0


def test_a_shaken_gyro_is_no_rotation(flight: SimulatedFlight) -> None:
    rows = flight.batch.rows.copy()
    imu = rows["kind"] == Kind.IMU
    noise = np.random.default_rng(0).normal(0.0, 0.1, (int(imu.sum()), 3))

    def turning(rates: NDArray[np.float64]) -> float:
        rows["value"][imu, :3] = rates
        return rotation_radps(EventBatch(rows, flight.batch.sensors, flight.batch.clocks))

    turned = flight.batch.rows["value"][imu, :3]
    assert turning(turned + noise) == pytest.approx(turning(turned), rel=0.03)
    assert turning(noise) < 0.035


@pytest.mark.parametrize(
    ("by_arrival", "found_s", "status", "written_s"),
    [
        (False, -0.02, LatencyStatus.ESTIMATED, -0.02),
        (True, -0.02, LatencyStatus.INCONSISTENT, 0.0),
        (True, -0.0005, LatencyStatus.ESTIMATED, 0.0),
    ],
)
def test_no_fix_is_newer_than_its_arrival(
    flight: SimulatedFlight, monkeypatch: pytest.MonkeyPatch,
    by_arrival: bool, found_s: float, status: LatencyStatus, written_s: float,
) -> None:  # fmt: skip
    """A map between clocks can err, so that a latency by the fixes' own stamps may be below zero; an arrival cannot."""
    shown = profile_of(parabolas(np.array([found_s]), 5e-4), jobs=1)
    monkeypatch.setattr(sync, "profile_of", lambda replay, jobs, least_sigma_s: shown)
    config = flight.scenario.config
    found = latency_profile(flight.batch, config, flight.facts, by_arrival=by_arrival)
    assert found.status is status, found.reason
    assert ("their arrival" in found.reason) == (status is LatencyStatus.INCONSISTENT)
    vision = with_latency(config, found).vision
    assert (vision.arrival_latency_s if by_arrival else vision.latency_s) == pytest.approx(
        written_s, abs=1e-6
    )


def test_no_fixes_are_refused(flight: SimulatedFlight) -> None:
    blind = EventBatch(
        flight.batch.rows[flight.batch.rows["kind"] != Kind.VISION], flight.batch.sensors, flight.batch.clocks
    )
    with pytest.raises(ValueError, match="holds no vision fixes"):
        latency_profile(blind, flight.scenario.config)


def test_without_stamps_of_their_own_the_arrival_counts(
    log: Path, truth_s: float, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The way to the log takes 30 ms and, on average, 5 ms more."""
    out = tmp_path / "found.toml"
    assert main(["sync", str(log), "--arrivals", "--jobs", "1", "--json", "-", "--write", str(out)]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["status"] == "estimated"
    assert found["stamps"] == "arrival"
    assert found["latency_ms"] == pytest.approx((truth_s + 0.035) * 1e3, abs=5.0)
    written = load_config(out).vision
    assert written.arrival_latency_s == pytest.approx(found["latency_ms"] * 1e-3, abs=1e-6)
    assert written.arrival_latency_sigma_s == pytest.approx(found["latency_sigma_ms"] * 1e-3, abs=1e-6)
    assert written.latency_s == 0.04


@pytest.mark.parametrize("stamps", ["own", "arrival"])
def test_the_log_says_which_prior_its_fixes_have(tmp_path: Path, stamps: str) -> None:
    recording = deck_recording(1.0)
    next(s for s in recording.series if s.topic == "/vision/fix").metadata["stamps"] = stamps
    with FlightWriter(tmp_path / "f.mcap") as writer:
        writer.write_recording(recording)
    known = facts(open_flight(tmp_path / "f.mcap"))
    assert known.vision_by_arrival == (stamps == "arrival")
    applied = LandingEstimator(
        parse_config("[vision]\narrival_latency_s = 0.07\n"), facts=known
    ).config.vision
    expected = (0.07, 0.05) if stamps == "arrival" else (0.0, 0.02)
    assert (applied.latency_s, applied.latency_sigma_s) == expected


def test_a_vehicle_at_rest_shows_no_latency(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path, config, out = tmp_path / "rest.mcap", tmp_path / "c.toml", tmp_path / "out.toml"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording(12.0))
    config.write_text("[platform]\nuse = true\n")
    arguments = ["sync", str(path), "--config", str(config), "--jobs", "1"]
    assert main([*arguments, "--write", str(config)]) == 1
    assert "is also an input" in capsys.readouterr().err
    assert main([*arguments, "--write", str(out)]) == 1
    said = capsys.readouterr().err
    assert "the latency is unobservable" in said
    assert "rock the vehicle for 20 s" in said
    assert not out.exists()


def test_the_text_says_what_it_means_and_what_to_do() -> None:
    clock = ClockSummary(
        COMPANION, "exchanges", SyncStatus.LOCKED, 5_000_000, 12.5, 0.25, 20_000.0, 60_000.0, 0, 0
    )
    found = replace(profile_of(parabolas(np.array([0.06]), 9e-3), jobs=1), clocks=[clock])
    said = digest(found, "f.mcap", "the default configuration")
    for text in (
        "latency of the vision fixes at their stamp: 60.00 ms, 1-sigma 9.00 ms: unobservable",
        "t_content = map(t_stamp) - latency",
        "rock the vehicle for 20 s by 6 deg",
        "clock companion less the inertial one: 5.000 ± 0.020 ms, skew 12.50 ± 0.25 ppm (from exchanges",
    ):
        assert text in said


def test_bad_input_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sync", str(tmp_path / "none.mcap")]) == 1
    assert capsys.readouterr().err == f"deckfix: {tmp_path / 'none.mcap'}: no such file; check the path\n"
    (tmp_path / "there.toml").write_text("")
    (tmp_path / "some.mcap").write_text("")
    assert main(["sync", str(tmp_path / "some.mcap"), "--write", str(tmp_path / "there.toml")]) == 1
    assert "exists already; use --force to overwrite it" in capsys.readouterr().err

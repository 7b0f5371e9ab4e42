"""Tuning: noises are found again, flights that are held out decide, and what cannot be tuned is said in one line."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from small_flight import small_events, small_log, small_recording

from deckfix import tune as tune_module
from deckfix.cli import main
from deckfix.files import InputError, OutputError
from deckfix.tune import STATE, TuneOptions, _searched, run_tune
from deckfix.tune_objective import FAULTY, PARTS, Refused, Score, Trial, density, score
from deckfix.tune_parameters import DEFAULTS, Parameter, choose, factor_in_words, with_values
from deckfix.tune_search import Search
from estimation.config import Config, dump_config, load_config, parse_config
from estimation.events import Event, EventBatch, GpsVelocity, Kind
from estimation.frames import Array
from estimation.scoring import Place
from logs.events import series_of_batch
from logs.writer import FlightWriter

pytest.importorskip(
    "numba", reason="numba is not installed; the replays of the reference engine are too slow here"
)

TWO = ("gps.velocity_sigma_mps", "barometer.sigma_m")
OPTIONS = TuneOptions(parameters=TWO, starts=1, jobs=1)


def log_of(path: Path, events: list[Event]) -> Path:
    recording = small_recording(1.0, truth=False)
    recording.series = series_of_batch(EventBatch.from_events(events))
    with FlightWriter(path) as writer:
        writer.write_recording(recording)
    return path


def with_speed_noise(factor: float, seed: int) -> list[Event]:
    """The small flight's receiver states a velocity of nothing but noise, 0.1 m/s: here it is scaled."""

    def scaled(e: Event) -> Event:
        if not isinstance(e, GpsVelocity):
            return e
        north, east, down = (factor * v for v in e.velocity_ned_mps)
        return dataclasses.replace(e, velocity_ned_mps=(north, east, down))

    return [scaled(e) for e in small_events(16.0, seed)]


@pytest.fixture(scope="module")
def flights(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    folder = tmp_path_factory.mktemp("flights")
    return [str(small_log(folder / f"f{k}.mcap", 16.0, seed=k)) for k in range(3)]


def test_noises_are_found_again_and_the_file_says_how(flights: list[str], tmp_path: Path) -> None:
    target = tmp_path / "tuned.toml"
    text, written = run_tune(flights[:2], flights[2:], target, OPTIONS)
    assert written
    config = load_config(target)
    assert 0.1 / 1.3 < config.gps.velocity_sigma_mps < 0.1 * 1.3
    assert 0.125 / 1.3 < config.barometer.sigma_m < 0.125 * 1.3
    values = [
        ("gps.velocity_sigma_mps", config.gps.velocity_sigma_mps),
        ("barometer.sigma_m", config.barometer.sigma_m),
    ]
    assert config == with_values(Config(), values)  # nothing else has changed
    head = [line for line in target.read_text().splitlines() if line.startswith("# ")]
    assert head[0].startswith("# Tuned by deckfix ")
    assert "--holdout" in head[0]
    assert sum("sha256" in line for line in head) == 3
    assert "2 of 2 parameters identified" in text
    assert "times smaller (95 %" in text
    assert not target.with_name(target.name + STATE).exists()


@pytest.mark.parametrize("factor", [0.1, 10.0])
def test_starts_that_are_wrong_by_ten_end_at_what_was_drawn(
    factor: float, flights: list[str], tmp_path: Path
) -> None:
    drawn = {"gps.velocity_sigma_mps": 0.1, "gps.position_sigma_m": 0.3, "barometer.sigma_m": 0.125}
    start = tmp_path / "start.toml"
    start.write_text(dump_config(with_values(Config(), [(n, factor * v) for n, v in drawn.items()])))
    options = dataclasses.replace(OPTIONS, config=str(start), parameters=tuple(drawn))
    _, written = run_tune(flights[:1], flights[1:2], tmp_path / "c.toml", options)
    assert written
    config = load_config(tmp_path / "c.toml")
    for name, value in drawn.items():
        table, key = name.split(".")
        assert value / 1.5 < getattr(getattr(config, table), key) < value * 1.5, name


def test_what_is_worse_on_the_flights_held_out_is_not_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    calm = log_of(tmp_path / "calm.mcap", with_speed_noise(0.1, 1))
    rough = log_of(tmp_path / "rough.mcap", with_speed_noise(3.0, 2))
    target = tmp_path / "tuned.toml"
    command = ["tune", str(calm), "--holdout", str(rough), "-o", str(target), "--parameters", TWO[0]]
    assert main([*command, "--starts", "1", "--jobs", "1"]) == 1
    out, err = capsys.readouterr()
    assert err == ""
    assert "not written: the flights that were held out are less likely with it" in out
    assert sorted(p.name for p in tmp_path.iterdir()) == ["calm.mcap", "rough.mcap"]


def test_an_interrupted_tuning_goes_on_where_it_was(
    flights: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole, parts = tmp_path / "c.toml", tmp_path / "parts"
    parts.mkdir()
    calls = 0

    def counted(trial: Trial) -> Score | Refused:
        nonlocal calls
        calls += 1
        if calls == 20:
            raise KeyboardInterrupt
        return score(trial)

    run_tune(flights[:1], [], whole, OPTIONS)
    with monkeypatch.context() as patch:
        patch.setattr(tune_module, "score", counted)
        with pytest.raises(KeyboardInterrupt):
            run_tune(flights[:1], [], parts / "c.toml", OPTIONS)
        kept = (parts / f"c.toml{STATE}").read_text().splitlines()
        assert len(kept) == 19  # a heading, and all replays but the first, which is not of the search
        calls = 1000
        text, _ = run_tune(flights[:1], [], parts / "c.toml", OPTIONS)
    assert "taking up an interrupted tuning: 18 replays are known" in text
    a, b = (p.read_text().splitlines()[1:] for p in (whole, parts / "c.toml"))
    assert a == b


def test_the_workers_of_a_cluster_find_the_same(flights: list[str], tmp_path: Path) -> None:
    distributed = pytest.importorskip("distributed", reason="dask is not installed")
    here, there = tmp_path / "here.toml", tmp_path / "there.toml"
    options = dataclasses.replace(OPTIONS, parameters=TWO[:1])
    run_tune(flights[:2], [], here, options)
    with distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    ) as cluster:
        run_tune(flights[:2], [], there, dataclasses.replace(options, scheduler=cluster.scheduler_address))
    assert here.read_text().splitlines()[1:] == there.read_text().splitlines()[1:]


def test_an_unreachable_scheduler_is_one_line(
    flights: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask is not installed")
    monkeypatch.setattr("deckfix.parallel.CONNECT_S", 1)
    command = ["tune", flights[0], "-o", str(tmp_path / "c.toml"), "--scheduler", "tcp://127.0.0.1:9"]
    assert main(command) == 1
    err = capsys.readouterr().err.splitlines()
    assert err[-1].startswith("deckfix: tcp://127.0.0.1:9: no Dask scheduler answers")


def test_the_state_of_another_tuning_is_not_overwritten(flights: list[str], tmp_path: Path) -> None:
    (tmp_path / f"c.toml{STATE}").write_text("mine\n")
    with pytest.raises(OutputError, match="is left from another tuning"):
        run_tune(flights[:1], [], tmp_path / "c.toml", OPTIONS)
    assert (tmp_path / f"c.toml{STATE}").read_text() == "mine\n"


def test_flights_that_cannot_be_used_are_left_out(flights: list[str], tmp_path: Path) -> None:
    blind = [
        e for e in small_events(16.0) if not isinstance(e, GpsVelocity) and type(e).__name__ != "GpsPosition"
    ]
    lost = str(log_of(tmp_path / "lost.mcap", blind))
    broken = tmp_path / "broken.mcap"
    broken.write_bytes(b"\x89MCAP0\r\n" + bytes(300))
    options = dataclasses.replace(OPTIONS, parameters=TWO[:1])
    text, written = run_tune([flights[0], lost, str(broken)], [], tmp_path / "c.toml", options)
    assert written
    assert [line.split(": it waits")[0] for line in text.splitlines()[:1]] == [
        f"left out: {Path(lost).resolve()}: the filter never starts"
    ]
    assert "broken.mcap" in text.splitlines()[1]
    with pytest.raises(InputError, match="none of the 1 flights can be tuned on"):
        run_tune([lost], [], tmp_path / "d.toml", options)
    with pytest.raises(InputError, match="none of the flights that were to decide can be used"):
        run_tune(flights[:1], [lost], tmp_path / "d.toml", options)


@pytest.mark.parametrize(
    ("extra", "expected"),
    [
        (["--parameters", "gps.velocity"], "no number of the configuration has this name"),
        (["--bounds", "imu.gyro_noise=1"], "cannot be read; write table.key=LOW:HIGH"),
        (["--bounds", "imu.gyro_nois=1:2"], "cannot be read; write table.key=LOW:HIGH"),
        (
            ["--parameters", "barometer.sigma_m", "--bounds", "barometer.sigma_m=2:1"],
            "there is no parameter to tune; barometer.sigma_m is left out: its bounds contradict each other",
        ),
        (["--parameters", "landing.search_s"], "no parameter can be identified from these flights"),
        (["--holdout", "SAME"], "is named twice"),
    ],
)
def test_bad_input_is_one_line(
    extra: list[str], expected: str, flights: list[str], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [flights[0] if w == "SAME" else w for w in extra]
    target = str(tmp_path / "c.toml")
    assert main(["tune", flights[0], "-o", target, "--starts", "1", "--jobs", "1", *words]) == 1
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == 1
    assert expected in lines[0]
    assert not Path(target).exists()


def test_contradictory_bounds_leave_the_rest_to_be_tuned() -> None:
    bounds = (
        "imu.gyro_noise=1e-2:1e-3",
        "imu.accel_noise=1:2",
        "barometer.sigma_m=0.01:3",
        "landing.gear_m=1:2",
    )
    chosen, remarks = choose(Config(), [Kind.BAROMETER], bounds=bounds)
    names = {p.name: p for p in chosen}
    assert "imu.gyro_noise" not in names
    assert "imu.accel_noise" not in names
    assert (names["barometer.sigma_m"].lower, names["barometer.sigma_m"].upper) == (0.01, 3.0)
    assert "imu.accel_noise is left out: it starts from 0.01, outside its bounds 1 to 2" in remarks
    assert "imu.gyro_noise is left out: its bounds contradict each other (0.01 is not below 0.001)" in remarks
    assert "the bounds of landing.gear_m are not used: it is not tuned" in remarks
    assert len(remarks) == 3


def test_defaults_are_numbers_of_the_configuration_that_the_sensors_there_tell_of() -> None:
    every, remarks = choose(Config(), list(Kind), tuple(DEFAULTS))
    assert [p.name for p in every] == list(DEFAULTS)
    assert not remarks
    for p in every:
        assert 0.0 < p.lower < p.start < p.upper
    names = {p.name for p in choose(Config(), [Kind.GPS_VELOCITY])[0]}
    assert "gps.velocity_sigma_mps" in names
    assert "gps.position_sigma_m" not in names
    assert "vision.floor_m" not in names
    assert "vision.floor_m" in {p.name for p in choose(Config(), [Kind.VISION])[0]}
    without = parse_config("[platform]\nuse = false\n")
    assert "vision.floor_m" not in {p.name for p in choose(without, [Kind.VISION])[0]}
    assert "attitude.tilt_sigma_rad" not in {
        p.name for p in choose(Config(), list(Kind))[0]
    }  # only starts from it
    assert factor_in_words(2.0) == "2 times larger"
    assert factor_in_words(0.25) == "4 times smaller"


def test_rejecting_everything_is_not_rewarded(flights: list[str]) -> None:
    base = dump_config(Config())

    def at(sigma: float) -> Score:
        values = (("gps.velocity_sigma_mps", sigma), ("gps.climb_sigma_mps", sigma))
        found = score(Trial(flights[0], base, values, "compiled", 0.0))
        assert isinstance(found, Score)
        return found

    right, proud, timid = at(0.1), at(1e-4), at(10.0)
    assert proud.sensors["gps_velocity"].rejected > 0.5
    assert right.sensors["gps_velocity"].rejected < 0.01
    assert right.log_likelihood > max(proud.log_likelihood, timid.log_likelihood) + 50.0
    assert right.sensors["gps_velocity"].count == proud.sensors["gps_velocity"].count


def test_the_density_is_gaussian_within_hubers_bound_and_falls_slower_beyond() -> None:
    nis, dof, log_det = np.array([1.0, 4.0]), np.array([1, 3]), np.log(np.array([0.25, 0.008]))
    gauss = [
        -0.5 * 1.0 - 0.5 * np.log(2.0 * np.pi * 0.25),
        -0.5 * 4.0 - 0.5 * np.log((2.0 * np.pi) ** 3 * 0.008),
    ]
    assert density(nis, dof, log_det, 3.0) == pytest.approx(gauss)
    far = density(np.array([400.0]), np.array([1]), np.zeros(1), 3.0)[0]
    assert far == pytest.approx(-0.5 * (2.0 * 3.0 * 20.0 - 9.0 + np.log(2.0 * np.pi)), abs=1e-3)
    assert 0.0 < FAULTY < 0.01


def test_the_truth_counts_where_it_is_asked_for(flights: list[str]) -> None:
    base = dump_config(Config())
    without, with_truth = (score(Trial(flights[0], base, (), "compiled", w)) for w in (0.0, 2.0))
    assert isinstance(without, Score)
    assert isinstance(with_truth, Score)
    assert without.truth is None
    assert with_truth.truth is not None
    assert sum(with_truth.parts) == pytest.approx(with_truth.log_likelihood)
    assert with_truth.parts[:-1] == without.parts
    assert len(without.parts) == PARTS
    assert with_truth.log_likelihood == pytest.approx(without.log_likelihood + 2.0 * with_truth.truth)


def test_the_search_finds_noises_and_how_certain_they_are() -> None:
    rng = np.random.default_rng(3)
    true, n = np.array([0.02, 5.0]), 400
    drawn = (true[:, None] * rng.standard_normal((2, n))) ** 2
    squares = drawn.mean(axis=1)
    calls = 0

    def objective(points: Sequence[Array]) -> list[Array]:
        nonlocal calls
        calls += len(points)
        # Two samples of white noise, and a parameter that nothing depends on.
        return [np.hstack([-p[k] - 0.5 * drawn[k] * np.exp(-2.0 * p[k]) for k in range(2)]) for p in points]

    start = np.log([0.2, 0.5, 1.0])
    search = Search(objective, start - np.log(100.0), start + np.log(100.0), start)
    found, certainty = search.certainty(search.run(start))
    assert np.exp(found.point[:2]) == pytest.approx(np.sqrt(squares), rel=0.01)
    assert found.point[2] == pytest.approx(start[2], abs=0.05)
    assert certainty.sigma[:2] == pytest.approx(1.0 / np.sqrt(2.0 * n), rel=0.05)
    assert certainty.identified.tolist() == [True, True, False]
    assert calls == search.evaluations


def test_what_is_put_back_moves_the_others_as_the_curvature_says() -> None:
    rng = np.random.default_rng(8)
    n = 20000
    rows = rng.standard_normal((n, 2)) @ np.array([[0.1, 0.0], [0.0015, 0.01]]).T
    best = np.array([1.0, 0.4])
    noise = rng.standard_normal(n)
    H = rows.T @ rows

    def objective(points: Sequence[Array]) -> list[Array]:
        # A line through points in noise, and a parameter that nothing depends on.
        return [-0.5 * (rows @ (best - p[:2]) + noise) ** 2 for p in points]

    search = Search(objective, np.full(3, -3.0), np.full(3, 3.0), np.zeros(3))
    found, certainty = search.certainty(search.run(np.zeros(3)))
    keep = certainty.identified
    assert keep.tolist() == [True, False, False]
    shift = -found.point
    wanted = -H[0, 1] / H[0, 0] * shift[1]
    assert abs(wanted) > 0.004
    assert certainty.answer(keep, shift) == pytest.approx([wanted], rel=0.15, abs=0.001)
    assert certainty.kept(keep).sigma == pytest.approx([1.0 / np.sqrt(H[0, 0])], rel=0.02)


def test_a_parameter_at_its_bound_is_said_to_be_there() -> None:
    def objective(points: Sequence[Array]) -> list[Array]:
        return [-100.0 * np.array([(p[0] - 5.0) ** 2, p[1] ** 2]) for p in points]

    search = Search(objective, np.full(2, -1.0), np.full(2, 1.0), np.zeros(2))
    found, certainty = search.certainty(search.run(np.array([0.0, 0.5])))
    assert certainty.at_bound.tolist() == [True, False]
    assert certainty.identified.tolist() == [False, True]
    assert found.point == pytest.approx([1.0, 0.0], abs=0.02)


@pytest.mark.parametrize("place", [[0.3, -0.2], [1.0, -0.2], [0.3, -1.0], [1.0, -1.0]])
def test_slopes_are_those_of_the_likelihood_also_on_a_bound(place: list[float]) -> None:
    """Two noises seen together and apart: their slopes and how they answer to each other, against the formulas."""
    rng = np.random.default_rng(4)
    n = 20000
    w = rng.standard_normal((3, n))
    squares = [w[0] ** 2, w[1] ** 2, (w[0] + w[1]) ** 2]

    def variances(p: Array) -> list[Array]:
        a, b = np.exp(2.0 * p[0]), np.exp(2.0 * p[1])
        return [a, b, a + b]

    def objective(points: Sequence[Array]) -> list[Array]:
        return [
            np.sum(
                [-0.5 * np.log(v) - 0.5 * s / v for v, s in zip(variances(p), squares, strict=True)], axis=0
            )
            for p in points
        ]

    search = Search(objective, np.full(2, -1.0), np.full(2, 1.0), np.zeros(2))
    x = np.array(place)
    gradient, H = search._slopes(Place(x, 0.0, objective([x])[0]), np.full(2, 0.05))
    step = 1e-5 * np.eye(2)
    wanted = [-(objective([x + s])[0].sum() - objective([x - s])[0].sum()) / 2e-5 for s in step]
    prior = x / np.log(30.0) ** 2
    inside = np.abs(x) < 1.0
    np.testing.assert_allclose(gradient[inside], (np.array(wanted) + prior)[inside], rtol=0.02)
    # One-sided differences see half a step of the curvature besides.
    np.testing.assert_allclose(gradient, np.array(wanted) + prior, atol=0.03 * float(np.diag(H).max()))
    assert H[0, 1] == H[1, 0]
    assert np.linalg.eigvalsh(H)[0] > 0.0


class _Sample:
    """A sample whose variance is 1 and the square of the first noise; nothing depends on the others."""

    paths = ("a flight",)
    options = TuneOptions(starts=1)

    def __init__(self, first: float) -> None:
        names = ("imu.gyro_noise", "imu.accel_noise", "barometer.sigma_m")
        starts = (first, 2.0, 1.0)
        self.parameters = [
            Parameter(n, s, s / 1000.0, s * 100.0, "-", "") for n, s in zip(names, starts, strict=True)
        ]
        squares = np.random.default_rng(6).standard_normal(400) ** 2
        self.squares = 0.8 * squares / squares.mean()

    def objective(
        self, fixed: tuple[tuple[str, float], ...], free: list[str], points: Sequence[Array]
    ) -> list[Array]:
        out = []
        for p in points:
            values = dict(fixed) | dict(zip(free, np.exp(p), strict=True))
            variance = 1.0 + values["imu.gyro_noise"] ** 2
            out.append(-0.5 * np.log(variance) - 0.5 * self.squares / variance)
        return out


def test_a_noise_of_which_only_a_limit_is_known_is_not_put_back() -> None:
    """The noise hides below a larger one: it may be anything but what it started as."""
    values, certainty, _ = _searched(_Sample(8.0))  # type: ignore[arg-type]
    assert values[0] < 0.5
    assert not certainty.identified[0]
    assert not certainty.at_bound[0]
    assert values[1:] == [2.0, 1.0]


def test_a_noise_that_started_below_its_limit_is_left_where_it_was() -> None:
    with pytest.raises(InputError, match="no parameter can be identified"):
        _searched(_Sample(0.05))  # type: ignore[arg-type]

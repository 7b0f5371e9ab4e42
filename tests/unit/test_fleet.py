"""Fleets: one row a flight, whoever did it and whatever came in between; broken and foreign files told."""

from __future__ import annotations

import csv
import os
import signal
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from small_flight import small_log

from deckfix.cli import main
from deckfix.files import InputError, OutputError
from deckfix.fleet import FleetOptions, columns_of, run_fleet
from deckfix.fleet_row import RowTask, make_row
from deckfix.fleet_sources import FlightFiles, find_flights
from deckfix.parallel import WorkerLost, Workers

SERIAL = FleetOptions(engine="filterpy", reports=False, jobs=1)


def table(folder: Path) -> list[dict[str, str]]:
    with (folder / "flights.csv").open(encoding="utf-8", newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Three flights, two of one name, a broken log, and foreign files."""
    folder = tmp_path_factory.mktemp("fleet") / "logs"
    for place in ("monday", "tuesday"):
        (folder / place).mkdir(parents=True)
    small_log(folder / "monday" / "flight.mcap", 8.0, seed=1)
    small_log(folder / "tuesday" / "flight.mcap", 8.0, seed=2)
    small_log(folder / "tuesday" / "a & <b>.mcap", 8.0, seed=3, truth=False)
    (folder / "tuesday" / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(400))
    (folder / "tuesday" / "empty.BIN").touch()
    (folder / "notes.txt").write_text("windy")
    (folder / "system.log").write_text("no flight log")
    return folder


@pytest.fixture(scope="module")
def serial(logs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    output = tmp_path_factory.mktemp("serial") / "out"
    run_fleet(logs, output, SERIAL)
    return output


def test_every_flight_has_its_row(serial: Path) -> None:
    rows = {r["flight"]: r for r in table(serial)}
    assert list(rows) == [
        "monday/flight.mcap", "tuesday/a & <b>.mcap", "tuesday/broken.mcap", "tuesday/empty.BIN",
        "tuesday/flight.mcap",
    ]  # fmt: skip
    good, bad, empty = (rows[n] for n in ("monday/flight.mcap", "tuesday/broken.mcap", "tuesday/empty.BIN"))
    assert (good["status"], bad["status"], empty["status"]) == ("ok", "error", "error")
    assert "empty" in empty["error"]
    assert bad["error"]
    assert float(good["duration_s"]) == pytest.approx(7.99)
    assert float(good["events.imu.rate_hz"]) == pytest.approx(100.0)
    assert int(good["fusion.gps_position.FUSED_LATE"]) > 10
    assert 0.3 < float(good["nis.barometer.mean_over_dof"]) < 3.0
    assert float(good["truth.odometry.position_rmse_m.north"]) < 1.0
    assert rows["tuesday/a & <b>.mcap"]["truth.odometry.position_rmse_m.north"] == ""
    # The two of one name are two flights.
    assert good["nis.barometer.mean_over_dof"] != rows["tuesday/flight.mcap"]["nis.barometer.mean_over_dof"]


def test_foreign_files_are_said_and_skipped(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert (
        main(
            [
                "fleet",
                str(logs),
                "-o",
                str(tmp_path / "o"),
                "--no-reports",
                "--engine",
                "filterpy",
                "--jobs",
                "1",
            ]
        )
        == 0
    )
    out, err = capsys.readouterr()
    assert err == ""
    assert "left out notes.txt" in out
    assert "left out system.log" in out
    assert "empty.BIN: the file is empty" in out
    page = (tmp_path / "o" / "index.html").read_text()
    assert "a &amp; &lt;b&gt;.mcap" in page
    assert "<b>.mcap" not in page


def test_unchanged_rows_are_not_run_again(logs: Path, tmp_path: Path) -> None:
    small_log(tmp_path / "in.mcap", 6.0)
    (tmp_path / "in").mkdir()
    one, other = tmp_path / "in" / "one.mcap", tmp_path / "in" / "other.mcap"
    small_log(one, 6.0, seed=1)
    small_log(other, 6.0, seed=2)
    output = tmp_path / "in" / "results"  # below the folder itself: its files are no flights
    assert "2 replayed, 0 unchanged" in run_fleet(tmp_path / "in", output, SERIAL)
    first = (output / "flights.csv").read_bytes()
    assert "0 replayed, 2 unchanged" in run_fleet(tmp_path / "in", output, SERIAL)
    assert (output / "flights.csv").read_bytes() == first
    other.unlink()
    small_log(other, 6.5, seed=3)
    assert "1 replayed, 1 unchanged" in run_fleet(tmp_path / "in", output, SERIAL)
    assert (output / "flights.csv").read_bytes() != first
    config = tmp_path / "c.toml"
    config.write_text("[barometer]\nuse = false\n")
    changed = FleetOptions(str(config), "filterpy", False, 1)
    assert "2 replayed" in run_fleet(tmp_path / "in", output, changed)
    assert "nis.barometer.mean_over_dof" not in table(output)[0]
    # An interruption: rows that are there stay, half a row is none.
    next(iter((output / "rows").iterdir())).write_text('{"key": ')
    assert "1 replayed, 1 unchanged" in run_fleet(tmp_path / "in", output, changed)


def test_reports_are_linked_and_made_again_where_they_are_gone(tmp_path: Path) -> None:
    (tmp_path / "in").mkdir()
    small_log(tmp_path / "in" / "one 100%#?.mcap", 6.0)
    options = FleetOptions(engine="filterpy", jobs=1)
    run_fleet(tmp_path / "in", tmp_path / "out", options)
    (report,) = (tmp_path / "out" / "reports").iterdir()
    assert f'href="reports/{report.name}"' in (tmp_path / "out" / "index.html").read_text()
    report.unlink()
    assert "1 replayed" in run_fleet(tmp_path / "in", tmp_path / "out", options)
    assert report.is_file()


def test_foreign_results_are_not_overwritten(logs: Path, tmp_path: Path) -> None:
    (tmp_path / "flights.csv").write_text("mine")
    with pytest.raises(OutputError, match="--force"):
        run_fleet(logs, tmp_path, SERIAL)
    assert (tmp_path / "flights.csv").read_text() == "mine"


def test_a_log_and_its_import_and_its_estimates_are_one_flight(tmp_path: Path) -> None:
    import deckfix

    source = small_log(tmp_path / "flight.mcap", 6.0)
    deckfix.replay(source, engine="filterpy").write(tmp_path / "estimate.mcap")
    found = find_flights(tmp_path)
    assert [f.name for f in found.flights] == ["flight.mcap"]
    assert found.skipped == (("estimate.mcap", "holds the estimates of flight.mcap, which is taken"),)


def test_files_of_one_flight_are_joined_by_name(tmp_path: Path) -> None:
    for name in ("a.BIN", "a.tlog", "b.tlog", "c.ulg", "c.BIN", "c.tlog"):
        (tmp_path / name).write_bytes(b"")
    assert [[p.name for p in f.paths] for f in find_flights(tmp_path).flights] == [
        ["a.BIN", "a.tlog"], ["b.tlog"], ["c.BIN"], ["c.tlog"], ["c.ulg"],
    ]  # fmt: skip


def test_parallel_rows_are_the_serial_ones(logs: Path, serial: Path, tmp_path: Path) -> None:
    run_fleet(logs, tmp_path / "out", FleetOptions(engine="filterpy", reports=False, jobs=2))
    for name in ("flights.csv", "index.html"):
        assert (tmp_path / "out" / name).read_bytes() == (serial / name).read_bytes()


def test_an_unreachable_scheduler_is_one_line(
    logs: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed", reason="dask is not installed")
    monkeypatch.setattr("deckfix.parallel.CONNECT_S", 1)
    code = main(
        ["fleet", str(logs), "-o", str(tmp_path / "o"), "--no-reports", "--scheduler", "tcp://127.0.0.1:9"]
    )
    err = capsys.readouterr().err.splitlines()
    assert code == 1
    assert err[-1].startswith("deckfix: tcp://127.0.0.1:9: no Dask scheduler answers")


def test_a_cluster_gives_the_same_table_though_a_worker_is_killed(
    logs: Path, serial: Path, tmp_path: Path
) -> None:
    distributed = pytest.importorskip("distributed", reason="dask is not installed")
    cluster = distributed.LocalCluster(
        n_workers=2, threads_per_worker=1, processes=True, host="127.0.0.1", dashboard_address=None
    )
    output, killed = tmp_path / "out", threading.Event()

    def kill() -> None:
        while not (output / "rows").is_dir() or not any((output / "rows").iterdir()):
            time.sleep(0.01)
        os.kill(next(iter(cluster.workers.values())).process.pid, signal.SIGKILL)
        killed.set()

    with cluster:
        hunter = threading.Thread(target=kill, daemon=True)
        hunter.start()
        run_fleet(logs, output, FleetOptions(None, "filterpy", False, scheduler=cluster.scheduler_address))
        assert killed.wait(10.0)
    assert (output / "flights.csv").read_bytes() == (serial / "flights.csv").read_bytes()


def test_a_task_that_kills_its_process_takes_no_other_with_it() -> None:
    with Workers(2) as workers:
        answers = dict(workers.each(_ends_its_process, [1, -1, 2, 3]))
    assert isinstance(answers.pop(1), WorkerLost)
    assert answers == {0: 1, 2: 4, 3: 9}


def _ends_its_process(x: int) -> int:
    if x < 0:
        os.kill(os.getpid(), signal.SIGKILL)
    return x * x


def test_a_folder_without_flights(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no flight log"):
        run_fleet(tmp_path, tmp_path / "out", SERIAL)
    with pytest.raises(InputError, match="no such folder"):
        run_fleet(tmp_path / "nowhere", tmp_path / "out", SERIAL)


def test_columns_do_not_depend_on_the_order_of_rows() -> None:
    rows: list[dict[str, Any]] = [
        {"flight": "a", "nis.x": 1.0, "zzz": 1},
        {"flight": "b", "events.y.rate_hz": 2.0},
    ]
    assert columns_of(rows) == columns_of(rows[::-1])
    assert columns_of(rows)[0] == "flight"


def test_an_unexpected_error_is_a_row(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    log = small_log(tmp_path / "x.mcap", 2.0)
    monkeypatch.setattr("deckfix.replaying.replay", lambda *_, **__: 1 / 0)
    row = make_row(RowTask(FlightFiles("x.mcap", (log,)), None, "filterpy", None))
    assert row["status"] == "error"
    assert "ZeroDivisionError" in row["error"]

"""The command line: quick help, one-line errors, exit codes, and files that are whole or absent."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
from small_flight import small_log

from deckfix.cli import main

HEAVY = ("filterpy", "scipy", "numba", "plotly", "matplotlib", "cv2", "pymavlink", "pandas", "rich", "numpy")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return small_log(tmp_path_factory.mktemp("logs") / "flight.mcap")


def failure(capsys: pytest.CaptureFixture[str], *arguments: str) -> tuple[int, str]:
    """Run a command that fails and return its exit code and its one line on stderr."""
    code = main(arguments)
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("deckfix: ")
    assert err.count("\n") == 1
    assert "Traceback" not in err
    assert "internal error" not in err
    return code, err


@pytest.mark.parametrize(
    "command", [[], ["import"], ["info"], ["replay"], ["report"], ["export"], ["doctor"], ["sync"]]
)
def test_help_loads_nothing_heavy(command: list[str]) -> None:
    code = (
        "import sys\nfrom deckfix.cli import main\n"
        f"code = main([*{command!r}, '--help'])\n"
        f"print('LOADED', code, [m for m in {HEAVY!r} if m in sys.modules])"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert "Usage: deckfix" in done.stdout
    assert done.stdout.splitlines()[-1] == "LOADED 0 []"


def test_the_package_itself_loads_nothing_heavy() -> None:
    code = f"import sys, deckfix; print(deckfix.__version__, [m for m in {HEAVY!r} if m in sys.modules])"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert done.stdout.split(maxsplit=1)[1].strip() == "[]"


@pytest.mark.parametrize(
    "arguments",
    [
        ["replay"],
        ["replay", "a.mcap", "--engine", "fast"],
        ["nonsense"],
        ["export", "a.mcap"],
        ["info", "a", "b"],
    ],
)
def test_wrong_usage_is_2(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> None:
    code, err = failure(capsys, *arguments)
    assert code == 2
    assert "--help" in err


@pytest.mark.parametrize("command", ["info", "replay", "report", "export", "recover", "import"])
def test_bad_files_are_1_with_a_remedy(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, command: str
) -> None:
    output = [] if command in ("info", "replay") else ["-o", str(tmp_path / "out")]
    (tmp_path / "empty").touch()
    (tmp_path / "foreign").write_bytes(b"%PDF-1.4 not a flight log\n" * 50)
    (tmp_path / "folder").mkdir()
    for name in ("missing", "empty", "foreign", "folder"):
        code, err = failure(capsys, command, str(tmp_path / name), *output)
        assert code == 1
        assert str(tmp_path / name) in err
        assert ";" in err
    assert sorted(p.name for p in tmp_path.iterdir() if p.name.startswith((".", "out")) and p.is_file()) == []


def test_replay_writes_what_was_asked_for(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path
) -> None:
    out, page, summary = (str(tmp_path / n) for n in ("out.mcap", "r.html", "s.json"))
    arguments = ["replay", str(log), "-o", out, "--report", page, "--json", summary, "--engine", "filterpy"]
    assert main(arguments) == 0
    said = capsys.readouterr().out
    assert "estimates" in said
    assert "over the autopilot's own:" in said
    document = json.loads(Path(summary).read_text())
    assert document["engine"] == "filterpy"
    assert Path(page).read_text().startswith("<!DOCTYPE html>")
    assert main(["info", out]) == 0
    listing = capsys.readouterr().out
    assert "/estimate/odometry" in listing
    assert "no problems found" in listing
    code, err = failure(capsys, *arguments)
    assert code == 1
    assert "use --force" in err
    assert main([*arguments, "--force"]) == 0


def test_check_demands_equal_bytes_and_compares_with_the_record(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path
) -> None:
    out = str(tmp_path / "out.mcap")
    assert main(["replay", str(log), "-o", out, "--engine", "filterpy"]) == 0
    assert main(["replay", out, "--check", "--engine", "filterpy"]) == 0
    said = capsys.readouterr().out
    assert "two replays gave equal files" in said
    assert "estimates and records in the log" in said
    other = tmp_path / "other.toml"
    other.write_text("[gps]\nlatency_s = 0.2\n")
    assert main(["replay", out, "--check", "--engine", "filterpy", "--config", str(other)]) == 1
    assert "check FAILED: /estimate/odometry, /estimate/state, /fusion" in capsys.readouterr().out


def test_json_can_go_to_standard_output(capsys: pytest.CaptureFixture[str], log: Path) -> None:
    assert main(["replay", str(log), "--json", "-", "--engine", "filterpy"]) == 0
    assert json.loads(capsys.readouterr().out)["flight"] == "flight.mcap"


def test_an_unknown_key_is_refused_with_the_nearest(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path
) -> None:
    config = tmp_path / "c.toml"
    config.write_text("[gps]\nlatensy_s = 0.1\n")
    code, err = failure(capsys, "replay", str(log), "--config", str(config))
    assert code == 1
    assert str(config) in err
    assert "latency_s" in err


def test_the_same_output_twice_is_refused(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path
) -> None:
    same = str(tmp_path / "x")
    code, err = failure(capsys, "replay", str(log), "-o", same, "--json", same)
    assert code == 1
    assert "two outputs" in err
    assert failure(capsys, "replay", str(log), "-o", str(log), "--force")[0] == 1


def test_report_of_a_log(capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path) -> None:
    page = tmp_path / "r.html"
    assert main(["report", str(log), "-o", str(page), "--engine", "filterpy"]) == 0
    assert "wrote" in capsys.readouterr().out
    assert page.read_text().count("<section") == 8


@pytest.mark.parametrize("kind", ["csv", "npz"])
def test_export_gives_the_numbers_back(
    capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path, kind: str
) -> None:
    folder = tmp_path / "tables"
    assert main(["export", str(log), "-o", str(folder), "--format", kind]) == 0
    capsys.readouterr()
    import deckfix

    series = deckfix.open(log).series("/imu")[0]
    path = folder / f"imu.{kind}"
    if kind == "csv":
        table = np.genfromtxt(path, delimiter=",", names=True)
        force, stamps = table["linear_acceleration_z"], [int(x.split(",")[0]) for x in _rows(path)]
    else:
        with np.load(path) as file:
            force, stamps = file["linear_acceleration_z"], file["stamp_ns"].tolist()
    assert np.array_equal(force, series.data["linear_acceleration"][:, 2])
    assert stamps == series.stamp_ns.tolist()
    assert failure(capsys, "export", str(log), "-o", str(folder), "--format", kind)[0] == 1
    code, err = failure(capsys, "export", str(log), "-o", str(tmp_path / "t"), "--topic", "/none")
    assert code == 1
    assert "/imu" in err


def _rows(path: Path) -> list[str]:
    return path.read_text().splitlines()[1:]


def test_recover_says_what_was_lost(capsys: pytest.CaptureFixture[str], tmp_path: Path, log: Path) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * 2 // 3])
    whole = tmp_path / "whole.mcap"
    assert main(["recover", str(cut), "-o", str(whole)]) == 0
    assert "messages" in capsys.readouterr().out
    assert main(["info", str(whole)]) == 0


def test_a_truncated_log_is_replayed_and_the_loss_is_told(
    capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    whole = small_log(tmp_path / "whole.mcap", seconds=30.0)
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size * 3 // 4])
    code = main(["replay", str(cut), "--engine", "filterpy"])
    out, err = capsys.readouterr()
    if code == 0:
        assert "warning" in out
    else:
        assert err.count("\n") == 1


def test_an_error_nobody_expected_is_one_line(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    import deckfix.doctor

    def broken() -> None:
        raise RuntimeError("two\nlines")

    monkeypatch.setattr(deckfix.doctor, "examine", broken)
    assert main(["doctor"]) == 1
    err = capsys.readouterr().err
    assert err.startswith("deckfix: internal error (RuntimeError: two lines); please report it")
    assert err.count("\n") == 1


def test_ctrl_c_leaves_no_half_file(tmp_path: Path, log: Path) -> None:
    out = tmp_path / "out.mcap"
    code = (
        "import signal, sys, deckfix.estimate_log as e\nfrom deckfix.cli import main\n"
        "signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored in a shell's background job\n"
        "def wait(*_, **__):\n    print('writing', flush=True)\n    import time; time.sleep(60)\n"
        "e.copy_source = wait\n"
        f"sys.exit(main(['replay', {str(log)!r}, '-o', {str(out)!r}, '--engine', 'filterpy']))"
    )
    for number, expected in ((signal.SIGINT, 130), (signal.SIGTERM, 143)):
        child = subprocess.Popen(
            [sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
        )
        assert child.stdout is not None
        assert child.stdout.readline() == "writing\n"
        time.sleep(0.1)
        assert list(tmp_path.iterdir()) != []
        child.send_signal(number)
        _, err = child.communicate(timeout=60)
        assert child.returncode == expected
        assert "Traceback" not in err
        assert list(tmp_path.iterdir()) == []
        if number is signal.SIGINT:
            assert err.strip().startswith("deckfix: interrupted")


def test_a_closed_pipe_is_quiet(log: Path) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "deckfix.cli", "info", str(log)],
        stdout=write, stderr=subprocess.PIPE, text=True, timeout=60, check=False,
    )  # fmt: skip
    os.close(write)
    assert done.stderr == ""


def test_doctor_finds_this_installation_well(capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["doctor"])
    out = capsys.readouterr().out
    assert code == 0, out
    assert out.splitlines()[-1] == "all is well"


def test_doctor_sees_a_shadowed_package(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    (tmp_path / "logs" / "__init__.py").touch()
    code = "import sys; sys.path.insert(0, '.')\nfrom deckfix.doctor import examine\nprint(*examine())"
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True, timeout=60, check=True
    )
    assert f"WRONG logs: is shadowed by {tmp_path / 'logs'}" in done.stdout
    assert done.stdout.strip().endswith("False")

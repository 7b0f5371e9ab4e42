"""``deckfix heave``: series of every shape are read or refused in one line; what comes out is told and drawn."""

from __future__ import annotations

import gzip
import json
import re
from pathlib import Path

import numpy as np
import pytest
from small_flight import HEAVE_S, deck_recording, small_log

from deckfix.cli import main
from deckfix.files import InputError
from deckfix.heave_series import Choice, read_series
from logs.writer import FlightWriter

PERIOD_S, AMPLITUDE_M = 4.0, 0.5


def wave(seconds: float = 60.0, hz: float = 5.0, noise_m: float = 0.01) -> tuple[np.ndarray, np.ndarray]:
    t = np.arange(0.0, seconds, 1.0 / hz)
    rng = np.random.default_rng(3)
    return t, AMPLITUDE_M * np.sin(2.0 * np.pi * t / PERIOD_S) + rng.normal(size=len(t)) * noise_m


def table(path: Path, header: str | None, *columns: np.ndarray, delimiter: str = ",") -> Path:
    lines = [] if header is None else [header]
    lines += [delimiter.join(f"{v:.6g}" for v in row) for row in zip(*columns, strict=True)]
    path.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("header", "delimiter", "scale"),
    [
        ("time,heave", ",", 1.0),
        ("t;z", ";", 1.0),
        ("Time [s]\tHeave [cm]", "\t", 100.0),
        ("boot_time_s,deck_up_m", ",", 1.0),
        ("seconds heave_mm", " ", 1000.0),
        (None, ",", 1.0),
        (None, " ", 1.0),
    ],
)
def test_names_units_and_delimiters_are_found(
    tmp_path: Path, header: str | None, delimiter: str, scale: float
) -> None:
    t, z = wave()
    series = read_series(table(tmp_path / "s.csv", header, t, scale * z, delimiter=delimiter))
    assert series.t_s == pytest.approx(t, abs=1e-4)
    assert series.heave_m == pytest.approx(z, abs=1e-4)
    assert not series.given_sigma


def test_sigma_rate_columns_dates_and_gzip(tmp_path: Path) -> None:
    t, z = wave()
    own = np.full(len(t), 0.02)
    series = read_series(table(tmp_path / "a.csv", "time,heave,sigma", t, z, own))
    assert series.given_sigma
    assert series.sigma_m == pytest.approx(own)
    assert read_series(table(tmp_path / "b.csv", None, t, z, own)).sigma_m == pytest.approx(own)
    raw = table(tmp_path / "c.raw", None, 0 * t, 100 * z, z, z)
    series = read_series(raw, Choice(heave="2", rate_hz=5.0, unit="cm", sigma="0.03"))
    assert series.heave_m == pytest.approx(z, abs=1e-4)
    assert series.t_s == pytest.approx(t)
    assert np.all(series.sigma_m == 0.03)
    packed = tmp_path / "d.csv.gz"
    packed.write_bytes(gzip.compress((tmp_path / "a.csv").read_bytes()))
    assert len(read_series(packed).t_s) == len(t)
    dated = tmp_path / "e.csv"
    dated.write_text(
        "when,elevation\n" + "".join(f"2026-06-01T10:00:{k:02d}Z,{0.1 * k}\n" for k in range(30)),
        encoding="utf-8",
    )
    assert read_series(dated, Choice(time="when")).t_s.tolist() == list(range(30))
    comma = tmp_path / "f.csv"
    comma.write_text("# a buoy\ntime;heave\n0,0;0,25\n0,5;-0,5\n", encoding="utf-8")
    assert read_series(comma).heave_m.tolist() == [0.25, -0.5]


def test_gaps_and_nan_are_counted_not_hidden(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    t, z = wave()
    z[10:13] = np.nan
    keep = (t < 30.0) | (t > 36.0)
    path = table(tmp_path / "gaps.csv", "time,heave", t[keep], z[keep])
    series = read_series(path)
    assert len(series.gaps) == 1
    assert series.gaps[0] == pytest.approx(6.4, abs=0.01)
    assert main(["heave", str(path)]) == 0
    said = capsys.readouterr().out
    assert "3 not finite" in said
    assert "1 gap, the longest 6.4 s" in said


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"", "holds no line of numbers"),
        (b"time,heave\n", "holds a header, but no sample"),
        (b"time,heave\n1,nan\n2,nan\n", "no row has a finite time and heave"),
        (b"time,heave\n1,0.1\n0.5,0.2\n", "time goes back"),
        (b"time,speed\n1,0.1\n2,0.2\n", "cannot tell which column is the heave"),
        (b"heave\n0.1\n0.2\n", "cannot tell which column is the time"),
        (b"1,2,3,4\n2,3,4,5\n", "cannot tell which column is the heave"),
        (b"time,heave [furlong]\n1,0.1\n2,0.2\n", "unit 'furlong'"),
        (b"\x00\x01\x02binary", "neither an MCAP log nor text"),
        (b"\x1f\x8bnot gzip", "cannot be read"),
    ],
)
def test_a_bad_series_is_one_line(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], content: bytes, problem: str
) -> None:
    path = tmp_path / "bad.csv"
    path.write_bytes(content)
    assert main(["heave", str(path)]) == 1
    said = capsys.readouterr().err
    assert said.count("\n") == 1
    assert said.startswith(f"deckfix: {path}: ")
    assert problem in said


@pytest.mark.parametrize(
    "arguments",
    [["--rate", "0"], ["--window", "-1"], ["--longest", "1"], ["--config", "c.toml"], ["--rate", "nan"]],
)
def test_a_wrong_command_line_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], arguments: list[str]
) -> None:
    path = table(tmp_path / "s.csv", "time,heave", *wave(10.0))
    assert main(["heave", str(path), *arguments]) == 2
    assert "heave --help" in capsys.readouterr().err


@pytest.mark.parametrize(("column", "problem"), [("nothing", "no column 'nothing'"), ("7", "no column '7'")])
def test_a_column_that_is_not_there_is_named(tmp_path: Path, column: str, problem: str) -> None:
    path = table(tmp_path / "s.csv", "time,heave", *wave(10.0))
    with pytest.raises(InputError, match=re.escape(problem)):
        read_series(path, Choice(heave=column))


def test_one_sample_and_no_motion_fall_back_and_say_so(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    one = tmp_path / "one.csv"
    one.write_text("time,heave\n0,0.25\n", encoding="utf-8")
    assert main(["heave", str(one), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["method"] == "mean"
    assert told["reason"] == "one sample only"
    assert told["ahead"][2]["heave_m"] == pytest.approx(0.25)
    assert told["ahead"][2]["sigma_m"] is None
    assert told["ahead"][2]["fallback"] is True
    t, _ = wave()
    still = table(tmp_path / "still.csv", "time,heave", t, 0 * t + 1.5)
    assert main(["heave", str(still)]) == 0
    assert "level +1.500 m" in capsys.readouterr().out


def test_a_series_is_told_drawn_and_scored(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path / "wave.csv", "time,heave,sigma", *wave(), np.full(300, 0.01))
    page, summary = tmp_path / "page.html", tmp_path / "s.json"
    assert main(["heave", str(path), "-o", str(page), "--json", str(summary), "--window", "30"]) == 0
    said = capsys.readouterr().out
    assert f"wrote {page}" in said
    assert "the whole series: Hs" in said
    told = json.loads(summary.read_text(encoding="utf-8"))
    assert told["dominant_period_s"] == pytest.approx(PERIOD_S, rel=0.01)
    assert told["hs_m"] == pytest.approx(4.0 * AMPLITUDE_M / np.sqrt(2.0), rel=0.1)
    assert told["whole"]["hs_m"] == pytest.approx(told["hs_m"], rel=0.1)
    assert told["forecast"]["against"] == "series"
    one = told["forecast"]["horizons"]["1"]
    assert one["rmse_m"] < 0.2 * one["level_rmse_m"]
    total = sum(a * np.sin(phase) for a, _, phase in told["components"]) + told["level_m"]
    assert total == pytest.approx(told["ahead"][0]["heave_m"], abs=1e-6)
    html = page.read_text(encoding="utf-8")
    assert html.count('<div class="plot"') == 4
    assert "default-src 'none'" in html
    assert main(["heave", str(path), "-o", str(page)]) == 1
    assert "exists already" in capsys.readouterr().err


def test_plain_sinusoids_give_the_seeds_form(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = table(tmp_path / "wave.csv", "time,heave", *wave())
    assert main(["heave", str(path), "--method", "sinusoids", "--components", "1", "--json", "-"]) == 0
    amplitude, period, _ = json.loads(capsys.readouterr().out)["components"][0]
    assert amplitude == pytest.approx(AMPLITUDE_M, abs=0.01)
    assert period == pytest.approx(PERIOD_S, rel=1e-3)


def test_hostile_names_stay_text(tmp_path: Path) -> None:
    path = table(tmp_path / "<img src=x>.csv", "time,heave", *wave(30.0))
    page = tmp_path / "page.html"
    assert main(["heave", str(path), "-o", str(page)]) == 0
    assert "<img" not in page.read_text(encoding="utf-8").replace("&lt;img", "")


def test_a_flight_shows_its_platform(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "deck.mcap"
    with FlightWriter(path) as writer:
        writer.write_recording(deck_recording())
    page = tmp_path / "page.html"
    assert main(["heave", str(path), "-o", str(page), "--json", "-"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["dominant_period_s"] == pytest.approx(HEAVE_S, rel=0.05)
    assert len(told["components"]) > 10
    assert [a["horizon_s"] for a in told["ahead"]] == [0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 5.0]
    assert '<section id="heave">' in page.read_text(encoding="utf-8")
    assert main(["heave", str(path), "--rate", "5"]) == 2


def test_a_flight_without_fixes_is_one_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["heave", str(small_log(tmp_path / "bare.mcap"))]) == 1
    said = capsys.readouterr().err
    assert "no vision fix of a platform could be fused" in said
    assert said.count("\n") == 1

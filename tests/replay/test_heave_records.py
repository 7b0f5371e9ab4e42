"""Heave on real records: the buoy's own statistics, and a floating section of known period."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from deckfix.cli import main
from estimation import heave

Array = NDArray[np.float64]


def buoy(path: Path) -> Array:
    rows = np.loadtxt(path, delimiter=",")
    return np.asarray(rows[rows[:, 0] == 0, 1] / 100.0, np.float64)


def test_learned_spectra_agree_with_the_buoys_own_statistics(data_dir: Path) -> None:
    """Hs and Tp from two-minute windows, averaged over each half-hour, against Datawell's own."""
    folder = data_dir / "waverider"
    with (folder / "buoy_2005-07.hiw").open() as lines:
        waves = {row[0][:13]: row for row in csv.reader(lines) if row[0][14:16] < "15"}
    with (folder / "buoy_2005-07.his").open() as lines:
        spectra = {row[0][:13]: row for row in csv.reader(lines) if row[0][14:16] < "30"}
    ratio_height, ratio_period = [], []
    for path in sorted(folder.glob("*.raw"))[::4]:
        key = path.stem.removeprefix("buoy_").replace("h00Z", "")
        value = buoy(path)
        t = np.arange(len(value)) / 1.28
        height, period = [], []
        for start in range(0, len(value) - 150, 300):
            model = heave.fit(t[start : start + 150], value[start : start + 150], 0.02)
            height.append(model.hs_m)
            period.append(model.tp_s)
        ratio_height.append(np.sqrt(np.mean(np.square(height))) / (float(waves[key][6]) / 100.0))
        ratio_period.append(np.median(period) / float(spectra[key][1]))
    assert np.mean(ratio_height) == pytest.approx(1.05, abs=0.12), "H1/3 of waves is about 0.95 of 4 sd"
    assert np.mean(ratio_period) == pytest.approx(1.0, abs=0.15)


def test_period_of_a_floating_section(data_dir: Path) -> None:
    """A freely floating ship section in regular waves of 1.16 s, slowly drifting: millimetres seen by a camera.

    Motion below 0.3 Hz is left to the drift. The stated sigma is too small, and is found to be.
    """
    path = data_dir / "ship_section" / "3061_1.csv.gz"
    t, value = np.genfromtxt(path, delimiter=",", skip_header=1, usecols=(0, 7))[::10].T
    settings = heave.SpectrumSettings(lowest_hz=0.3)
    for end in (900, 1100, 1200):
        seen = slice(end - 400, end)
        model = heave.fit(t[seen], value[seen], 0.0005, settings=settings)
        assert model.dominant_period_s == pytest.approx(1.16, rel=0.02)
        assert 1.5 < model.noise_scale < 4.0


def test_the_command_gives_the_buoys_own_height_and_period(data_dir: Path, tmp_path: Path) -> None:
    """Three half-hours against Datawell's own spectra, whose half-hours are not quite the same: the mean of Hs over
    Hm0 within 5 %, each peak period (theirs is one bin of a raw spectrum) within 20 %."""
    folder = data_dir / "waverider"
    with (folder / "buoy_2005-07.his").open() as lines:
        spectra = list(csv.reader(lines))
    ratios = []
    for hour in ("02", "06", "10"):
        summary = tmp_path / f"{hour}.json"
        record = folder / f"buoy_2005-07-01T{hour}h00Z.raw"
        told = ["--rate", "1.28", "--heave", "2", "--unit", "cm", "--json", str(summary)]
        assert main(["heave", str(record), *told]) == 0
        whole = json.loads(summary.read_text(encoding="utf-8"))["whole"]
        datawell = next(row for row in spectra if row[0] >= f"2005-07-01T{hour}:00")
        ratios.append(whole["hs_m"] / (float(datawell[5]) / 100.0))
        assert whole["tp_s"] == pytest.approx(float(datawell[1]), rel=0.20)
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.05)

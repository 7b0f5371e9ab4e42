"""The clock map on the exchanges of a recorded flight, against the true pairs of clock readings."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from estimation.clock import SyncStatus
from estimation.clockbank import ClockBank
from estimation.events import TimeSync
from logs.importer import import_files


def test_companion_stamps_of_a_recorded_flight(data_dir: Path) -> None:
    """Stamps are mapped as they came, without looking ahead.

    The mid-point of this link's exchanges is about 10 ms behind the true pair, which no map can see, and its
    clock wanders in irregular steps; the map must add little of its own.
    """
    folder = data_dir / "ardupilot_sitl"
    (series,) = import_files([folder / "sea3a.tlog"]).find("/timesync")
    captures = np.genfromtxt(folder / "sea3a.vis.csv", delimiter=",", names=True)
    bank = ClockBank()
    rows = iter(series.data)
    row = next(rows, None)
    errors, last_ns = [], 0
    for capture in captures:
        stamp = round(capture["capture_mono_us"]) * 1000
        while row is not None and row["received_ns"] <= stamp:
            event = TimeSync(
                int(row["sent_ns"]), int(row["remote_ns"]), int(row["received_ns"]), int(row["received_ns"])
            )
            assert bank.exchange(event).step_ns == 0
            row = next(rows, None)
        reading = bank.convert("companion", stamp)
        assert reading is not None
        last_ns = reading.time_ns
        errors.append(reading.time_ns / 1e6 - capture["capture_boot_us"] / 1e3)
    assert -12.0 < np.median(errors) < -7.0
    assert np.percentile(np.abs(errors - np.median(errors)), 90) < 2.0
    (clock,) = bank.summary(last_ns)
    assert clock.clock == "companion"
    assert clock.status in {SyncStatus.LOCKED, SyncStatus.SUSPECT, SyncStatus.STALE}
    assert clock.steps == 0

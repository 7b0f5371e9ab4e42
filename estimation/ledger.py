"""The ledger of fusion attempts: rows whose outcome is final, and the records made of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from estimation.events import Kind, Names
from estimation.outcome import Outcome
from estimation.output import RECORD_DTYPE
from estimation.rows import HEAVE_MODEL, PENDING, Rows
from estimation.watch import LET_GO


@dataclass(slots=True)
class Ledger:
    """Rows are kept as they become final and turned into records when these are asked for.

    ``imu_outcomes`` counts the inertial samples by outcome; ``notes`` are (t_ns, sentence).
    """

    imu_outcomes: dict[Outcome, int] = field(default_factory=dict)
    notes: list[tuple[int, str]] = field(default_factory=list)
    _settled: list[Rows] = field(default_factory=list)

    def keep(self, rows: Rows) -> None:
        """Keep rows whose outcome is final."""
        if len(rows):
            self._settled.append(rows)

    def reject(self, rows: Rows, outcome: Outcome | None = None) -> None:
        """Keep rows that were never tried: with this outcome, or the one that they carry."""
        if outcome is not None:
            rows.outcome[:] = outcome
        rows.result[:] = 0.0
        self.keep(rows)

    def note(self, t_ns: int, sentence: str) -> None:
        """Keep a note."""
        self.notes.append((t_ns, sentence))

    def take_notes(self) -> list[tuple[int, str]]:
        """Return the notes and forget them."""
        notes = list(self.notes)
        self.notes.clear()
        return notes

    def take_records(self, names: Names) -> NDArray[np.void]:
        """Turn the rows that were kept into records; count the inertial samples, note the resets."""
        if not self._settled:
            return np.empty(0, dtype=RECORD_DTYPE)
        rows = Rows(
            np.concatenate([r.ints for r in self._settled]), np.concatenate([r.floats for r in self._settled])
        )
        self._settled.clear()
        imu = rows.kind == Kind.IMU
        for outcome, count in zip(*np.unique(rows.outcome[imu], return_counts=True), strict=True):
            key = Outcome.FUSED if outcome == PENDING else Outcome(int(outcome))
            self.imu_outcomes[key] = self.imu_outcomes.get(key, 0) + int(count)
        kept = ~imu | (rows.outcome > Outcome.DOWNWEIGHTED)
        r = rows.take(np.flatnonzero(kept & (rows.kind != HEAVE_MODEL)))
        records = np.zeros(len(r), dtype=RECORD_DTYPE)
        records["t_ns"], records["stamp_ns"], records["arrival_ns"] = r.t_ns, r.stamp_ns, r.arrival_ns
        records["sensor"], records["outcome"] = r.sensor, r.outcome
        records["dof"] = r.result[:, 1]
        records["nis"] = np.where(r.result[:, 1] > 0, r.result[:, 0], np.nan)
        axis = np.arange(3) < r.result[:, 1:2]
        records["innovation"] = np.where(axis, r.result[:, 2:5], np.nan)
        records["sigma"] = np.where(axis, r.result[:, 5:8], np.nan)
        records["log_det"] = np.where(r.result[:, 1] > 0, r.log_det, np.nan)
        records["age_s"] = r.age_ns * 1e-9
        for i in np.flatnonzero(r.reset):
            if r.reset[i] == LET_GO:
                self.note(int(r.t_ns[i]), "the deck no longer moves as was learned: its heave is open again")
                continue
            name, size = names.sensors[int(r.sensor[i])], float(np.linalg.norm(r.result[i, 2:5]))
            text = f"{name} contradicted the filter, but not itself, for long: moved onto it by {size:.1f}"
            self.note(int(r.t_ns[i]), text)
        return records

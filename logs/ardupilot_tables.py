"""The tables of a dataflash log with their times, by sensor instance, and the log's parameters."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from logs.dataflash_format import DataflashLog, text_of
from logs.sensors import Stamps, Times
from logs.stamps import common_offset, gps_to_utc_ns, in_order, near, to_ns

Table = NDArray[np.void]

_INSTANCE_COLUMNS = ("I", "Instance", "Inst", "C")
_TEXTS = {"Name", "Message", "FWS"}
_INTEGERS = {
    *_INSTANCE_COLUMNS, "Status", "GWk", "GMS", "ModeNum", "Subsys", "ECode", "Id", "Type", "Stat", "Orient", "PI",
}  # fmt: skip


def has(table: Table, *names: str) -> bool:
    """Say whether a table has all of the columns, and each as text, integer or number as its meaning demands.

    (A damaged format definition can make any of a number a text, or the reverse.)
    """
    if not set(names) <= set(table.dtype.names or ()):
        return False
    return all(
        table.dtype[n].kind in ("S" if n in _TEXTS else "iu" if n in _INTEGERS else "iuf") for n in names
    )


@dataclass(slots=True)
class TimedTables:
    """Access to a log's tables in the order of their stamps.

    ``offset_ns`` takes the autopilot's clock to UTC (None where the log holds no GPS time). Rows whose stamp
    is damaged or runs backwards are left out and counted in ``left_out`` by message name; ``used`` collects
    the names that were asked for and there.
    """

    log: DataflashLog
    offset_ns: int | None = None
    centre_ns: int = 0
    used: set[str] = field(default_factory=set)
    left_out: dict[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Find the middle of the log and the constant to UTC."""
        stamps = [to_ns(t["TimeUS"]) for t in self.log.tables.values() if has(t, "TimeUS")]
        self.centre_ns = int(np.median(np.concatenate(stamps))) if stamps else 0
        self.offset_ns = self._find_utc()

    def rows(self, name: str, *needed: str, instance: int | None = None) -> tuple[Table, Times] | None:
        """Return a table's rows, or those of one instance, with their times.

        None where there is no such table, where it lacks ``TimeUS`` or one of the ``needed`` columns, or
        where no row is left.
        """
        table = self.log.tables.get(name)
        if table is None or not has(table, "TimeUS", *needed):
            return None
        self.used.add(name)
        column = self._instance_column(name)
        if instance is not None and column is not None:
            table = table[table[column] == instance]
        stamp = to_ns(table["TimeUS"])
        keep = near(stamp, self.centre_ns)
        keep[keep] = in_order(stamp[keep])
        lost = int(np.count_nonzero(~keep))
        if lost:
            self.left_out[name] = self.left_out.get(name, 0) + lost
            table, stamp = table[keep], stamp[keep]
        return (table, self.times(stamp)) if len(table) else None

    def times(self, stamp_ns: Stamps) -> Times:
        """Return stamps with arrivals: the same moment in UTC (a log knows no other)."""
        return Times(stamp_ns, stamp_ns + (self.offset_ns or 0))

    def instances(self, *names: str, needed: tuple[str, ...] = ()) -> dict[int, tuple[Table, Times]]:
        """Return a sensor's rows by instance: a column of the first name, or (in old logs) one name each."""
        found: dict[int, tuple[Table, Times]] = {}
        for position, name in enumerate(names):
            column = self._instance_column(name)
            if column is None:
                rows = self.rows(name, *needed)
                if rows is not None:
                    found.setdefault(position, rows)
                continue
            for instance in np.unique(self.log.tables[name][column]).tolist():
                rows = self.rows(name, *needed, instance=instance)
                if rows is not None:
                    found.setdefault(int(instance), rows)
        return found

    def parameters(self) -> dict[str, float]:
        """Return the parameters by name, each with the last value that was logged."""
        table = self.log.tables.get("PARM")
        if table is None or not has(table, "Name", "Value"):
            return {}
        self.used.add("PARM")
        return {
            text_of(n): float(v) for n, v in zip(table["Name"].tolist(), table["Value"].tolist(), strict=True)
        }

    def _instance_column(self, name: str) -> str | None:
        table = self.log.tables.get(name)
        if table is None:
            return None
        return next((c for c in _INSTANCE_COLUMNS if has(table, c)), None)

    def _find_utc(self) -> int | None:
        """Return UTC less boot time [ns]: the median over all fixes with a GPS time."""
        table = self.log.tables.get("GPS")
        if table is None or not has(table, "TimeUS", "GWk", "GMS", "Status"):
            return None
        stamp = to_ns(table["TimeUS"])
        good = near(stamp, self.centre_ns) & (table["GWk"] > 1000) & (table["Status"] >= 3)
        if not good.any():
            return None
        utc = gps_to_utc_ns(table["GWk"][good], table["GMS"][good])
        return common_offset(utc, stamp[good])

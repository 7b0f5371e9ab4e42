"""``replay --check``: the same log and configuration must give the same bytes, always."""

from __future__ import annotations

import filecmp
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from deckfix.estimate_log import estimate_series
from estimation.config import Config
from estimation.events import AUTOPILOT

if TYPE_CHECKING:
    from deckfix.result import Result
    from estimation.estimator import EngineName
    from logs.reader import Flight
    from logs.recording import Series

COMPARED = (
    "/estimate/odometry", "/estimate/relative", "/estimate/platform", "/estimate/state", "/fusion",
    "/heave/model", "/heave/forecast",
)  # fmt: skip

_UNFINISHED_NS = 3_000_000_000
"""A log that was cut off may lack records of so long before its end: they are written when they are final."""


def check_replay(
    result: Result, config: Config | str | Path | None, engine: EngineName, jobs: int | None = None
) -> tuple[bool, list[str]]:
    """Replay a result's log anew, and compare: the files of both replays, and estimates that the log
    recorded.

    Returns whether all are equal, and sentences for the user.
    """
    from deckfix.replaying import replay

    if result.source is None:
        raise ValueError("this result did not come from a log")
    path = Path(result.source.path)
    looked_at = result.images is not None and result.images.source == "images"
    again = replay(path, config, engine, smooth=result.smoothed is not None, images=looked_at, jobs=jobs)
    said = []
    with tempfile.TemporaryDirectory(prefix="deckfix-") as folder:
        first, second = Path(folder) / "first.mcap", Path(folder) / "second.mcap"
        result.write(first)
        again.write(second)
        equal = filecmp.cmp(first, second, shallow=False)
        size = first.stat().st_size
    if equal:
        said.append(f"check: two replays gave equal files ({size:,} bytes)")
    else:
        said.append(f"check FAILED: two replays of {path.name} differ; please report it with the log")
    recorded = compare_recorded(result, again.source or result.source)
    if recorded is None:
        return equal, said
    differing, messages = recorded
    if not differing:
        return equal, [*said, f"check: equal to the {messages:,} estimates and records in the log"]
    names = ", ".join(differing)
    said.append(
        f"check FAILED: {names} in the log differ from this replay; they were made with another engine, "
        "configuration or version"
    )
    return False, said


def compare_recorded(result: Result, flight: Flight) -> tuple[list[str], int] | None:
    """Return the topics whose recorded messages differ from this result, and how many were compared.

    None where the log has recorded none.
    """
    recorded = {t: flight.series(t) for t in COMPARED if t in flight.topics}
    if not recorded:
        return None
    ours: dict[str, list[Series]] = {t: [] for t in COMPARED}
    for series in estimate_series(result.run, flight.clock_offsets_ns.get(AUTOPILOT, 0), result.forecasts):
        ours[series.topic].append(series)
    differing = [t for t, theirs in recorded.items() if not _equal(ours[t], theirs, flight.complete)]
    return differing, sum(len(s) for theirs in recorded.values() for s in theirs)


def _equal(ours: list[Series], theirs: list[Series], complete: bool) -> bool:
    """Tell whether series are equal, in any order of writing.

    A log that was cut off (the process was killed) may lack what would have been written at its end.
    """
    left, right = _by_kind(ours), _by_kind(theirs)
    if not right.keys() <= left.keys() or (complete and left.keys() != right.keys()):
        return False
    for key in right:
        a, b = _sorted(left[key]), _sorted(right[key])
        if len(b) < len(a) and not complete and len(b):
            held = np.isin(a, b)
            if not held[a["stamp"] <= b["stamp"][-1] - _UNFINISHED_NS].all():
                return False
            a = a[held]
        if not np.array_equal(a, b):
            return False
    return True


def _sorted(series: Series) -> NDArray[np.void]:
    """Return stamps and bytes of a series (n,), in the order of the stamps and then of the bytes."""
    data = np.ascontiguousarray(series.data)
    rows = np.empty(len(series), dtype=[("stamp", np.int64), ("bytes", f"S{max(1, data.dtype.itemsize)}")])
    rows["stamp"] = series.stamp_ns
    # Zeros at the end of bytes do not count in comparisons; rows of one length differ elsewhere if they differ.
    rows["bytes"] = data.view(f"S{data.dtype.itemsize}").reshape(-1) if data.dtype.itemsize else b""
    return np.sort(rows)


def _by_kind(series: list[Series]) -> dict[tuple[object, ...], Series]:
    """Return series by their strings and columns, which tell those of one topic apart."""
    return {(*sorted(s.strings.items()), str(s.data.dtype.descr)): s for s in series}

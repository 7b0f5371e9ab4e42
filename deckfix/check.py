"""``replay --check``: the same log and configuration must give the same bytes, always."""

from __future__ import annotations

import filecmp
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

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


def check_replay(
    result: Result, config: Config | str | Path | None, engine: EngineName
) -> tuple[bool, list[str]]:
    """Replay a result's log anew, and compare: the files of both replays, and estimates that the log
    recorded.

    Returns whether all are equal, and sentences for the user.
    """
    from deckfix.replaying import replay

    if result.source is None:
        raise ValueError("this result did not come from a log")
    path = Path(result.source.path)
    again = replay(path, config, engine, smooth=result.smoothed is not None)
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
    differing = [t for t, theirs in recorded.items() if not _equal(ours[t], theirs)]
    return differing, sum(len(s) for theirs in recorded.values() for s in theirs)


def _equal(ours: list[Series], theirs: list[Series]) -> bool:
    left, right = _by_kind(ours), _by_kind(theirs)
    if left.keys() != right.keys():
        return False
    for key, a in left.items():
        b = right[key]
        if not np.array_equal(a.stamp_ns, b.stamp_ns):
            return False
        for name in a.data.dtype.names or ():
            if a.data[name].tobytes() != b.data[name].tobytes():
                return False
    return True


def _by_kind(series: list[Series]) -> dict[tuple[object, ...], Series]:
    """Return series by their strings and columns, which tell those of one topic apart."""
    return {(*sorted(s.strings.items()), str(s.data.dtype.descr)): s for s in series}

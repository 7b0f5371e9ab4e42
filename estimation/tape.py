"""What a smoother needs of a flight: its events in their final order, and the filter's state now and then.

The tape is written as events leave the rewind window, when neither their order nor their outcomes can change. It ends
where the filter was aligned anew, and another begins: nothing is known of the time between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np

from estimation.rows import FilterState, Int, Rows

if TYPE_CHECKING:
    from estimation.history import Engine

CHECKPOINT_ROWS = 4096
"""Events between two states that are kept: some 10 kB against the 1 MB of the events themselves."""


@dataclass(slots=True)
class Interval:
    """One uninterrupted run of an engine: its events, in order, and states with the number of events before each."""

    engine: Engine
    states: list[tuple[int, FilterState]]
    parts: list[Rows] = field(default_factory=list)
    size: int = 0

    def rows(self) -> Rows:
        """Return all events, as one copy."""
        ints: list[Int] = [part.ints for part in self.parts]
        if not ints:
            return Rows.empty(0)
        return Rows(np.concatenate(ints), np.concatenate([part.floats for part in self.parts]))


@dataclass(slots=True)
class Tape:
    """The intervals of a flight, the last of which may still grow."""

    intervals: list[Interval] = field(default_factory=list)

    def begin(self, engine: Engine) -> None:
        """Begin an interval at the engine's state."""
        self.intervals.append(Interval(engine, [(0, engine.save())]))

    def keep(self, rows: Rows, state: FilterState | None) -> None:
        """Take events that are final, and the state after them where there is one to come back to."""
        interval = self.intervals[-1]
        interval.parts.append(rows)
        interval.size += len(rows)
        if state is not None and interval.size - interval.states[-1][0] >= CHECKPOINT_ROWS:
            interval.states.append((interval.size, state))

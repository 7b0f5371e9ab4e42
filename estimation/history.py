"""Rewinding: events in any order of arrival, results as if they had come in the order of their content.

The history keeps the events of the last ``window`` in the order of their content, with checkpoints of the engine
among them. A late event is put where it belongs; before the next estimate the engine goes back to the last
checkpoint before it and runs forward again. The order is total (time, kind, sensor, content), so the result is a
function of the set of events alone, to the last bit.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from estimation.outcome import Outcome
from estimation.rows import Estimates, FilterState, Int, Rows
from estimation.tape import Tape
from estimation.trail import Trail

IMU, VISION = 0, 8
REPEATED = 16
"""Added to the kind of a row that repeats another under a new stamp: no kind that an engine would take."""
CHECKPOINT_NS = 20_000_000
"""Spacing of the checkpoints: what a rewind runs again beyond the event's own age, at most."""


class Engine(Protocol):
    """What the history asks of an engine; ``estimation.filter`` and ``estimation.compiled`` have it."""

    state: FilterState
    trail: Trail

    def save(self) -> FilterState:
        """Return a checkpoint."""

    def load(self, saved: FilterState) -> None:
        """Go back to a checkpoint."""

    def advance(
        self, rows: Rows, start: int, stop: int, out: Estimates, emit_after_ns: int, period_ns: int
    ) -> None:
        """Process the rows start..stop in order, the last of which is an inertial sample."""


@dataclass(slots=True)
class History:
    """The window of events, the part of it that is done, and the checkpoints in it.

    ``done`` rows are behind the engine; ``stale`` is set while the engine is past an insertion and must go back.
    ``newest_ns`` is the time of the newest inertial sample that arrived. ``checkpoints`` pair a row's index, all
    rows up to and including which are in the saved state, with that state. ``tape`` takes what nothing can change any
    more, for a smoother.
    """

    window_ns: int
    rows: Rows = field(default_factory=lambda: Rows.empty(1024))
    size: int = 0
    done: int = 0
    stale: bool = False
    newest_ns: int | None = None
    emitted_ns: int = 0
    checkpoints: list[tuple[int, FilterState]] = field(default_factory=list)
    tape: Tape | None = None

    shown: dict[int, bytes] = field(default_factory=dict)
    """Of each camera the place in the last fix that was forgotten."""

    def insert(self, new: Rows) -> Int:
        """Put events where they belong; return the ids of exact repetitions, which are left out."""
        n = len(new)
        if n == 0:
            return np.empty(0, dtype=np.int64)
        place = self.size
        first = int(new.t_ns.min())
        seen = bool(np.any(new.kind % REPEATED == VISION))
        if n == 1 and (place == 0 or self.rows.t_ns[place - 1] < first):
            self._reserve(place + 1)
            self.rows.write(place, new)
            self.size = place + 1
            if seen:
                self._mark_repeated(place)
            return np.empty(0, dtype=np.int64)
        if place and self.rows.t_ns[place - 1] >= first:
            place = int(np.searchsorted(self.rows.t_ns[:place], first, side="left"))
            if n == 1 and self.rows.t_ns[place] > first:
                # One event at a time of its own, as most late ones are: nothing to put in order, nothing to repeat.
                self._reserve(self.size + 1)
                self.rows.make_room(place, self.size)
                self.rows.write(place, new)
                self.size += 1
                if seen:
                    self._mark_repeated(place)
                self._go_back(place)
                return np.empty(0, dtype=np.int64)
        merged = Rows.concatenate(self.rows.take(slice(place, self.size)), new) if place < self.size else new
        order = _order(merged)
        repeated = _repetitions(merged, order)
        left_out = merged.id[order[repeated]]
        order = order[~repeated]
        old = self.size - place
        # Where the order first departs from what was there, what is behind must be done again.
        kept = order[:old] == np.arange(min(old, len(order)))
        first_changed = place + (old if kept.all() and len(kept) == old else int(np.argmin(kept)))
        self._reserve(place + len(order))
        self.rows.write(place, merged.take(order))
        self.size = place + len(order)
        if seen:
            self._mark_repeated(place)
        self._go_back(first_changed)
        return left_out

    def _go_back(self, first_changed: int) -> None:
        """Leave what is done from a row on to be done again."""
        if first_changed >= self.done:
            return
        # Measurements between two inertial samples were taken with an interpolation between them, which an insertion
        # may change: all since the sample before is done again.
        back = first_changed
        while back > 0 and self.rows.kind[back - 1] != IMU:
            back -= 1
        while self.checkpoints[-1][0] >= back:
            self.checkpoints.pop()
        self.done = self.checkpoints[-1][0] + 1
        self.stale = True

    def begin(self, engine: Engine, at: int) -> None:
        """Start: the engine's state holds all rows before index ``at``."""
        self.checkpoints = [(at - 1, engine.save())]
        self.done = at
        self.stale = False
        if self.tape is not None:
            self.tape.begin(engine)

    def advance(self, engine: Engine, out: Estimates, period_ns: int) -> None:
        """Run the engine to the newest inertial sample, rewinding first where something was inserted."""
        stop = self.size
        while stop > self.done and self.rows.kind[stop - 1] != IMU:
            stop -= 1
        if stop <= self.done:
            return
        if self.stale:
            engine.load(self.checkpoints[-1][1])
            self.stale = False
        t = self.rows.t_ns
        begin, newest = self.done, int(t[stop - 1])
        oldest = newest - self.window_ns - 2 * CHECKPOINT_NS
        last = int(self.checkpoints[-1][1].clock[0]) // CHECKPOINT_NS
        todo = zip(t[begin:stop].tolist(), self.rows.kind[begin:stop].tolist(), strict=True)
        for index, (time, kind) in enumerate(todo, begin):
            if kind != IMU:
                continue
            before, last = last, time // CHECKPOINT_NS
            if last == before or time < oldest:
                continue
            engine.advance(self.rows, self.done, index + 1, out, self.emitted_ns, period_ns)
            self.done = index + 1
            self.checkpoints.append((index, engine.save()))
        if self.done < stop:
            engine.advance(self.rows, self.done, stop, out, self.emitted_ns, period_ns)
            self.done = stop
        self.emitted_ns = max(self.emitted_ns, newest)

    def settle(self, everything: bool = False) -> Rows:
        """Forget and return the rows that nothing can change any more (all that are done, for ``everything``)."""
        if self.newest_ns is None or not self.checkpoints:
            return Rows.empty(0)
        if everything:
            cut = self.done
        else:
            limit = self.newest_ns - self.window_ns
            keep = 0
            while keep + 1 < len(self.checkpoints) and self.checkpoints[keep + 1][1].clock[0] < limit:
                keep += 1
            if keep == 0:
                return Rows.empty(0)
            cut = self.checkpoints[keep][0] + 1
            del self.checkpoints[:keep]
        if cut <= 0:
            return Rows.empty(0)
        settled = self.first(cut)
        if self.tape is not None:
            self.tape.keep(settled, None if everything else self.checkpoints[0][1])
        self.drop(cut)
        return settled

    def first(self, count: int) -> Rows:
        """Return the first ``count`` rows, as they are to be told of."""
        rows = self.rows.take(slice(0, count)).copy()
        repeated = rows.kind >= REPEATED
        rows.outcome[repeated] = Outcome.REJECTED_DUPLICATE
        rows.kind[repeated] -= REPEATED
        return rows

    def drop(self, count: int) -> None:
        """Forget the first ``count`` rows."""
        for i in np.flatnonzero(self.rows.kind[:count] % REPEATED == VISION):
            self.shown[int(self.rows.sensor[i])] = self.rows.value[i, :3].tobytes()
        self.rows.write(0, self.rows.take(slice(count, self.size)).copy())
        self.size -= count
        self.done = max(0, self.done - count)
        self.checkpoints = [(i - count, s) for i, s in self.checkpoints]

    def _mark_repeated(self, start: int) -> None:
        """Mark, from row ``start`` on, the fixes that show to the last bit what their camera's fix before them shows.

        A picture that stands still, or a detector that does, says nothing new: it must not count as a confirmation. The
        mark depends on the order of the content alone, as all does.
        """
        kinds = self.rows.kind
        for i in (start + np.flatnonzero(kinds[start : self.size] % REPEATED == VISION)).tolist():
            sensor = int(self.rows.sensor[i])
            before = i - 1
            while before >= 0 and not (
                kinds[before] % REPEATED == VISION and self.rows.sensor[before] == sensor
            ):
                before -= 1
            shown = self.rows.value[before, :3].tobytes() if before >= 0 else self.shown.get(sensor)
            kinds[i] = VISION + REPEATED * (shown == self.rows.value[i, :3].tobytes())

    def _reserve(self, n: int) -> None:
        capacity = len(self.rows)
        if n > capacity:
            grown = Rows.empty(max(n, 2 * capacity))
            grown.write(0, self.rows.take(slice(0, self.size)))
            self.rows = grown


def _order(rows: Rows) -> Int:
    """Return the order by time, kind, sensor, value, covariance and last by arrival."""
    kind = rows.kind % REPEATED
    order = np.lexsort((kind, rows.t_ns))
    t, k = rows.t_ns[order], kind[order]
    if np.any((t[1:] == t[:-1]) & (k[1:] == k[:-1])):
        keys = [rows.id, *rows.own.T[::-1], *rows.value.T[::-1], rows.sensor, kind, rows.t_ns]
        order = np.lexsort(keys)
    return order.astype(np.int64)


def _repetitions(rows: Rows, order: Int) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
    """Return, in that order, which rows repeat the one before them in all but the order of arrival."""
    repeated = np.zeros(len(order), dtype=bool)
    t, k = rows.t_ns[order], rows.kind[order] % REPEATED
    for i in np.flatnonzero((t[1:] == t[:-1]) & (k[1:] == k[:-1])):
        a, b = int(order[i]), int(order[i + 1])
        repeated[i + 1] = (
            rows.sensor[a] == rows.sensor[b]
            and np.array_equal(rows.value[a], rows.value[b], equal_nan=True)
            and np.array_equal(rows.own[a], rows.own[b], equal_nan=True)
        )
    return repeated

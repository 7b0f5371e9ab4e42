"""The platform's motion learned beside the estimates, by an executor of the caller's.

A fit takes long against the time between two inertial samples. What it leads to is taken up by the filter a fixed time
after its fixes were final, and so need not be there before.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from concurrent.futures import Executor, Future
from dataclasses import dataclass, field

from estimation.learning import Learned, MotionLearner
from estimation.rows import Rows


@dataclass(slots=True)
class LearnerBeside:
    """A learner that is given final rows, and asked for its results later.

    With an ``executor`` of one worker it learns there, in the order of what it is given; without one at once. What it
    yields, and by when, does not depend on how long it took. What fails raises where the result is asked for.
    """

    learner: MotionLearner
    executor: Executor | None = None
    _known: deque[Learned] = field(default_factory=deque)
    _going: deque[tuple[int, Future[list[Learned]]]] = field(default_factory=deque)
    _given_ns: int | None = None

    def give(self, rows: Rows) -> None:
        """Learn from rows that are final, in order."""
        if self.executor is None:
            self._known.extend(self.learner.take(rows))
            return
        # Nothing comes due before what was given last.
        since = int(rows.t_ns[0]) if self._given_ns is None else self._given_ns
        self._given_ns = int(rows.t_ns[-1])
        self._going.append((since, self.executor.submit(self.learner.take, rows)))

    def results(self, until_ns: int) -> Iterator[Learned]:
        """Yield what has not been yielded yet: all that came due by a time, which is waited for, and what is there."""
        while self._going and (self._going[0][0] <= until_ns or self._going[0][1].done()):
            self._known.extend(self._going.popleft()[1].result())
        while self._known:
            yield self._known.popleft()

    def begin_anew(self) -> None:
        """Expect times that have gone back; all results were returned before."""
        self._given_ns = None

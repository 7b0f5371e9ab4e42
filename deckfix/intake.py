"""The one queue in front of the estimator: events in the order of their arrival, and the newest image.

Whoever brings something in is given its arrival here, under a lock, so that the order of the queue is the order of
the arrivals and no two are equal: the log can be put in the same order again. The queue is bounded: where the
estimator is slower than the link, the oldest image, and then the newest events, are dropped and counted.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

from deckfix.pipeline import ImageEvent
from estimation.events import Event

MOST_EVENTS = 4000
"""Some ten seconds of a link's messages."""


@dataclass(frozen=True, slots=True)
class CompanionClock:
    """The companion's clock: UTC as it was at the start, and the time since then, which nothing sets back.

    It is what arrivals, TIMESYNC and images are stamped with.
    """

    utc_ns: int = field(default_factory=time.time_ns)
    begin_ns: int = field(default_factory=time.monotonic_ns)

    def __call__(self) -> int:
        """Return the time now [ns]."""
        return self.utc_ns + time.monotonic_ns() - self.begin_ns

    def of_monotonic(self, monotonic_ns: int) -> int:
        """Return the time at which the system's monotonic clock showed something."""
        return self.utc_ns + monotonic_ns - self.begin_ns


@dataclass(slots=True)
class Intake:
    """A bounded queue of events and at most one image; ``drops`` counts what did not fit."""

    now: Callable[[], int]
    drops: Counter[str] = field(default_factory=Counter)
    _items: deque[Event | ImageEvent] = field(default_factory=deque)
    _images: int = 0
    _last_ns: int = 0
    _there: threading.Condition = field(default_factory=threading.Condition)

    def put(self, events: Sequence[Event]) -> None:
        """Take events that have just come."""
        with self._there:
            for event in events:
                if len(self._items) >= MOST_EVENTS:
                    self.drops["events"] += 1
                    continue
                self._items.append(replace(event, arrival_ns=self._arrival()))
            self._there.notify()

    def put_image(self, image: ImageEvent) -> None:
        """Take an image that has just come; one that still waits is dropped."""
        with self._there:
            if self._images:
                waiting = next(i for i in self._items if isinstance(i, ImageEvent))
                self._items.remove(waiting)
                self.drops["images"] += 1
                self._images -= 1
            self._items.append(replace(image, arrival_ns=self._arrival()))
            self._images += 1
            self._there.notify()

    def get(self, timeout_s: float) -> Event | ImageEvent | None:
        """Return the next in the order of arrival, or None where nothing came in time."""
        with self._there:
            if not self._items:
                self._there.wait(timeout_s)
            if not self._items:
                return None
            item = self._items.popleft()
            self._images -= isinstance(item, ImageEvent)
            return item

    def __len__(self) -> int:
        """Return how many wait."""
        return len(self._items)

    def _arrival(self) -> int:
        self._last_ns = max(self.now(), self._last_ns + 1)
        return self._last_ns

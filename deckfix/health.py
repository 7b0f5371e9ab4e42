"""What is wrong on board, as one closed list, and how it is published: MAV_STATE, bits and words.

In flight nothing ends the program: it goes on with less, and says with what.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import IntFlag


class Problem(IntFlag):
    """What is wrong now; the bits are the heartbeat's ``custom_mode``."""

    LINK = 1
    IMU = 2
    CLOCK = 4
    CAMERA = 8
    ESTIMATE = 16
    TARGET = 32
    LOG = 64
    OVERLOAD = 128


NOTHING = Problem(0)

WORDS: dict[Problem, str] = {
    Problem.LINK: "autopilot lost",
    Problem.IMU: "no inertial samples",
    Problem.CLOCK: "clocks not compared",
    Problem.CAMERA: "camera lost: no images",
    Problem.ESTIMATE: "no estimate",
    Problem.TARGET: "target not in view",
    Problem.LOG: "log not written",
    Problem.OVERLOAD: "overloaded: input dropped",
}
"""What each problem is called; with the prefix of a STATUSTEXT it fits into 50 characters."""

_BOOT, _CALIBRATING, _STANDBY, _ACTIVE, _CRITICAL = 1, 2, 3, 4, 5
_BLIND = Problem.LINK | Problem.IMU | Problem.ESTIMATE
_WARNING, _NOTICE, _ERROR = 4, 5, 3


@dataclass(slots=True)
class Health:
    """The problems of now, and since when; ``update`` tells what changed.

    ``started`` is set by the first estimate: from then on to have none is critical.
    """

    now: Problem = NOTHING
    started: bool = False
    _told: dict[Problem, int] = field(default_factory=dict)

    @property
    def state(self) -> int:
        """MAV_STATE: calibrating until there is an estimate, standby without the target, active with it."""
        if not self.started:
            return _BOOT if Problem.LINK in self.now else _CALIBRATING
        if self.now & _BLIND:
            return _CRITICAL
        return _STANDBY if self.now & (Problem.TARGET | Problem.CAMERA) else _ACTIVE

    @property
    def words(self) -> str:
        """The state in a few words."""
        if not self.now:
            return "all is well"
        return "; ".join(WORDS[p] for p in Problem if p in self.now)

    def update(self, problems: Problem, now_ns: int) -> list[tuple[int, str]]:
        """Take the problems of now; return (severity, words) for each that came or went.

        One that comes and goes is told at most once in two seconds.
        """
        said = []
        if Problem.ESTIMATE not in problems:
            self.started = True
        for p in Problem:
            if (p in problems) == (p in self.now):
                continue
            if now_ns - self._told.get(p, -(10**18)) < 2_000_000_000:
                problems = problems ^ p  # as it was, until it may be told again
                continue
            self._told[p] = now_ns
            came = p in problems
            grave = _ERROR if p & _BLIND else _WARNING
            said.append((grave if came else _NOTICE, f"deckfix: {WORDS[p]}" + ("" if came else ": over")))
        self.now = problems
        return said

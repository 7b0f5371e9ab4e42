"""What an engine leaves behind for the smoother: its state before and after each instant that told it something.

An instant (a *node*) is where measurements were fused or where an estimate comes out; several measurements of one
instant are one node. Between nodes the transition is kept as one product, so that what is stored grows with the
fixes and not with the inertial samples.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.deck import MOTION_SIZE
from estimation.frames import Array
from estimation.rows import Int
from estimation.state import NOMINAL_SIZE, Layout

EMITS, RESET_KIND, RESET_SIZE = range(3)
"""Columns of ``Trail.marks``: 1 where an estimate comes out; kind and dimension of the measurement onto which the
filter was moved, 0 where it was not (``update.reset_datum``)."""
BEFORE, AFTER = range(2)
"""Places in ``Trail.nominal`` and ``Trail.covariance``: what the node's measurements found, and what they left."""


@dataclass(slots=True)
class Trail:
    """Nodes in the order of time, of which ``count[0]`` are filled; n is the error state's size.

    ``t_ns`` (m,); ``marks`` (m, 3); ``nominal`` (m, 2, NOMINAL_SIZE) and ``covariance`` (m, 2, n, n) before and after
    the node's measurements; ``chain`` (m + 1, n, n) the error state's transition from the node before to this one
    (that behind the last node is still growing); ``motion`` (m, 22) the deck's parameters. A node at which the filter
    was moved onto a sensor has the state after that move in both places: the move belongs to the transition.
    """

    count: Int
    t_ns: Int
    marks: Int
    nominal: Array
    covariance: Array
    chain: Array
    motion: Array

    @classmethod
    def empty(cls, m: int, n: int) -> Trail:
        """Return room for m nodes of an error state of n entries; of none, it switches recording off."""
        return cls(
            np.zeros(1, dtype=np.int64),
            np.zeros(m, dtype=np.int64),
            np.zeros((m, 3), dtype=np.int64),
            np.empty((m, 2, NOMINAL_SIZE)),
            np.empty((m, 2, n, n)),
            np.empty((m + 1 if m else 0, n, n)),
            np.empty((m, MOTION_SIZE)),
        )

    @classmethod
    def off(cls, layout: Layout) -> Trail:
        """Return the trail of an engine that records nothing."""
        return cls.empty(0, layout.size)

    @property
    def on(self) -> bool:
        """Whether there is room to record."""
        return len(self.t_ns) > 0

    def open(self, t_ns: int, x: Array, P: Array, motion: Array) -> None:
        """Begin a node, with the state before its measurements, which is the state after them so far."""
        k = int(self.count[0])
        self.t_ns[k] = t_ns
        self.marks[k] = 0
        self.nominal[k] = x
        self.covariance[k] = P
        self.motion[k] = motion
        self.chain[k + 1] = np.eye(len(P))
        self.count[0] = k + 1

    def reach(self, t_ns: int, x: Array, P: Array, motion: Array) -> None:
        """Begin a node unless the last one is at this instant."""
        k = int(self.count[0])
        if k == 0 or self.t_ns[k - 1] != t_ns:
            self.open(t_ns, x, P, motion)

    def close(self, x: Array, P: Array) -> None:
        """Note what the last node's measurements have left."""
        k = int(self.count[0]) - 1
        self.nominal[k, AFTER] = x
        self.covariance[k, AFTER] = P

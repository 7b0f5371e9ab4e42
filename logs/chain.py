"""Finding the messages among all places of a file that look like one.

Both dataflash and telemetry logs are chains: each message says how long it is, and the next one begins where
it ends. A candidate is *linked* when another candidate, or the end of the file, is where it ends. The walk is
vectorised as far as candidates follow each other simply; Python runs only where they do not.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Offsets = NDArray[np.int64]


def chain(at: Offsets, ends: Offsets, size: int) -> NDArray[np.bool_]:
    """Return which candidates are messages.

    ``at`` (n,) ascending: where each begins; ``ends`` (n,): where each would end; ``size`` [bytes] of the
    file. A candidate inside a message that was accepted is none. A message that garbage follows is accepted
    unless a linked candidate begins inside it (then its own bytes were lost) or it would end behind the file;
    after it the walk goes on at the next linked candidate.
    """
    count = len(at)
    keep = np.ones(count, dtype=np.bool_)
    if count == 0:
        return keep
    simple = np.zeros(count, dtype=np.bool_)
    simple[:-1] = ends[:-1] == at[1:]
    breaks = np.flatnonzero(~simple)
    successor = np.searchsorted(at, ends[breaks])
    follows = at[np.minimum(successor, count - 1)] == ends[breaks]
    linked = simple.copy()
    linked[breaks] = (ends[breaks] == size) | follows
    anchors = np.flatnonzero(linked)
    resume = np.append(anchors, count)[np.searchsorted(anchors, breaks + 1)]
    here = 0
    for b, s, r, good, end in zip(
        breaks.tolist(),
        successor.tolist(),
        resume.tolist(),
        linked[breaks].tolist(),
        ends[breaks].tolist(),
        strict=True,
    ):
        if b < here:
            continue
        if good:
            here = s
        elif end > size or (r < count and at[r] < end):
            keep[b] = False
            here = r
        else:
            here = r
        keep[b + 1 : here] = False
    return keep


def gaps(at: Offsets, ends: Offsets, size: int) -> tuple[Offsets, Offsets]:
    """Return where the stretches between messages begin and end, those of no length left out."""
    starts = np.concatenate([[0], ends])
    stops = np.concatenate([at, [size]])
    some = stops > starts
    return starts[some], stops[some]

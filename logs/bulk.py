"""Series to chunks in bulk: packed as columns, merged by arrival, without a Python step for each message."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from logs.cdr import Layout
from logs.container import INDEX_ENTRY, MESSAGE_HEADER
from logs.recording import Series


@dataclass(slots=True)
class Block:
    """A series ready to be packed: its channel, layout, its clock's constant, and its rows by arrival."""

    channel: int
    layout: Layout
    series: Series
    offset_ns: int
    order: NDArray[np.intp]
    done: int = 0

    @property
    def record_size(self) -> int:
        """Bytes of one message record."""
        return MESSAGE_HEADER.itemsize + self.layout.dtype.itemsize


def merged_chunks(
    blocks: Sequence[Block], chunk_bytes: int
) -> Iterator[tuple[bytes, dict[int, NDArray[np.void]]]]:
    """Yield the records and message indexes of chunks of at most ``chunk_bytes`` (or of one message).

    Messages are in the order of arrival; equal arrivals keep the order of the blocks.

    Raises:
        LayoutError: a stamp does not fit into a ROS 2 time.
    """
    times = np.concatenate([b.series.arrival_ns[b.order] for b in blocks])
    owner = np.repeat(np.arange(len(blocks)), [len(b.order) for b in blocks])
    merged = np.argsort(times, kind="stable")
    times, owner = times[merged], owner[merged]
    sizes = np.array([b.record_size for b in blocks], dtype=np.int64)[owner]
    ends = np.cumsum(sizes)
    # A record belongs to the slot in which it ends, so that a chunk is larger than a slot by less than a record.
    slot = max(chunk_bytes - int(sizes.max()), 1)
    cuts = np.flatnonzero(np.diff((ends - 1) // slot)) + 1
    for first, last in pairwise([0, *cuts.tolist(), len(ends)]):
        starts = ends[first:last] - sizes[first:last]
        yield _chunk(
            blocks, times[first:last], owner[first:last], starts - starts[0], int(sizes[first:last].sum())
        )


def _chunk(
    blocks: Sequence[Block],
    times: NDArray[np.int64],
    owner: NDArray[np.intp],
    starts: NDArray[np.int64],
    size: int,
) -> tuple[bytes, dict[int, NDArray[np.void]]]:
    """Pack each block's next rows and scatter them to where the merge puts them."""
    records = np.empty(size, dtype=np.uint8)
    entries: dict[int, list[NDArray[np.void]]] = {}
    for number, block in enumerate(blocks):
        mine = np.flatnonzero(owner == number)
        if not len(mine):
            continue
        width = block.record_size
        slots = np.ndarray((size - width + 1,), dtype=f"V{width}", buffer=records.data, strides=(1,))
        slots[starts[mine]] = _records(block, times[mine]).view(f"V{width}")
        index = np.empty(len(mine), dtype=INDEX_ENTRY)
        index["log"], index["offset"] = times[mine], starts[mine]
        entries.setdefault(block.channel, []).append(index)
        block.done += len(mine)
    merged = {channel: np.sort(np.concatenate(parts), order="offset") for channel, parts in entries.items()}
    return records.tobytes(), merged


def _records(block: Block, times: NDArray[np.int64]) -> NDArray[np.void]:
    """Return the next message records of a block, packed."""
    rows = block.order[block.done : block.done + len(times)]
    stamp = block.series.stamp_ns[rows] + block.offset_ns
    # Whole messages as bytes: assigning structures would leave out what is no field, the constants.
    whole = f"V{block.layout.dtype.itemsize}"
    packed = np.empty(len(times), dtype=[("head", MESSAGE_HEADER), ("data", whole)])
    head = packed["head"]
    head["op"], head["length"], head["channel"] = 5, block.record_size - 9, block.channel
    head["sequence"] = block.done + np.arange(len(times))
    head["log"], head["publish"] = times, np.where(stamp < 0, times, stamp)
    packed["data"] = block.layout.pack(stamp, block.series.data[rows]).view(whole)
    return packed

"""A flight in memory, as columns: what importers and simulators make and the writer takes.

A ``Series`` holds the messages of one topic from one source. Its ``data`` is a structured array whose fields are
those of the topic's ROS 2 message without the header, named by their path with underscores, where x, y, z (w)
siblings of float64 are folded into one array field: ``sensor_msgs/msg/Imu`` has ``orientation`` (4: x y z w),
``angular_velocity`` (3), ``linear_acceleration_covariance`` (9) and so on (see ``logs.cdr``).

Stamps are kept as the source gave them, in the source's own clock; arrivals are UTC nanoseconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray


@dataclass(slots=True)
class Series:
    """Messages of one topic from one source, oldest arrival first.

    ``stamp_ns`` (n,) int64 in the clock named ``clock``; ``arrival_ns`` (n,) int64 UTC; ``data`` (n,) structured;
    ``frame_id`` as in the header; ``strings`` the message's other string fields, constant over the series;
    ``metadata`` free text about the source (for example ``latency_s``), written to the channel's metadata.
    """

    topic: str
    stamp_ns: NDArray[np.int64]
    arrival_ns: NDArray[np.int64]
    data: NDArray[np.void]
    clock: str = "autopilot"
    frame_id: str = ""
    strings: dict[str, str] = field(default_factory=dict)
    metadata: dict[str, str] = field(default_factory=dict)

    def __len__(self) -> int:
        """Return the number of messages."""
        return len(self.stamp_ns)


@dataclass(slots=True)
class Recording:
    """One flight: series, what is known of it, and what was wrong with the files it came from.

    ``clock_offsets_ns`` gives, for each clock, the constant that takes its stamps to UTC.
    ``metadata`` maps a record's name to its text entries; ``attachments`` a name to (media type, bytes).
    ``problems`` are sentences for the user.
    """

    series: list[Series] = field(default_factory=list)
    clock_offsets_ns: dict[str, int] = field(default_factory=dict)
    metadata: dict[str, dict[str, str]] = field(default_factory=dict)
    attachments: dict[str, tuple[str, bytes]] = field(default_factory=dict)
    problems: list[str] = field(default_factory=list)

    def find(self, topic: str) -> list[Series]:
        """Return the series of a topic, possibly none."""
        return [s for s in self.series if s.topic == topic]

"""Who speaks in a telemetry log, and when: the autopilot that is imported, its boots, and its clock."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from logs.errors import LogError
from logs.sensors import Stamps, Times
from logs.stamps import in_order, near, to_ns
from logs.tlog import Messages, TelemetryLog

IMU_MESSAGES = ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU", "SCALED_IMU2", "SCALED_IMU3")
_ANCHORS = (*IMU_MESSAGES, "ATTITUDE", "ATTITUDE_QUATERNION", "LOCAL_POSITION_NED", "GLOBAL_POSITION_INT")
_INVALID_AUTOPILOT = 8
_RESTART_NS = 1_000_000_000
_NEIGHBOUR_NS = 50_000_000
_UNIX_US = 1_000_000_000_000_000


def boot_stamps(messages: Messages) -> Stamps | None:
    """Return the messages' stamps since boot [ns], None for messages without one.

    A ``time_usec`` that counts from 1970 is no stamp since boot: then None too.
    """
    names = messages.data.dtype.names or ()
    if "time_boot_ms" in names:
        return messages.data["time_boot_ms"].astype(np.int64) * 1_000_000
    if "time_usec" not in names or not len(messages):
        return None
    microseconds = messages.data["time_usec"]
    return None if np.median(microseconds) > _UNIX_US else to_ns(microseconds)


@dataclass(slots=True)
class Autopilot:
    """One autopilot's messages within one of its boots.

    ``since_ns`` and ``until_ns`` bound the boot in arrival time; ``offset_ns`` takes its clock to the
    arrivals (the median over its IMU messages). ``left_out`` counts messages with damaged or backward stamps
    by name.
    """

    log: TelemetryLog
    system: int
    component: int
    since_ns: int
    until_ns: int
    offset_ns: int
    centre_ns: int
    left_out: Counter[str] = field(default_factory=Counter)
    used: set[str] = field(default_factory=set)

    def messages(self, name: str) -> Messages:
        """Return its messages of a type, in the order of the log."""
        found = self.log.messages(name)
        own = (found.system == self.system) & (found.component == self.component)
        self.used.add(name)
        return found[own & (found.arrival_ns >= self.since_ns) & (found.arrival_ns < self.until_ns)]

    def others(self, name: str) -> Messages:
        """Return the messages of a type that somebody else sent in the meantime."""
        found = self.log.messages(name)
        own = (found.system == self.system) & (found.component == self.component)
        self.used.add(name)
        return found[~own & (found.arrival_ns >= self.since_ns) & (found.arrival_ns < self.until_ns)]

    def timed(self, name: str) -> tuple[NDArray[np.void], Times] | None:
        """Return its messages of a type with their stamps since boot, or None where there are none."""
        messages = self.messages(name)
        stamp = boot_stamps(messages)
        if stamp is None or not len(messages):
            return None
        keep = near(stamp, self.centre_ns) & (stamp > 0)
        keep[keep] = in_order(stamp[keep])
        lost = int(np.count_nonzero(~keep & (stamp > 0)))
        if lost:
            self.left_out[name] += lost
        if not keep.any():
            return None
        return messages.data[keep], Times(stamp[keep], messages.arrival_ns[keep])

    def stamped_by_arrival(self, messages: Messages) -> Times:
        """Return times of messages that carry none.

        The stamp is that of the message with a stamp that arrived next to it, plus the difference of the two
        arrivals (an autopilot sends what is due in one burst); where none arrived within 50 ms, the arrival
        on the autopilot's clock.
        """
        stamp = messages.arrival_ns - self.offset_ns
        found = [t for t in map(self.timed, _ANCHORS) if t is not None]
        if found and len(messages):
            arrivals = np.concatenate([times.arrival_ns for _, times in found])
            order = np.argsort(arrivals, kind="stable")
            arrivals = arrivals[order]
            delays = arrivals - np.concatenate([times.stamp_ns for _, times in found])[order]
            after = np.clip(np.searchsorted(arrivals, messages.arrival_ns), 0, len(arrivals) - 1)
            before = np.maximum(after - 1, 0)
            late = np.abs(arrivals[after] - messages.arrival_ns)
            early = np.abs(arrivals[before] - messages.arrival_ns)
            nearest = np.where(early < late, before, after)
            close = np.minimum(early, late) <= _NEIGHBOUR_NS
            stamp[close] = messages.arrival_ns[close] - delays[nearest[close]]
        return Times(stamp, messages.arrival_ns)


def find_autopilot(log: TelemetryLog, path: str | Path, system: int | None = None) -> Autopilot:
    """Return the autopilot with most IMU messages (or that of ``system``), in its longest boot.

    What is passed over by this choice is added to the log's problems. Raises LogError when no autopilot, or
    not the one asked for, speaks in the log.
    """
    counts = _speakers(log)
    if not counts:
        raise LogError(path, "no autopilot speaks in this log", "use a log of the vehicle's own link")
    systems = sorted({s for s, _ in counts})
    chosen = [k for k in counts if system is None or k[0] == system]
    if not chosen:
        known = ", ".join(str(s) for s in systems)
        raise LogError(path, f"no autopilot has system id {system}", f"choose one of {known}")
    best = max(chosen, key=lambda k: counts[k])
    if len(systems) > 1 and system is None:
        others = ", ".join(str(s) for s in systems if s != best[0])
        log.problems.append(
            f"{len(systems)} vehicles speak in the telemetry log: system {best[0]}, which has most IMU data, "
            f"was taken and {others} left out; choose another by its system id"
        )
    stamps, arrivals = _anchors(log, best)
    since, until = _longest_boot(stamps, arrivals, log)
    inside = (arrivals >= since) & (arrivals < until)
    offset, centre = 0, 0
    if inside.any():
        offset = int(np.sort(arrivals[inside] - stamps[inside])[np.count_nonzero(inside) // 2])
        centre = int(np.sort(stamps[inside])[np.count_nonzero(inside) // 2])
    else:
        log.problems.append("no message in the telemetry log carries the autopilot's time")
    return Autopilot(log, best[0], best[1], since, until, offset, centre)


def _speakers(log: TelemetryLog) -> dict[tuple[int, int], int]:
    """Return the autopilots (system, component) with the number of their IMU messages."""
    counts: Counter[tuple[int, int]] = Counter()
    beats = log.messages("HEARTBEAT")
    real = beats.data["autopilot"] != _INVALID_AUTOPILOT
    for who in set(zip(beats.system[real].tolist(), beats.component[real].tolist(), strict=True)):
        counts[who] += 0
    for name in IMU_MESSAGES:
        found = log.messages(name)
        counts.update(zip(found.system.tolist(), found.component.tolist(), strict=True))
    return dict(counts)


def _anchors(log: TelemetryLog, who: tuple[int, int]) -> tuple[Stamps, Stamps]:
    """Return stamps since boot and arrivals of one speaker's commonest stamped message."""
    best: tuple[Stamps, Stamps] = (np.empty(0, dtype=np.int64), np.empty(0, dtype=np.int64))
    for name in _ANCHORS:
        found = log.messages(name)
        own = found[(found.system == who[0]) & (found.component == who[1])]
        stamp = boot_stamps(own)
        if stamp is not None and len(own) > len(best[0]):
            best = stamp, own.arrival_ns
    return best


def _longest_boot(stamps: Stamps, arrivals: Stamps, log: TelemetryLog) -> tuple[int, int]:
    """Return the arrivals between which the autopilot did not restart, for the boot with most messages."""
    everything = (int(np.iinfo(np.int64).min), int(np.iinfo(np.int64).max))
    if len(stamps) < 2:
        return everything
    # A restart: the stamps fall back and stay there. A single damaged stamp comes back at once.
    back = np.flatnonzero(np.diff(stamps) < -_RESTART_NS) + 1
    highest = np.maximum.accumulate(stamps)
    stays = [b for b in back.tolist() if np.median(stamps[b : b + 5]) < np.median(stamps[max(b - 5, 0) : b])]
    stays = [b for b in stays if stamps[b] < highest[b - 1] - _RESTART_NS]
    if not stays:
        return everything
    bounds = [0, *stays, len(stamps)]
    sizes = np.diff(bounds)
    k = int(np.argmax(sizes))
    log.problems.append(
        f"the autopilot restarted {len(stays)} times during the telemetry log: only the longest part "
        f"({sizes[k]} of {len(stamps)} messages with its time) is imported"
    )
    since = everything[0] if k == 0 else int(arrivals[bounds[k]])
    until = everything[1] if k == len(sizes) - 1 else int(arrivals[bounds[k + 1]])
    return since, until

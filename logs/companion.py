"""What the computer beside the autopilot says in a telemetry log: clock exchanges and vision fixes."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from estimation.frames import R_CB_NOMINAL
from logs.recording import Series
from logs.sensors import Floats, Stamps, Times, timesync_series, vision_series
from logs.stamps import near, to_ns
from logs.vehicles import Autopilot

_BODY_FRAMES = (8, 12)
_LONGEST_TRIP_NS = 1_000_000_000
_LATEST_CLOCK_NS = 4_000_000_000_000_000_000
ARRIVAL = "arrival"
"""Value of a channel's entry ``stamps`` where these tell nothing but when a fix arrived (else ``own``)."""
_EARLIEST_NS, _LATEST_NS = -100_000_000, 5_000_000_000


@dataclass(slots=True)
class Companion:
    """The companion's series, its clock's constant to the arrivals (None: unknown), and what was wrong."""

    series: list[Series]
    offset_ns: int | None
    problems: list[str]


def read_companion(autopilot: Autopilot) -> Companion:
    """Return the clock exchanges and the vision fixes that others than the autopilot sent or asked for."""
    out = Companion([], None, [])
    sender = _fix_sender(autopilot)
    exchanges = _exchanges(autopilot, sender)
    if exchanges is not None:
        out.offset_ns, series = exchanges
        out.series += [series] if len(series) else []
    out.series += _fixes(autopilot, out)
    return out


def _fix_sender(autopilot: Autopilot) -> tuple[int, int] | None:
    """Return who sent most LANDING_TARGET messages."""
    found = autopilot.others("LANDING_TARGET")
    if not len(found):
        return None
    who, counts = np.unique(np.stack([found.system, found.component]), axis=1, return_counts=True)
    best = int(np.argmax(counts))
    return int(who[0, best]), int(who[1, best])


def _exchanges(autopilot: Autopilot, sender: tuple[int, int] | None) -> tuple[int, Series] | None:
    """Return the asking clock's constant to the arrivals and the exchanges it began.

    A request (tc1 = 0) gives the asker's time ts1; the autopilot's reply repeats ts1 and adds its own time
    tc1. The asker's time at the reply is not in the messages: it is ts1 plus the difference of the two
    arrivals. Replies whose request is not in the log, and what the autopilot asked itself, are passed over.
    """
    asked = autopilot.others("TIMESYNC")
    ts1 = asked.data["ts1"]
    asked = asked[(asked.data["tc1"] == 0) & (ts1 >= 0) & (ts1 < _LATEST_CLOCK_NS)]
    if not len(asked):
        return None
    own = (asked.system == sender[0]) & (asked.component == sender[1]) if sender is not None else None
    if own is None or not own.any():
        who, counts = np.unique(np.stack([asked.system, asked.component]), axis=1, return_counts=True)
        best = int(np.argmax(counts))
        own = (asked.system == who[0, best]) & (asked.component == who[1, best])
    asked = asked[own]
    sent = asked.data["ts1"]
    offset = int(np.sort(asked.arrival_ns - sent)[len(sent) // 2])
    replies = autopilot.messages("TIMESYNC")
    replies = replies[replies.data["tc1"] != 0]
    order = np.argsort(sent, kind="stable")
    place = np.minimum(np.searchsorted(sent[order], replies.data["ts1"]), len(sent) - 1)
    request = order[place]
    trip = replies.arrival_ns - asked.arrival_ns[request]
    good = (sent[request] == replies.data["ts1"]) & (trip >= 0) & (trip < _LONGEST_TRIP_NS)
    good &= near(replies.data["tc1"], autopilot.centre_ns)
    _, first = np.unique(replies.data["ts1"][good], return_index=True)
    rows = np.flatnonzero(good)[np.sort(first)]
    remote = replies.data["tc1"][rows].copy()
    sent = sent[request[rows]].copy()
    times = Times(remote, replies.arrival_ns[rows].copy())
    return offset, timesync_series(times, sent, remote, sent + trip[rows])


def _fixes(autopilot: Autopilot, out: Companion) -> list[Series]:
    """Return LANDING_TARGET messages as vision fixes, P^c = R_cb P^b for the nominal camera."""
    found = autopilot.others("LANDING_TARGET")
    if not len(found):
        return []
    data = found.data
    given = (data["position_valid"] == 1) & np.isin(data["frame"], _BODY_FRAMES)
    aimed = (data["position_valid"] == 0) & (data["distance"] > 0.0)
    body: Floats = np.full((len(found), 3), np.nan)
    for k, axis in enumerate("xyz"):
        body[given, k] = data[axis][given]
    with np.errstate(invalid="ignore", over="ignore"):
        across = np.tan(data["angle_x"][aimed].astype(np.float64))
        along = -np.tan(data["angle_y"][aimed].astype(np.float64))
        depth = data["distance"][aimed] / np.sqrt(along**2 + across**2 + 1.0)
    body[aimed] = np.stack([along * depth, across * depth, depth], axis=1)
    usable = given | aimed
    if not usable.all():
        out.problems.append(
            f"{np.count_nonzero(~usable)} LANDING_TARGET messages hold no position in the body frame and no "
            "distance: they are no vision fixes"
        )
    if not usable.any():
        return []
    stamps = to_ns(found.data["time_usec"])
    usable &= near(stamps, int(np.median(stamps[usable])))
    found, body = found[usable], body[usable]
    stamps, clock, own = _stamps(stamps[usable], found.arrival_ns, autopilot, out)
    metadata = {
        "stamps": "own" if own else ARRIVAL,
        "message": "LANDING_TARGET",
        "mounting": "nominal: looking straight down, image top forward",
        "covariance": "not given by the source",
    }
    return [vision_series(Times(stamps, found.arrival_ns, clock), body @ R_CB_NOMINAL.T, metadata)]


def _stamps(
    stamps: Stamps, arrivals: Stamps, autopilot: Autopilot, out: Companion
) -> tuple[Stamps, str, bool]:
    """Return the fixes' stamps, their clock (the one by which they arrive soon after their stamp), and whether the
    stamps tell more than when a fix arrived."""
    constants = {"companion": out.offset_ns, "autopilot": autopilot.offset_ns, "utc": 0}
    for clock, constant in constants.items():
        if constant is None or not stamps.any():
            continue
        delay = int(np.sort(arrivals - stamps)[len(stamps) // 2]) - constant
        if not _EARLIEST_NS <= delay <= _LATEST_NS:
            continue
        if clock != "utc":
            return stamps, clock, True
        out.offset_ns = out.offset_ns or 0
        return stamps - out.offset_ns, "companion", True
    if stamps.any() and out.offset_ns is None:
        out.offset_ns = int(np.sort(arrivals - stamps)[len(stamps) // 2])
        out.problems.append(
            "the vision fixes' clock is tied to no other in this log (no TIMESYNC): it is taken to be "
            "right when they arrived, so their latency is unknown"
        )
        return stamps, "companion", False
    out.problems.append("the vision fixes carry no usable time: they are stamped with their arrival")
    out.offset_ns = out.offset_ns or 0
    return arrivals - out.offset_ns, "companion", False

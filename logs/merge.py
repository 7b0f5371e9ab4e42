"""Two logs of one flight, the autopilot's own and a telemetry log, as one recording.

Both carry the autopilot's time since boot, so their stamps agree as they are. Arrivals do not: a telemetry
log has the recorder's, the autopilot's log none. The autopilot's messages are therefore given the arrivals
that the recorder's clock would show: their stamps plus the telemetry log's constant. The companion's clock
comes with the telemetry log and is tied to the autopilot's by the TIMESYNC exchanges in it.
"""

from __future__ import annotations

import numpy as np

from logs.ardupilot import VISION_HINT
from logs.errors import LogError
from logs.recording import Recording, Series
from logs.sensors import Times

_SAME_BOOT_NS = 2_000_000_000
_OFF_NS = 2_000_000_000
_SPAN_MARGIN_NS = 100_000_000


def merge(onboard: Recording, telemetry: Recording, names: tuple[str, str] = ("log", "tlog")) -> Recording:
    """Return one recording of a flight from its autopilot's log and its telemetry log.

    A topic that both have is taken from the autopilot's log, which is faster and exacter; texts outside its
    time are taken from the telemetry log. ``names`` are the files', for errors and metadata.

    Raises LogError when the two are of different vehicles or flights, or do not overlap.
    """
    _check_same_flight(onboard, telemetry, names)
    out = Recording()
    offset = telemetry.clock_offsets_ns["autopilot"]
    for series in onboard.series:
        out.series.append(_rebased(series, offset) if series.clock == "autopilot" else series)
    first, last = _span(onboard)
    taken = {s.topic for s in onboard.series}
    left: dict[str, int] = {}
    added: dict[str, int] = {}
    for series in telemetry.series:
        if series.topic == "/log":
            outside = (series.stamp_ns < first) | (series.stamp_ns > last + _SPAN_MARGIN_NS)
            if outside.any():
                out.series.append(_selected(series, outside))
        elif series.topic in taken:
            left[series.topic] = left.get(series.topic, 0) + len(series)
        else:
            out.series.append(series)
            added[series.topic] = added.get(series.topic, 0) + len(series)
    out.clock_offsets_ns = {**onboard.clock_offsets_ns, **telemetry.clock_offsets_ns}
    _join_records(out, onboard, telemetry)
    out.metadata["deckfix.merge"] = {
        names[0]: ", ".join(sorted(taken)),
        names[1]: ", ".join(f"{t} {n}" for t, n in sorted(added.items())),
        "left_out": ", ".join(f"{t} {n}" for t, n in sorted(left.items())),
        "reason": f"what both logs hold is taken from {names[0]}, which has it faster and exacter",
        "arrivals": f"stamps of {names[0]} plus the constant of the clock that stamped {names[1]}",
    }
    vision = any(s.topic == "/vision/fix" for s in out.series)
    out.problems = [p for p in onboard.problems if not (vision and p == VISION_HINT)] + telemetry.problems
    utc = onboard.clock_offsets_ns.get("autopilot", 0)
    if utc and abs(utc - offset) > _OFF_NS:
        out.problems.append(
            f"the clock that stamped {names[1]} was {(offset - utc) * 1e-9:+.1f} s off GPS time; "
            "arrivals are by that clock"
        )
    return out


def _check_same_flight(onboard: Recording, telemetry: Recording, names: tuple[str, str]) -> None:
    a = onboard.metadata.get("deckfix.source", {})
    b = telemetry.metadata.get("deckfix.source", {})
    both = f"{names[0]} and {names[1]}"
    systems = a.get("system_id"), b.get("system_id")
    if all(systems) and systems[0] != systems[1]:
        raise LogError(
            both,
            f"they are of different vehicles (system {systems[0]} and {systems[1]})",
            "import them one by one, or choose the vehicle by its system id",
        )
    if "px4" in (a.get("autopilot"), b.get("autopilot")) and "ardupilot" in (
        a.get("autopilot"),
        b.get("autopilot"),
    ):
        raise LogError(both, "they are of different autopilots", "import them one by one")
    first, last = _span(onboard)
    begin, end = _span(telemetry)
    if last < begin or end < first:
        raise LogError(
            both,
            f"they do not overlap ({first / 1e9:.0f} to {last / 1e9:.0f} s and {begin / 1e9:.0f} to "
            f"{end / 1e9:.0f} s since boot)",
            "merge logs of one flight only",
        )
    utc = onboard.clock_offsets_ns.get("autopilot", 0), int(b.get("utc_offset_ns", "0"))
    if all(utc) and abs(utc[0] - utc[1]) > _SAME_BOOT_NS:
        raise LogError(
            both,
            f"they are of different flights (the autopilot booted {abs(utc[0] - utc[1]) * 1e-9:.0f} s apart)",
            "merge logs of one flight only",
        )
    if not all(utc):
        _check_same_attitude(onboard, telemetry, both)


def _check_same_attitude(onboard: Recording, telemetry: Recording, both: str) -> None:
    """Compare the autopilot's attitude in both logs, where no UTC tells whether they are of one boot."""
    pair = [r.find("/attitude") for r in (onboard, telemetry)]
    if not all(pair):
        return
    a, b = pair[0][0], pair[1][0]
    inside = (a.stamp_ns >= b.stamp_ns[0]) & (a.stamp_ns <= b.stamp_ns[-1])
    if not inside.any():
        return
    place = np.clip(np.searchsorted(b.stamp_ns, a.stamp_ns[inside]), 0, len(b) - 1)
    dots = np.abs(np.sum(a.data["quaternion"][inside] * b.data["quaternion"][place], axis=1))
    apart = float(np.degrees(2.0 * np.arccos(np.clip(np.nanmedian(dots), 0.0, 1.0))))
    if apart > 10.0:
        raise LogError(
            both,
            f"they are of different flights (attitudes differ by {apart:.0f} deg at equal times since boot)",
            "merge logs of one flight only",
        )


def _span(recording: Recording) -> tuple[int, int]:
    """Return the first and last stamp [ns] of the autopilot's sensors."""
    own = [
        s
        for s in recording.series
        if s.clock == "autopilot" and s.topic not in ("/log", "/timesync") and len(s)
    ]
    if not own:
        return 0, 0
    return min(int(s.stamp_ns[0]) for s in own), max(int(s.stamp_ns[-1]) for s in own)


def _rebased(series: Series, offset_ns: int) -> Series:
    return Series(
        topic=series.topic,
        stamp_ns=series.stamp_ns,
        arrival_ns=series.stamp_ns + offset_ns,
        data=series.data,
        clock=series.clock,
        frame_id=series.frame_id,
        strings=series.strings,
        metadata=series.metadata,
    )


def _selected(series: Series, mask: np.ndarray[tuple[int], np.dtype[np.bool_]]) -> Series:
    times = Times(series.stamp_ns[mask], series.arrival_ns[mask], series.clock)
    made = times.series(series.topic, series.data[mask], metadata=series.metadata)
    made.strings = series.strings
    return made


def _join_records(out: Recording, onboard: Recording, telemetry: Recording) -> None:
    """Take metadata and attachments of both; origins of topics that were left out are left out with them."""
    out.attachments = {**telemetry.attachments, **onboard.attachments}
    out.metadata = {k: dict(v) for k, v in telemetry.metadata.items() if k not in onboard.metadata}
    out.metadata |= {k: dict(v) for k, v in onboard.metadata.items()}
    if "deckfix.source" in telemetry.metadata:
        out.metadata["deckfix.source.telemetry"] = dict(telemetry.metadata["deckfix.source"])
    origins = dict(onboard.metadata.get("deckfix.origin", {}))
    for key, value in telemetry.metadata.get("deckfix.origin", {}).items():
        if key.startswith("truth_") and any(s.topic == "/truth/odometry" for s in onboard.series):
            continue
        origins.setdefault(key, value)
    if origins:
        out.metadata["deckfix.origin"] = origins

"""What goes wrong in a flight that is being flown, as data: a list of mishaps in its scenario.

Times are true seconds of the flight. Messages are lost, moved or falsified before the vehicle or the estimator see
them; the truth is not touched.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Literal

import msgspec
import numpy as np

from estimation.events import AUTOPILOT
from estimation.frames import R_CB_NOMINAL, Array, ned_to_geodetic
from simulation.instruments import Instant, Instruments
from simulation.sensors import CLOCKS

MishapKind = Literal[
    "gps_jump", "gps_drift", "loss", "link_loss", "packet_loss", "camera_freeze", "clock_step", "false_target"
]


class Mishap(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """One thing that goes wrong from ``start_s`` on for ``duration_s``.

    ``gps_jump`` moves positions by ``offset_m`` (NED), ``gps_drift`` draws them away at ``offset_m`` per second, its
    velocities with them; ``loss`` loses the messages of ``sensor``; ``link_loss`` loses all, set-points to the vehicle
    too; ``packet_loss`` loses the ``share`` of all; ``camera_freeze`` repeats the last fix; ``clock_step`` sets the
    autopilot's clock forward by ``by_s``; ``false_target`` sees the target ``offset_m`` away from where it is.
    """

    kind: MishapKind
    start_s: Annotated[float, msgspec.Meta(ge=0.0)]
    duration_s: Annotated[float, msgspec.Meta(gt=0.0)] = 1e6
    sensor: str = "vision"
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    by_s: float = 0.0
    share: Annotated[float, msgspec.Meta(ge=0.0, le=1.0)] = 0.3

    def on(self, t_s: float) -> bool:
        """Tell whether it is so at a time."""
        return self.start_s <= t_s < self.start_s + self.duration_s


def afflict(instruments: Instruments, mishaps: tuple[Mishap, ...], rng: np.random.Generator) -> None:
    """Let mishaps befall a flight's sensors, before it begins."""
    for mishap in mishaps:
        _afflict(instruments, mishap, rng)


def clock_error_ns(mishaps: tuple[Mishap, ...], t_s: float) -> int:
    """Return how far the autopilot's clock is set forward at a time [ns]."""
    return round(1e9 * sum(m.by_s for m in mishaps if m.kind == "clock_step" and m.on(t_s)))


def _afflict(i: Instruments, mishap: Mishap, rng: np.random.Generator) -> None:
    offset = np.array(mishap.offset_m)
    during = (i.content_s >= mishap.start_s) & (i.content_s < mishap.start_s + mishap.duration_s)
    match mishap.kind:
        case "loss":
            i.there &= ~(during & i.of(mishap.sensor))
        case "link_loss":
            i.there &= ~during
        case "packet_loss":
            i.there &= ~(during & (rng.random(len(i.there)) < mishap.share))
        case "clock_step":
            mine = during & (i.rows["clock"] == CLOCKS.index(AUTOPILOT))
            i.rows["stamp_ns"][mine] += round(mishap.by_s * 1e9)
        case "gps_jump":
            i.alter("gps_position", _moved(mishap, lambda _: offset))
        case "gps_drift":
            i.alter("gps_position", _moved(mishap, lambda t: offset * (t - mishap.start_s)))
            i.alter("gps_velocity", _added(mishap, offset))
        case "camera_freeze":
            i.alter("vision", _repeating(mishap))
        case "false_target":
            i.alter("vision", _elsewhere(mishap, offset))


Change = Callable[[Instant, Array | None], Array | None]


def _repeating(mishap: Mishap) -> Change:
    """Repeat the last fix that there was before."""
    last: list[Array | None] = [None]

    def change(now: Instant, values: Array | None) -> Array | None:
        if not mishap.on(now.t_s):
            last[0] = values
        return last[0]

    return change


def _moved(mishap: Mishap, offset: Callable[[float], Array]) -> Change:
    """Move positions by an offset (NED) at each time."""

    def change(now: Instant, values: Array | None) -> Array | None:
        if values is not None and mishap.on(now.t_s):
            values[:3] = ned_to_geodetic(offset(now.t_s), values[:3].copy())
        return values

    return change


def _added(mishap: Mishap, offset: Array) -> Change:
    """Add to the first three values."""

    def change(now: Instant, values: Array | None) -> Array | None:
        if values is not None and mishap.on(now.t_s):
            values[:3] += offset
        return values

    return change


def _elsewhere(mishap: Mishap, offset: Array) -> Change:
    """See the target an offset (NED) away."""

    def change(now: Instant, values: Array | None) -> Array | None:
        if values is not None and mishap.on(now.t_s):
            values[:3] += R_CB_NOMINAL @ now.R_nb.T @ offset
        return values

    return change

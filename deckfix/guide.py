"""Guidance: the velocities of the landing modes, sent to an autopilot that is in GUIDED, armed and in the air.

It lets go at once when the mode is left, the estimate is stale or the link is lost. The pilot engages it again by
selecting GUIDED anew: an autopilot that comes back from a lost link must not find somebody at the stick.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from deckfix.landing_target import Newest
from deckfix.mavlink_link import GUIDED, Vehicle
from estimation.ahead import DeckForecast
from estimation.landing import step
from estimation.landing_config import LandingConfig
from estimation.modes import EXPLANATIONS, Decision, Mode, Progress, Situation

LOCAL_NED = 1
VELOCITY_AND_YAW = 0b0000_1001_1100_0111
"""SET_POSITION_TARGET_LOCAL_NED's type mask: position, acceleration and yaw rate are ignored."""
RATE_HZ = 20.0


@dataclass(slots=True)
class Guide:
    """Decides, and says what to send. ``engaged`` tells whether set-points go out; ``why`` why not."""

    landing: LandingConfig
    engaged: bool = False
    why: str = "waiting for GUIDED"
    progress: Progress = field(default_factory=Progress)
    decision: Decision | None = None
    _barred: bool = False

    def look(self, vehicle: Vehicle, newest: Newest | None, now_ns: int, alive: bool) -> None:
        """Take note of the autopilot's mode and of what is wrong, as soon as either may have changed."""
        why = self._wrong(vehicle, newest, now_ns, alive)
        if alive and vehicle.mode != GUIDED:
            self._barred = False
        elif why and self.engaged:
            self._barred = True
        if not why and self._barred:
            why = "let go; select GUIDED anew"
        if (self.engaged and why) or (not self.engaged and not why):
            self.progress, self.decision = Progress(), None
        self.engaged, self.why = not why, why

    def _wrong(self, vehicle: Vehicle, newest: Newest | None, now_ns: int, alive: bool) -> str:
        if not alive:
            return "the link is lost"
        if vehicle.mode != GUIDED:
            return f"the autopilot is in {vehicle.mode_name}"
        if newest is None or not newest.age_s(now_ns) <= self.landing.stale_s:
            return "the estimate is stale"
        if not vehicle.armed:
            return "disarmed"
        # On the deck the state machine must still be told of the contact.
        if not vehicle.in_air and not (self.engaged and vehicle.on_ground):
            return "not in the air"
        return ""

    def decide(
        self, newest: Newest, now_ns: int, forecast: DeckForecast | None, on_deck: bool
    ) -> Decision | None:
        """Return the next decision where engaged; ``now_ns`` is on the companion's clock."""
        if not self.engaged:
            return None
        t_ns = newest.estimate.t_ns + (now_ns - newest.arrival_ns)
        age = newest.seen_age_s(now_ns)
        situation = Situation(t_ns, newest.estimate, age, forecast, on_deck)
        self.progress, self.decision = step(self.progress, situation, self.landing)
        return self.decision

    @property
    def words(self) -> str:
        """Mode and reason, or why nothing is sent."""
        if self.decision is None:
            return self.why or "engaged"
        return f"{self.decision.mode.name}: {EXPLANATIONS[self.decision.reason]}"


def set_point(messages: Any, vehicle: Vehicle, decision: Decision, time_ms: int) -> Any | None:
    """Return the velocity set-point of a decision, or None where nothing is to be flown."""
    if decision.mode in (Mode.IDLE, Mode.LANDED) or not np.isfinite(decision.velocity_mps).all():
        return None
    north, east, down = (float(v) for v in decision.velocity_mps)
    yaw = decision.yaw_rad if math.isfinite(decision.yaw_rad) else 0.0
    return messages.MAVLink_set_position_target_local_ned_message(
        time_ms % (1 << 32), vehicle.system, vehicle.component, LOCAL_NED, VELOCITY_AND_YAW,
        0.0, 0.0, 0.0, north, east, down, 0.0, 0.0, 0.0, yaw, 0.0,
    )  # fmt: skip

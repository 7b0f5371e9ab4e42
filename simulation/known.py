"""What is true of a simulated flight at the times of its estimates, and which part of the flight they belong to."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from estimation.events import AUTOPILOT
from estimation.modes import Mode
from estimation.output import Run
from simulation.flight import SimulatedFlight
from simulation.jets import Array
from simulation.sensors import Clock, Place, SlowError, Times, truth_at
from simulation.trajectory import PHASES
from simulation.world import Flown

TRACKING_S = 12.0
"""The first part of a hover in sight of the deck, in which its heave is not learned yet."""
PARTS = (*PHASES, "tracking", "blind")
"""Parts of a flight by plan that are judged by themselves: the phases, and of a hover that sees the deck what comes
first and what is blind; the rest of it is ``hover``."""
MODES = (Mode.SEARCH, Mode.TRACKING, Mode.OBSERVATION, Mode.LANDING, Mode.ABORT)
MODE_PARTS = tuple(mode.name.lower() for mode in MODES)
"""Parts of a landing that was flown: its modes; what comes before and after them is not judged."""


@dataclass(frozen=True, slots=True)
class Known:
    """The truth at the times of a run's estimates.

    ``position_m``, ``velocity_mps`` (n, 3) NED about the place's origin, ``quaternion`` (n, 4) body to NED; ``deck_m``,
    ``deck_mps`` (n, 3) the platform's, of no rows where there is none; ``slow`` the sensors' slow errors by the state's
    block; ``part_at`` gives the index in ``parts`` of true times, -1 where nothing is judged; ``contact_s``
    and ``end_s`` are the true times of the touchdown and of the end, and ``clock`` is the inertial one.
    """

    clock: Clock
    place: Place
    position_m: Array
    velocity_mps: Array
    quaternion: Array
    deck_m: Array
    deck_mps: Array
    slow: dict[str, SlowError]
    parts: tuple[str, ...]
    part_at: Callable[[Array], Times]
    contact_s: float
    end_s: float


def known_of_flight(flight: SimulatedFlight, run: Run) -> Known:
    """Return the truth of a flight by plan at the times of a run's estimates."""
    own = truth_at(flight.trajectory, flight.clock, run.t_ns)
    deck = flight.trajectory.platform.motion(flight.clock.true_s(run.t_ns)).position
    plan = flight.trajectory.plan
    return Known(
        flight.clock,
        flight.place,
        own.position_m,
        own.velocity_mps,
        own.quaternion,
        deck[0],
        deck[1],
        flight.slow,
        PARTS,
        lambda t_s: _phase_at(flight, t_s),
        plan.touchdown_s,
        plan.duration_s,
    )


def known_of_landing(flown: Flown, run: Run) -> Known:
    """Return the truth of a landing that was flown at the times of a run's estimates, between its rows of 50 Hz."""
    clock = flown.mission.clocks.get(AUTOPILOT, Clock())
    at = clock.true_s(run.t_ns)
    own = np.stack([np.interp(at, flown.t_s, c) for c in flown.truth[:, :10].T], axis=1)
    deck = np.stack([np.interp(at, flown.t_s, c) for c in flown.deck[:, :6].T], axis=1)
    quaternion = own[:, 6:10] / np.linalg.norm(own[:, 6:10], axis=1, keepdims=True)
    modes = np.array(
        [MODES.index(d.mode) if d.mode in MODES else -1 for d in flown.decisions], dtype=np.int64
    )
    decided = flown.decided_s
    end_s = float(flown.t_s[-1]) if flown.contact is None else flown.contact.t_s

    def part_at(t_s: Array) -> Times:
        index = np.searchsorted(decided, t_s, side="right") - 1
        part: Times = np.where(index < 0, -1, modes[np.maximum(index, 0)])
        return part

    return Known(
        clock,
        flown.place,
        own[:, :3],
        own[:, 3:6],
        quaternion,
        deck[:, :3],
        deck[:, 3:6],
        flown.instruments.slow,
        MODE_PARTS,
        part_at,
        end_s,
        end_s,
    )


def _phase_at(flight: SimulatedFlight, t_s: Array) -> Times:
    index = flight.trajectory.phase(t_s)
    vision = flight.scenario.streams.vision
    if vision is None or vision.view is None:
        return index
    begin, end = flight.trajectory.plan.bounds_s["hover"]
    seeing = max([b for a, b in vision.view.hidden_s if a < begin < b], default=begin)
    hover = index == PHASES.index("hover")
    index[hover & (t_s < seeing + TRACKING_S)] = PARTS.index("tracking")
    for a, b in vision.view.hidden_s:
        index[hover & (t_s >= a) & (t_s < b)] = PARTS.index("blind" if a > begin and b < end else "cruise")
    return index

"""The platform against its truth, and the raw fixes beside it.

Relative position is P_uav - P_platform in NED, as everywhere. It has no datum: nothing is taken off its errors. The
platform's own place and height hang on the origin, so that its errors are less their constant part.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from deckfix.reference import (
    Column,
    Errors,
    Trajectory,
    Window,
    column,
    median_in_window,
    nees,
    rms,
    rmse_block,
)
from estimation.config import Config
from estimation.events import EventBatch, Kind
from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_to_matrix
from estimation.outcome import Outcome
from estimation.output import Run

Array = NDArray[np.float64]
Times = NDArray[np.int64]

SETTLING_S = 5.0
"""The platform is judged from so long after its first fix."""
DRIFT_S = 20.0
"""What changes more slowly than this is level and drift, not heave: a running mean over so long."""
ARRIVED_S = 0.5
"""The deck's height is known from so long after the first fix: fixes arrive later than what they show."""


@dataclass(frozen=True, slots=True)
class DeckErrors:
    """The platform's estimates less the truth, at the estimates' times.

    ``relative`` has 6 degrees of freedom (position, velocity), ``platform`` 2 (height, its rate). ``heave_m`` (n,) is
    the height's error (up) less its level and slow drift. ``judged`` is from 5 s after the first fix to 0.5 s before
    contact.
    """

    relative: Errors
    platform: Errors
    heave_m: Array
    judged: Window

    def blocks(self) -> dict[str, dict[str, object]]:
        """Return the entries of ``replay --json`` below ``truth``."""
        out = {
            "relative": rmse_block(self.relative, self.judged),
            "platform": rmse_block(self.platform, self.judged),
        }
        heave = rms(self.heave_m[self.judged.inside(self.platform.t_ns)])
        if heave is not None:
            out["platform"]["heave_rmse_m"] = heave
        return {name: block for name, block in out.items() if block}


@dataclass(frozen=True, slots=True)
class RawFixes:
    """Vision fixes as they came: ``t_ns`` (m,) of their content on the inertial clock, ``relative_m`` (m, 3) what each
    says of P_uav - P_platform (NED) with the estimated attitude, and whether it was fused."""

    t_ns: Times
    relative_m: Array
    fused: NDArray[np.bool_]


def truth_of_deck(vehicle: Trajectory, platform: Trajectory) -> Trajectory | None:
    """Return the vehicle's position and velocity relative to the platform, at the platform's times."""
    if vehicle.position_m is None or platform.position_m is None:
        return None
    t = platform.position_m.t_ns
    position = column(t, vehicle.position_m.at(t) - platform.position_m.values)
    velocity = None
    if vehicle.velocity_mps is not None and platform.velocity_mps is not None:
        tv = platform.velocity_mps.t_ns
        velocity = column(tv, vehicle.velocity_mps.at(tv) - platform.velocity_mps.values)
    return None if position is None else Trajectory(position, velocity, None)


def compare_deck(run: Run, vehicle: Trajectory, platform: Trajectory, judged: Window) -> DeckErrors | None:
    """Return the errors of a run's platform; None where it was off, never seen, or the truth lacks positions."""
    relative = truth_of_deck(vehicle, platform)
    first = first_fix_ns(run)
    if relative is None or platform.position_m is None or first is None or not run.deck.shape[1]:
        return None
    window = Window(first + round(SETTLING_S * 1e9), judged.end_ns, judged.contact_ns)
    t = run.t_ns
    ours = _errors(t, run.deck[:, :3], run.deck[:, 3:6], relative)
    values, dof = nees(np.hstack([ours.position_m, ours.velocity_mps]), run.deck_covariance[:, :6, :6])
    ours = Errors(t, ours.position_m, ours.velocity_mps, ours.attitude_rad, np.zeros(3), values, dof)
    place, speed = run.position_m - run.deck[:, :3], run.velocity_mps - run.deck[:, 3:6]
    deck = _errors(t, place, speed, platform)
    datum = median_in_window(deck.position_m, window.inside(t))
    off = deck.position_m - np.where(np.isfinite(datum), datum, 0.0)
    vertical = np.stack([-off[:, 2], -deck.velocity_mps[:, 2]], axis=1)
    values, dof = nees(vertical, run.deck_covariance[:, 6:8, 6:8])
    deck = Errors(t, off, deck.velocity_mps, deck.attitude_rad, datum, values, dof)
    inside = window.inside(t)
    up = np.where(inside, -off[:, 2], np.nan)
    return DeckErrors(ours, deck, up - slow(t, up), window)


def first_fix_ns(run: Run) -> int | None:
    """Return the time of the first vision fix that was fused."""
    times = fused_fixes_ns(run)
    return int(times[0]) if len(times) else None


def fused_fixes_ns(run: Run) -> Times:
    """Return the times of the vision fixes that were fused, ascending."""
    r = run.records
    names = [i for i, n in enumerate(run.sensors) if n.split("/")[0] == "vision"]
    times: Times = np.sort(
        r["t_ns"][np.isin(r["sensor"], names) & (r["outcome"] <= int(Outcome.DOWNWEIGHTED))]
    )
    return times


def height_seen_later(run: Run, reach_s: float = 0.5) -> Column | None:
    """Return the estimated height of the deck (up), where a fix was fused in the ``reach_s`` before; NaN-free."""
    times = fused_fixes_ns(run)
    if not len(times) or not run.deck.shape[1]:
        return None
    last = np.searchsorted(times, run.t_ns, side="right") - 1
    seen = (last >= 0) & (run.t_ns - times[last.clip(0)] <= reach_s * 1e9)
    seen &= run.t_ns >= _level_known_ns(times)
    return column(run.t_ns[seen], run.deck[seen, 6:7])


def true_height(run: Run, platform: Trajectory) -> Column | None:
    """Return the true height of the deck (up) on the estimates' level; None where the deck was never seen.

    The height above the origin is known to within the drift of GPS and barometer, of which no forecast can know: the
    truth is shifted by the running mean of its difference to the estimate. Only what was estimated with a fix counts
    in it: before the first one the estimate knows no level.
    """
    times = fused_fixes_ns(run)
    if platform.position_m is None or not run.deck.shape[1] or not len(times):
        return None
    up = -platform.position_m.at(run.t_ns)[:, 2]
    known = (run.t_ns >= _level_known_ns(times)) & np.isfinite(up)
    if not known.any():
        return None
    shift = slow(run.t_ns, np.where(known, run.deck[:, 6] - up, np.nan))
    first = int(np.argmax(known))
    shift[:first] = shift[first]
    return column(run.t_ns, (up + shift)[:, None])


def _level_known_ns(fused_ns: Times) -> int:
    return int(fused_ns[0]) + round(ARRIVED_S * 1e9)


def slow(t_ns: Times, values: Array, over_s: float = DRIFT_S) -> Array:
    """Return the running mean of values (n,) over ``over_s``, narrower at the ends; NaN are left out of it."""
    finite = np.isfinite(values)
    total = np.concatenate([[0.0], np.cumsum(np.where(finite, values, 0.0))])
    count = np.concatenate([[0], np.cumsum(finite)])
    half = np.full(len(t_ns), round(0.5e9 * over_s), np.int64)
    if finite.any():
        # An even window on both sides: a lopsided one would take heave for drift.
        first, last = t_ns[finite][0], t_ns[finite][-1]
        half = np.minimum(half, np.maximum(np.minimum(t_ns - first, last - t_ns), round(0.25e9 * over_s)))
    low = np.searchsorted(t_ns, t_ns - half)
    high = np.searchsorted(t_ns, t_ns + half, side="right")
    n = count[high] - count[low]
    mean: Array = np.where(n > 0, (total[high] - total[low]) / np.maximum(n, 1), np.nan)
    return mean


def raw_fixes(run: Run, batch: EventBatch, config: Config) -> RawFixes | None:
    """Return what each vision fix says by itself; None where there is none, or no estimate."""
    rows = batch.rows[batch.rows["kind"] == int(Kind.VISION)]
    if not len(rows) or len(run.t_ns) < 2:
        return None
    names = [
        i for i, n in enumerate(run.sensors) if n in {batch.sensors[k] for k in np.unique(rows["sensor"])}
    ]
    records = run.records[np.isin(run.records["sensor"], names)]
    records = records[np.argsort(records["stamp_ns"], kind="stable")]
    if not len(records):
        return None
    place = np.searchsorted(records["stamp_ns"], rows["stamp_ns"]).clip(0, len(records) - 1)
    match = records["stamp_ns"][place] == rows["stamp_ns"]
    rows, told = rows[match], records[place[match]]
    t = told["t_ns"]
    inside = (t >= run.t_ns[0]) & (t <= run.t_ns[-1]) & np.isfinite(rows["value"][:, :3]).all(axis=1)
    rows, told, t = rows[inside], told[inside], t[inside]
    if not len(t):
        return None
    near = np.searchsorted(run.t_ns, t).clip(0, len(run.t_ns) - 1)
    mount = quat_to_matrix(euler_to_quat(*config.vision.mount_rpy_rad))
    body = rows["value"][:, :3] @ R_CB_NOMINAL @ mount.T + np.array(config.vision.lever_arm_m)
    R_nb = np.stack([quat_to_matrix(q) for q in run.quaternion[near]])
    relative = -np.einsum("nij,nj->ni", R_nb, body)
    return RawFixes(t, relative, told["outcome"] <= int(Outcome.DOWNWEIGHTED))


def _errors(t_ns: Times, position_m: Array, velocity_mps: Array, reference: Trajectory) -> Errors:
    nothing = np.full((len(t_ns), 3), np.nan)
    position = position_m - reference.position_m.at(t_ns) if reference.position_m else nothing
    velocity = velocity_mps - reference.velocity_mps.at(t_ns) if reference.velocity_mps else nothing
    return Errors(t_ns, position, velocity, nothing, np.zeros(3), np.full(len(t_ns), np.nan), 0)

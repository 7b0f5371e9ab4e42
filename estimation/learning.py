"""Learning the platform's motion in flight: from the fixes that are final to the parameters of the filter's blocks.

Heave is learned often, and reported; sway and the drift of the place, which only the filter uses, in turn and less
often. All three are spectra learned from where each fix shows the deck (``estimation.heave``).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from estimation.deck import (
    ANY_SEA,
    DRIFT_TIME_S,
    HEAVE_PARAMETERS,
    OFFSET_WALK,
    SWAY_NORTH,
    SWAY_OMEGA,
    heave_matrix,
    heave_stationary,
)
from estimation.events import Kind
from estimation.frames import Array
from estimation.heave.bandpass import BandPass
from estimation.heave.model import HeaveModel, fit
from estimation.outcome import Outcome
from estimation.rows import Rows
from estimation.watch import LET_GO

LEAST_S = 8.0
"""Shortest observation that a spectrum is learned from [s]."""
LEAST_SKILL = 0.5
"""Share of the variance half a second ahead that a model must explain before its spectrum's form is taken up; of a
motion that is foreseen worse only size and speed are."""
LEAST_SEA = 0.5
"""Share of the power that must be as fast as a sea's; what is slower is the wander of the vehicle's own height."""
HIDDEN = 0.5
"""Density, as a share of the noise's, of a sea that would not be noticed."""
SETTLING_S, GAP_S = 6.0, 2.0
"""So long after the first fix, and after a gap of the second length, the level is still finding its place [s]."""
BEFORE_S = 3.0
"""Of the time before a learned heave was let go, so much belongs to what came then [s]."""
SWAY_S = 12.0
"""Shortest observation that the sway is learned from [s]."""
SWAY_EVERY = 6
"""So many fits of the heave to one of the sway, north and then east."""
SWAY_LOWEST_HZ = 0.07
"""Motion slower than this is the place's drift, and no sway."""
STILL_M = 0.01
"""Smallest 1-sigma that a platform is believed to move with [m]."""
SEA_RADPS = (0.44, 5.0)
"""Angular frequencies that a motion without a form of its own is taken to have."""


@dataclass(slots=True)
class MotionLearner:
    """Collects where each fix shows the deck, and fits a model every ``every_s`` to the last ``window_s``.

    The times of the fits are whole multiples of ``every_s`` of the inertial clock. ``parameters`` (11,) are the prior's
    at first, and then what was learned (``estimation.deck``).
    """

    every_s: float
    window_s: float
    parameters: Array
    model: HeaveModel | None = None
    block: BandPass | None = None
    sway: list[HeaveModel | None] = field(default_factory=lambda: [None, None])
    _t_ns: list[int] = field(default_factory=list)
    _seen: list[list[float]] = field(default_factory=list)
    _due_ns: int | None = None
    _settled_ns: int = 0
    _begin_ns: int | None = None
    _count: int = 0
    _prior: Array = field(init=False)

    def __post_init__(self) -> None:
        """Keep the prior."""
        self._prior = self.parameters.copy()

    def take(self, rows: Rows) -> list[tuple[int, HeaveModel, Array]]:
        """Take rows that are final, in order; return for each fit that came due its time, the heave's model and the
        parameters from then on.
        """
        every = int(self.every_s * 1e9)
        seen = (rows.kind == Kind.VISION) & (rows.outcome <= Outcome.DOWNWEIGHTED) & (rows.seen[:, 1] > 0.0)
        results = []
        if self._due_ns is None:
            if not seen.any():
                return []
            self._due_ns = (int(rows.t_ns[seen][0]) // every + 1) * every
        waiting = rows.take(np.flatnonzero(seen))
        last = int(rows.t_ns[-1])
        at = 0
        while self._due_ns < last:
            stop = int(np.searchsorted(waiting.t_ns, self._due_ns, side="right"))
            self._keep(waiting.take(slice(at, stop)))
            at = stop
            model = self._fit()
            if model is not None:
                results.append((self._due_ns, model, self.parameters.copy()))
            self._due_ns += every
        self._keep(waiting.take(slice(at, len(waiting))))
        return results

    def _keep(self, rows: Rows) -> None:
        for i in np.flatnonzero(rows.reset == LET_GO):
            self._begin_ns = int(rows.t_ns[i]) - int(BEFORE_S * 1e9)
            self.model = self.block = None
            self.parameters[:HEAVE_PARAMETERS] = self._prior[:HEAVE_PARAMETERS]
        for t_ns, seen in zip(rows.t_ns.tolist(), rows.seen.tolist(), strict=True):
            if not self._t_ns or t_ns - self._t_ns[-1] > GAP_S * 1e9:
                self._settled_ns = t_ns + int(SETTLING_S * 1e9)
            self._t_ns.append(t_ns)
            self._seen.append(seen if t_ns >= self._settled_ns else [*seen[:6], math.nan])

    def _drift(self, level: Array) -> Array:
        """Return how far the level (n,) was, at each fix, from what it is at the last; before it had settled (NaN) as
        far as once it had.

        The level follows the error of the vehicle's own height, which is large against a small sea's heave and as slow
        as a swell.
        """
        settled = np.flatnonzero(np.isfinite(level))
        if not len(settled):
            return np.zeros(len(level))
        following = settled[np.minimum(np.searchsorted(settled, np.arange(len(level))), len(settled) - 1)]
        return np.asarray(level[following] - level[settled[-1]])

    def _fit(self) -> HeaveModel | None:
        assert self._due_ns is not None
        begin = self._due_ns - int(self.window_s * 1e9)
        drop = int(np.searchsorted(self._t_ns, begin))
        del self._t_ns[:drop], self._seen[:drop]
        if len(self._t_ns) < 2 or self._t_ns[-1] - self._t_ns[0] < LEAST_S * 1e9:
            return None
        t = (np.array(self._t_ns) - self._due_ns) * 1e-9
        seen = np.array(self._seen)
        now = slice(0 if self._begin_ns is None else int(np.searchsorted(self._t_ns, self._begin_ns)), None)
        if len(t[now]) < 2 or t[-1] - t[now][0] < LEAST_S:
            return None
        height = seen[now, 0] - self._drift(seen[now, 6])
        sigma = np.sqrt(seen[now, 1])
        self.model = fit(t[now], height, sigma, window_s=self.window_s, previous=self.model)
        if self.model.method == "bhr":
            self._take_heave(self.model)
        if t[-1] - t[0] >= SWAY_S:
            axis = self._count % SWAY_EVERY
            if axis < len(self.sway):
                place, sigma = seen[:, 2 + 2 * axis], np.sqrt(seen[:, 3 + 2 * axis])
                self.sway[axis] = fit(t, place, sigma, window_s=self.window_s, previous=self.sway[axis])
                self._take_sway()
            self._count += 1
        return self.model

    def _take_heave(self, model: HeaveModel) -> None:
        sea = float(model.power_m2[2.0 * math.pi * model.frequency_hz >= SEA_RADPS[0]].sum())
        known = model.sd_m >= STILL_M and float(model.skill(0.5)) >= LEAST_SKILL
        if known and sea >= LEAST_SEA * float(model.power_m2.sum()):
            self.block = model.band_pass(previous=self.block)
            self.parameters[:HEAVE_PARAMETERS] = self.block.parameters
            return
        self.block = None
        # A sea of less than the noise's density may be there unseen: it adds to size and speed.
        hidden, top = HIDDEN * model.noise_density_m2ps, SEA_RADPS[1] / (2.0 * math.pi)
        size = math.sqrt(model.sd_m**2 + hidden * top)
        rate = math.sqrt(model.coefficients.rate_variance_m2ps2 + hidden * SEA_RADPS[1] ** 2 * top / 3.0)
        self.parameters[:HEAVE_PARAMETERS] = broad_heave(size, rate, float(self._prior[4]))

    def _take_sway(self) -> None:
        """Take size, speed and drift from the models of north and east that there are."""
        known = [m for m in self.sway if m is not None and m.learned is not None]
        fast = slow = 0.0
        walk = float(self._prior[OFFSET_WALK]) ** 2
        for axis, model in enumerate(self.sway):
            if model is None or model.learned is None:
                continue
            omega, power = 2.0 * math.pi * model.frequency_hz, model.power_m2
            high = model.frequency_hz >= SWAY_LOWEST_HZ
            self.parameters[SWAY_NORTH + axis] = max(STILL_M, math.sqrt(float(power[high].sum())))
            slow += float(power[high].sum())
            fast += float(power[high] @ omega[high] ** 2)
            walk = max(walk, _walk(model) ** 2)
        if known:
            self.parameters[SWAY_OMEGA] = _in_sea(math.sqrt(fast / max(slow, 1e-12)))
            self.parameters[OFFSET_WALK] = math.sqrt(walk)


def broad_heave(sigma_m: float, rate_mps: float, damping: float) -> Array:
    """Return the heave's parameters (7,) of any sea's form, with this damping, that heaves, and heaves at a rate, with
    these standard deviations (the rate within what seas have).
    """
    unit = np.array([1.0, *ANY_SEA, damping, damping, damping])
    stationary, row = heave_stationary(unit), heave_matrix(unit)[5]
    per_omega = math.sqrt(float(row @ stationary @ row / stationary[5, 5]))
    sigma = max(sigma_m, STILL_M)
    omega = _in_sea(rate_mps / (sigma * per_omega))
    unit[1:4] *= omega
    unit[0] = sigma / math.sqrt(heave_stationary(unit)[5, 5])
    return unit


def _walk(model: HeaveModel) -> float:
    """Return the random walk [m/rts] that stands for the motion seen at periods longer than a sway's."""
    assert model.learned is not None
    basis, mean = model.coefficients.basis, model.coefficients.mean.copy()
    fast = np.flatnonzero(model.frequency_hz >= SWAY_LOWEST_HZ)
    mean[fast] = mean[len(model.frequency_hz) + fast] = 0.0
    time = np.linspace(-model.span_s, 0.0, max(16, int(model.span_s)))
    velocity = basis.rates(time) @ mean
    return math.sqrt(float(np.mean(velocity**2)) * DRIFT_TIME_S)


def _in_sea(omega_radps: float) -> float:
    return min(max(omega_radps, SEA_RADPS[0]), SEA_RADPS[1])

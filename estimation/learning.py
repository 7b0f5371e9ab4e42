"""Learning the platform's motion in flight: from the fixes that are final to the parameters of the filter's blocks.

Heave is learned often, and reported; sway and the drift of the place, which only the filter uses, in turn and less
often. All three are spectra learned from where each fix shows the deck (``estimation.heave``), and taken up as chains
(``estimation.band``).
"""

from __future__ import annotations

import importlib
import math
from dataclasses import dataclass, field
from functools import partial

import numpy as np

from estimation.band import BAND_PARAMETERS, band_matrix, band_stationary
from estimation.deck import CHAINS, DRIFT_SPEED, HEAVE, any_sea
from estimation.events import Kind
from estimation.frames import Array
from estimation.heave.bandpass import BandPass
from estimation.heave.model import HeaveModel, fit
from estimation.heave.spectrum import Density
from estimation.one_thread import one_thread
from estimation.outcome import Outcome
from estimation.rows import SEEN_CORRECTED, SEEN_DOUBT, SEEN_LEVEL, SEEN_MOVED, SEEN_PLACE, Rows
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
SWAY_EVERY = 6
"""So many fits of the heave to one of the sway, north and then east."""
SLOW_S = 14.0
"""Means over so long show the drift of the place without its sway [s]."""
SLOW_SIGMA_S = 4.0
"""Width of the average that tells slow from fast: a fifth of it is left at the slowest sea's frequency [s]."""
DRIFT_SEEN = 0.57
"""Share of the variance of the drift's velocity that is left in how far such means move in a second."""
DRIFT_PRIOR = 4.0
"""Weight of the speed that is expected of the drift, in velocities seen: half a minute shows two, on both axes."""
DOWN = 2
"""Of north, east and down the axis that no tilt brings gravity into."""
GRAVITY_MPS2 = 9.81
STILL_M = 0.01
"""Smallest 1-sigma that a platform is believed to move with [m]."""
SEA_RADPS = (0.44, 5.0)
"""Angular frequencies that a motion without a form of its own is taken to have."""


Learned = tuple[int, HeaveModel, dict[int, Array]]
"""When a fit came due, the heave's model, and the parameters of the chains that change by their first place."""


@dataclass(slots=True)
class MotionLearner:
    """Collects where each fix shows the deck, and fits a model every ``every_s`` to the last ``window_s``.

    The times of the fits are whole multiples of ``every_s`` of the inertial clock. ``parameters`` (22,) are the prior's
    at first, and then what was learned (``estimation.deck``); ``blocks`` are the chains whose form was, by their first
    place in them. ``accel_noise`` [m/s^2/rtHz] and ``gyro_noise`` [rad/s/rtHz] are the inertial unit's.
    """

    every_s: float
    window_s: float
    parameters: Array
    accel_noise: float
    gyro_noise: float
    model: HeaveModel | None = None
    blocks: dict[int, BandPass] = field(default_factory=dict)
    sway: list[HeaveModel | None] = field(default_factory=lambda: [None, None])
    _t_ns: list[int] = field(default_factory=list)
    _seen: list[list[float]] = field(default_factory=list)
    _due_ns: int | None = None
    _settled_ns: int = 0
    _begin_ns: int | None = None
    _drifts: list[Array] = field(default_factory=lambda: [np.empty(0), np.empty(0)])
    _count: int = 0
    _changed: set[int] = field(default_factory=set)
    _prior: Array = field(init=False)

    def __post_init__(self) -> None:
        """Keep the prior, and load now what the first fit would stop a flight for."""
        importlib.import_module("scipy.linalg")
        self._prior = self.parameters.copy()

    def take(self, rows: Rows) -> list[Learned]:
        """Take rows that are final, in order; return for each fit that came due its time, the heave's model and the
        chains that change: by their first place in ``parameters``, their parameters from then on (7,) with the speed
        of the place's drift behind them (8,).
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
            with one_thread():
                model = self._fit()
            if model is not None:
                drift = self.parameters[DRIFT_SPEED]
                changed = sorted({HEAVE, *self._changed})
                results.append(
                    (
                        self._due_ns,
                        model,
                        {c: np.array([*self.parameters[c : c + BAND_PARAMETERS], drift]) for c in changed},
                    )
                )
                self._changed.clear()
            self._due_ns += every
        self._keep(waiting.take(slice(at, len(waiting))))
        return results

    def _keep(self, rows: Rows) -> None:
        for i in np.flatnonzero(rows.reset == LET_GO):
            self._begin_ns = int(rows.t_ns[i]) - int(BEFORE_S * 1e9)
            self.model = None
            self.blocks.pop(HEAVE, None)
            self.parameters[:BAND_PARAMETERS] = self._prior[:BAND_PARAMETERS]
        for t_ns, seen in zip(rows.t_ns.tolist(), rows.seen.tolist(), strict=True):
            if not self._t_ns or t_ns - self._t_ns[-1] > GAP_S * 1e9:
                self._settled_ns = t_ns + int(SETTLING_S * 1e9)
            self._t_ns.append(t_ns)
            if t_ns < self._settled_ns:
                for mean in (SEEN_LEVEL, SEEN_PLACE, SEEN_PLACE + 1):
                    seen[mean] = math.nan
            self._seen.append(seen)

    def _drift(self, mean: Array) -> Array:
        """Return how far a mean (n,), the level or a coordinate of the place, was at each fix from what it is at the
        last; before it had settled (NaN) as far as once it had.

        The means follow the errors of the vehicle's own place, which are large against a small sea and as slow as a
        swell.
        """
        settled = np.flatnonzero(np.isfinite(mean))
        if not len(settled):
            return np.zeros(len(mean))
        following = settled[np.minimum(np.searchsorted(settled, np.arange(len(mean))), len(settled) - 1)]
        return np.asarray(mean[following] - mean[settled[-1]])

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
        level = self._drift(seen[now, SEEN_LEVEL])
        height = seen[now, 0] - level + fast_part(t[now], level + seen[now, SEEN_MOVED + DOWN])
        sigma = np.sqrt(seen[now, 1])
        wander = self._wander(t[now], seen[now], DOWN)
        self.model = fit(t[now], height, sigma, window_s=self.window_s, previous=self.model, wander=wander)
        if self.model.method == "bhr":
            self._take(HEAVE, self.model)
        axis = self._count % SWAY_EVERY
        self._count += 1
        if axis < len(self.sway):
            place, sigma = seen[:, 2 + 2 * axis], np.sqrt(seen[:, 3 + 2 * axis])
            mean, moved = self._drift(seen[:, SEEN_PLACE + axis]), seen[:, SEEN_MOVED + axis]
            swing = place - mean + fast_part(t, mean - moved)
            wander = self._wander(t, seen, axis)
            model = fit(t, swing, sigma, window_s=self.window_s, previous=self.sway[axis], wander=wander)
            self.sway[axis] = model
            if model.learned is not None:
                self._take(CHAINS[1 + axis], model)
            self._drifts[axis] = drift_velocity(t, place)
            self.parameters[DRIFT_SPEED] = self._drift_speed()
        return self.model

    def _wander(self, t_s: Array, seen: Array, axis: int) -> Density:
        """Return the density of the wander of what was seen (n, 18) along an axis: north, east, down."""
        corrected = np.maximum(np.diff(seen[:, SEEN_CORRECTED + axis]), 0.0).sum() / (t_s[-1] - t_s[0])
        tilt_noise = 0.0 if axis == DOWN else self.gyro_noise
        variance = float(seen[:, SEEN_DOUBT + axis].mean())
        return partial(inertial_wander, variance, float(corrected), self.accel_noise, tilt_noise)

    def _drift_speed(self) -> float:
        """Return the 1-sigma [m/s] of the drift's velocity: what was seen of it, and the prior in its weight."""
        seen = np.concatenate(self._drifts)
        square = DRIFT_PRIOR * float(self._prior[DRIFT_SPEED]) ** 2 + float(seen @ seen) / DRIFT_SEEN
        return math.sqrt(square / (DRIFT_PRIOR + len(seen)))

    def _take(self, chain: int, model: HeaveModel) -> None:
        """Take a chain's form from a model where the model foresees the motion, else its size and speed."""
        omega, power = 2.0 * math.pi * model.frequency_hz, model.power_m2
        fast = omega >= SEA_RADPS[0]
        share = float(power[fast].sum()) / max(float(power.sum()), 1e-12)
        known = model.sd_m >= STILL_M and float(model.skill(0.5)) >= LEAST_SKILL
        # Slow motion of the place is its drift, or that of the vehicle's own, and no sway.
        known = known and (share >= LEAST_SEA if chain == HEAVE else share * model.sd_m**2 >= STILL_M**2)
        if known:
            lowest_hz = 0.0 if chain == HEAVE else SEA_RADPS[0] / (2.0 * math.pi)
            block = model.band_pass(previous=self.blocks.get(chain), lowest_hz=lowest_hz)
            self.blocks[chain] = block
            self._put(chain, block.parameters)
            return
        self.blocks.pop(chain, None)
        # A sea of less than the noise's density may be there unseen: it adds to size and speed.
        hidden, top = HIDDEN * model.noise_density_m2ps, SEA_RADPS[1] / (2.0 * math.pi)
        rate_share = float((power * omega**2)[fast].sum()) / max(float(power @ omega**2), 1e-12)
        if chain == HEAVE:
            share = rate_share = 1.0
        size = math.sqrt(share * model.sd_m**2 + hidden * top)
        speed = rate_share * model.coefficients.rate_variance_m2ps2
        rate = math.sqrt(speed + hidden * SEA_RADPS[1] ** 2 * top / 3.0)
        self._put(chain, broad_motion(size, rate, float(self._prior[chain + 4])))

    def _put(self, chain: int, band: Array) -> None:
        self.parameters[chain : chain + BAND_PARAMETERS] = band
        self._changed.add(chain)


def fast_part(t_s: Array, y: Array) -> Array:
    """Return y (n,) less its slow part: the line through its neighbours, weighted by a Gaussian of ``SLOW_SIGMA_S``.

    Measurements move the vehicle, and what it sees with it, in steps that look like a short sea. Added to a series of
    what was seen, the fast part of how far they moved it leaves above the cut-off what inertia alone would have shown.
    """
    grid = np.arange(t_s[0], t_s[-1] + 1.0, 1.0)
    away = t_s - grid[:, None]
    w = np.exp(-0.5 * (away / SLOW_SIGMA_S) ** 2)
    w0, w1, w2 = w.sum(axis=1), (w * away).sum(axis=1), (w * away**2).sum(axis=1)
    y0, y1 = w @ y, (w * away) @ y
    return np.asarray(y - np.interp(t_s, grid, (w2 * y0 - w1 * y1) / (w0 * w2 - w1**2)))


def inertial_wander(
    velocity_variance: float, corrected: float, accel_noise: float, gyro_noise: float, frequency_hz: Array
) -> Array:
    """Return the one-sided density (m,) [m^2/Hz] of the wander of a series that ``fast_part`` has completed.

    The series' zero moves with the error of the vehicle's velocity. What drives that error is the noise of the
    specific force, a^2, and what measurements correct, c^2 [m^2/s^3]: the squares of their corrections in a second.
    In a steady filter of place and velocity both are alike, and with a^2 + c^2 = 2 n^2 it has the density
    4 n^2 (w^2 + w_b^2) / (w^4 + w_b^4) and the variance sqrt(2) n^2 / w_b, which tells the bandwidth w_b. Where the
    filter does not yet know its biases it corrects more. Horizontally the noise of the angular velocity, which tilts
    gravity, adds to n^2 (derived in docs/concepts.md).
    """
    omega = 2.0 * math.pi * frequency_hz
    noise = 0.5 * (accel_noise**2 + corrected) + (GRAVITY_MPS2 * gyro_noise / omega) ** 2
    band = math.sqrt(2.0) * noise / velocity_variance
    density = 4.0 * noise * (omega**2 + band**2) / (omega**2 * (omega**4 + band**4))
    return np.asarray(density * (1.0 - np.exp(-0.5 * (omega * SLOW_SIGMA_S) ** 2)) ** 2)


def broad_motion(sigma_m: float, rate_mps: float, damping: float) -> Array:
    """Return a chain's parameters (7,) of any sea's form, with this damping, whose displacement and rate have these
    standard deviations (the rate within what seas have).
    """
    unit = any_sea(1.0, 1.0, damping)
    stationary, row = band_stationary(unit), band_matrix(unit)[5]
    per_omega = math.sqrt(float(row @ stationary @ row / stationary[5, 5]))
    sigma = max(sigma_m, STILL_M)
    omega = rate_mps / (sigma * per_omega)
    return any_sea(sigma, min(max(omega, SEA_RADPS[0]), SEA_RADPS[1]), damping)


def drift_velocity(t_s: Array, place_m: Array) -> Array:
    """Return the velocities (k,) [m/s] with which the mean of a place (n,) moves from ``SLOW_S`` to ``SLOW_S``."""
    block = np.floor((t_s - t_s[-1]) / SLOW_S).astype(int)
    means = [
        float(place_m[block == k].mean()) for k in np.unique(block) if np.ptp(t_s[block == k]) > 0.8 * SLOW_S
    ]
    return np.asarray(np.diff(means) / SLOW_S)

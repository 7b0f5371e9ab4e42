"""Learning the heave in flight: from the fixes that are final to the parameters of the filter's heave block."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from estimation.events import Kind
from estimation.frames import Array
from estimation.heave.bandpass import BandPass
from estimation.heave.model import HeaveModel, fit
from estimation.outcome import Outcome
from estimation.rows import Rows

LEAST_S = 8.0
"""Shortest observation that a spectrum is learned from [s]."""


LEAST_SKILL = 0.5
"""Share of the variance half a second ahead that a model must explain before the filter takes it up."""


@dataclass(slots=True)
class HeaveLearner:
    """Collects the deck's height as each fix shows it, and fits a model every ``every_s`` to the last ``window_s``.

    The times of the fits are whole multiples of ``every_s`` of the inertial clock. A deck that moves with less than
    ``least_sigma_m``, or whose next half second is not foreseen, teaches the filter nothing.
    """

    every_s: float
    window_s: float
    least_sigma_m: float
    model: HeaveModel | None = None
    block: BandPass | None = None
    _t_ns: list[int] = field(default_factory=list)
    _height: list[float] = field(default_factory=list)
    _variance: list[float] = field(default_factory=list)
    _due_ns: int | None = None

    def take(self, rows: Rows) -> list[tuple[int, HeaveModel, Array | None]]:
        """Take rows that are final, in order; return for each fit that came due its time, model and parameters.

        The parameters are those of ``estimation.deck``, or None where nothing could be learned.
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
            result = self._fit()
            if result is not None:
                results.append((self._due_ns, *result))
            self._due_ns += every
        self._keep(waiting.take(slice(at, len(waiting))))
        return results

    def _keep(self, rows: Rows) -> None:
        self._t_ns.extend(rows.t_ns.tolist())
        self._height.extend(rows.seen[:, 0].tolist())
        self._variance.extend(rows.seen[:, 1].tolist())

    def _fit(self) -> tuple[HeaveModel, Array | None] | None:
        assert self._due_ns is not None
        begin = self._due_ns - int(self.window_s * 1e9)
        drop = int(np.searchsorted(self._t_ns, begin))
        del self._t_ns[:drop], self._height[:drop], self._variance[:drop]
        if len(self._t_ns) < 2 or self._t_ns[-1] - self._t_ns[0] < LEAST_S * 1e9:
            return None
        t = (np.array(self._t_ns) - self._due_ns) * 1e-9
        sigma = np.sqrt(self._variance)
        model = fit(t, np.array(self._height), sigma, window_s=self.window_s, previous=self.model)
        self.model = model
        if model.method != "bhr" or model.sd_m < self.least_sigma_m or float(model.skill(0.5)) < LEAST_SKILL:
            return model, None
        self.block = model.band_pass(previous=self.block)
        return model, self.block.parameters

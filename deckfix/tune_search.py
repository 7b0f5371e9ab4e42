"""The search for the best parameters, and what it says of how well they are known.

All in the logarithms of the parameters. A first sweep takes one parameter after the other to the best of a few factors,
since far from the truth the likelihood can be flat (a noise below what the receiver states has no effect). SciPy's
L-BFGS-B goes on from there within the bounds, with differences of the objective as derivatives, each parameter in units
of its own curvature, which is taken anew on the way. At the end the Hessian H by central differences gives a Newton
step, where that is better, and the covariance H^-1 of the logarithms (Bar-Shalom, Li and Kirubarajan, 2001, 2.4).

A weak prior (a factor of ``PRIOR`` is one sigma about the start) belongs to the objective: it decides nothing that the
flights tell of, and keeps what they say nothing of.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.frames import Array

PRIOR = 30.0
SWEEP = (1.0 / 10.0, 1.0 / math.sqrt(10.0), math.sqrt(10.0), 10.0)
STEP = 0.05
"""Step of the derivatives: smaller ones see how single measurements pass the gate, or do not."""
LEAST_STEP, LARGEST_STEP = 0.02, 0.3
"""Steps of the Hessian: about one sigma, within these."""
AT_BOUND = 0.01
ITERATIONS, LEGS, WORTH = 12, 6, 0.5
"""Iterations of L-BFGS-B between which curvatures are taken anew, how often, and the gain below which it ends."""
EDGE = 5.0
"""What putting one parameter back that is not identified may cost, before the others are searched for again."""
KNOWN = math.log(3.0) / 1.96
"""A parameter is identified where its 95 % interval is within a factor of three of it."""

Objective = Callable[[Sequence[Array]], list[float]]
"""Minus log-likelihood at points of log-parameters, the prior left out."""


@dataclass(frozen=True, slots=True)
class Found:
    """Where a search ended: log-parameters (p,), the objective there with its prior, and evaluations used."""

    point: Array
    value: float
    evaluations: int


@dataclass(frozen=True, slots=True)
class Certainty:
    """How well log-parameters are known: 1-sigma (p,), infinite where the objective is not curved; ``at_bound`` (p,)
    those that lie on a bound, where no sigma means anything; ``information`` (p, p) the Hessian, without these."""

    sigma: Array
    at_bound: NDArray[np.bool_]
    information: Array

    @property
    def identified(self) -> NDArray[np.bool_]:
        """Which parameters the flights tell of."""
        known: NDArray[np.bool_] = (self.sigma < KNOWN) & ~self.at_bound
        return known

    def answer(self, keep: NDArray[np.bool_], shift: Array) -> Array:
        """Return by how much the best place of some parameters moves when the others are moved by ``shift`` (p,)."""
        free = keep & ~self.at_bound
        out = np.zeros(len(self.sigma))
        H = self.information[np.ix_(free, free)]
        if free.any() and np.linalg.eigvalsh(H)[0] > 0.0:
            out[free] = -np.linalg.solve(H, self.information[np.ix_(free, ~keep)] @ shift[~keep])
        moved: Array = np.clip(out[keep], -0.5, 0.5)
        return moved

    def kept(self, keep: NDArray[np.bool_]) -> Certainty:
        """Return how well some of the parameters are known when the others are held where they are."""
        information = self.information[np.ix_(keep, keep)]
        at_bound = self.at_bound[keep]
        return Certainty(_sigmas(information, ~at_bound), at_bound, information)


@dataclass(slots=True)
class Search:
    """Searches of one objective within bounds (p,), about the prior's centre (p,)."""

    objective: Objective
    lower: Array
    upper: Array
    centre: Array
    evaluations: int = 0

    def values(self, points: Sequence[Array]) -> Array:
        """Return the objective with its prior at points within the bounds."""
        self.evaluations += len(points)
        prior = [0.5 * float(np.sum((p - self.centre) ** 2)) / math.log(PRIOR) ** 2 for p in points]
        out: Array = np.array(self.objective(points)) + np.array(prior)
        return out

    def run(self, start: Array, sweep: bool = True) -> Found:
        """Return where the search from a start ends."""
        before = self.evaluations
        point = np.clip(start, self.lower, self.upper)
        value = float(self.values([point])[0])
        if sweep:
            point, value = self._swept(point, value)
        best = Found(point, value, 0)
        for _ in range(LEGS):
            leg = self._leg(best)
            gained, best = best.value - leg.value, leg
            if gained < WORTH:
                break
        return Found(best.point, best.value, self.evaluations - before)

    def _leg(self, start: Found) -> Found:
        """Return where some iterations of L-BFGS-B lead to, each parameter in units of its curvature at the start."""
        from scipy.optimize import minimize

        best, steps = start, np.full(len(start.point), STEP)
        _, curvature = self._derivatives(start.point, start.value, steps)
        unit = 1.0 / np.sqrt(np.clip(curvature, 1.0, 1e6))

        def scaled(y: Array) -> tuple[float, Array]:
            nonlocal best
            x = np.clip(y * unit, self.lower, self.upper)
            steps = np.where(x + STEP <= self.upper, STEP, -STEP)
            all_values = self.values([x, *(x + s * e for s, e in zip(steps, np.eye(len(x)), strict=True))])
            if all_values[0] < best.value:
                best = Found(x, float(all_values[0]), 0)
            return float(all_values[0]), (all_values[1:] - all_values[0]) / steps * unit

        minimize(
            scaled,
            start.point / unit,
            jac=True,
            method="L-BFGS-B",
            bounds=list(zip(self.lower / unit, self.upper / unit, strict=True)),
            options={"maxiter": ITERATIONS, "ftol": 1e-7, "gtol": 0.05, "maxls": 10},
        )
        return best

    def certainty(self, found: Found) -> tuple[Found, Certainty]:
        """Return what a Newton step from the end of a search gives, where it is better, and how certain it is."""
        x, n = found.point, len(found.point)
        at_bound = (x - self.lower < AT_BOUND) | (self.upper - x < AT_BOUND)
        free = np.flatnonzero(~at_bound)
        information = np.zeros((n, n))
        if not len(free):
            return found, Certainty(np.full(n, np.inf), at_bound, information)
        room = np.minimum(x - self.lower, self.upper - x)
        _, curvature = self._derivatives(x, found.value, np.minimum(STEP, room), free)
        wanted = np.clip(1.0 / np.sqrt(np.maximum(curvature, 1e-9)), LEAST_STEP, LARGEST_STEP)
        steps = np.minimum(wanted, room)
        H, gradient = self._hessian(x, found.value, steps, free)
        information[np.ix_(free, free)] = H
        shift = np.zeros(n)
        if np.linalg.eigvalsh(H)[0] > 0.0:
            shift[free] = -np.linalg.solve(H, gradient)
        y = np.clip(x + np.clip(shift, -0.5, 0.5), self.lower, self.upper)
        value = float(self.values([y])[0])
        better = Found(y, value, self.evaluations) if value < found.value else found
        return better, Certainty(_sigmas(information, ~at_bound), at_bound, information)

    def _swept(self, point: Array, value: float) -> tuple[Array, float]:
        for k in range(len(point)):
            tried = []
            for factor in SWEEP:
                other = point.copy()
                other[k] = np.clip(point[k] + math.log(factor), self.lower[k], self.upper[k])
                tried.append(other)
            values = self.values(tried)
            best = int(np.argmin(values))
            if values[best] < value:
                point, value = tried[best], float(values[best])
        return point, value

    def _derivatives(
        self, x: Array, value: float, steps: Array, which: NDArray[np.int64] | None = None
    ) -> tuple[Array, Array]:
        """Return first and second derivatives (p,) by central differences, 0 where not asked for."""
        chosen = np.arange(len(x)) if which is None else which
        inner = np.clip(x, self.lower + steps, self.upper - steps)
        points = [_moved(inner, k, s * steps[k]) for k in chosen for s in (1.0, -1.0)]
        values = self.values(points).reshape(-1, 2)
        first, second = np.zeros(len(x)), np.zeros(len(x))
        h = steps[chosen]
        first[chosen] = (values[:, 0] - values[:, 1]) / (2.0 * h)
        second[chosen] = (values[:, 0] - 2.0 * value + values[:, 1]) / h**2
        return first, second

    def _hessian(self, x: Array, value: float, steps: Array, free: NDArray[np.int64]) -> tuple[Array, Array]:
        """Return the Hessian (f, f) and gradient (f,) by the f free parameters."""
        f = len(free)
        h = steps[free]
        single = [_moved(x, k, s * steps[k]) for k in free for s in (1.0, -1.0)]
        pairs = [(a, b) for a in range(f) for b in range(a)]
        double = [_moved(_moved(x, free[a], h[a]), free[b], h[b]) for a, b in pairs]
        values = self.values([*single, *double])
        one, two = values[: 2 * f].reshape(f, 2), values[2 * f :]
        H = np.diag((one[:, 0] - 2.0 * value + one[:, 1]) / h**2)
        for (a, b), both in zip(pairs, two, strict=True):
            H[a, b] = H[b, a] = (both - one[a, 0] - one[b, 0] + value) / (h[a] * h[b])
        return H, (one[:, 0] - one[:, 1]) / (2.0 * h)


def _moved(x: Array, k: int | np.int64, by: float) -> Array:
    y = x.copy()
    y[k] += by
    return y


def _sigmas(H: Array, free: NDArray[np.bool_]) -> Array:
    """Return sigmas (p,) of the free parameters from the Hessian (p, p).

    Where it is not positive, from the largest part of it that is; infinite for the others.
    """
    order = np.argsort(-np.diag(H))
    kept = [int(k) for k in order if free[k]]
    while kept and np.linalg.eigvalsh(H[np.ix_(kept, kept)])[0] <= 0.0:
        kept.pop()
    sigma = np.full(len(H), np.inf)
    if kept:
        sigma[kept] = np.sqrt(np.diag(np.linalg.inv(H[np.ix_(kept, kept)])))
    return sigma

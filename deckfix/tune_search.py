"""The search for the best parameters, and what it says of how well they are known.

All in the logarithms of the parameters. A first sweep takes one parameter after the other to the best of a few factors,
since far from the truth the likelihood can be flat (a noise below what the receiver states has no effect). A damped
Newton search goes on from there within the bounds (``estimation.scoring``), with central differences of the
likelihood of many short parts of the flights: their sum gives gradient and curvature of each parameter, the products
of the parts' slopes how parameters answer to each other (Berndt, Hall, Hall and Hausman, 1974). Taken once more at the
end, over steps of about one sigma, the curvature H gives a last step, where that is better, and the covariance H^-1 of
the logarithms (Bar-Shalom, Li and Kirubarajan, 2001, 2.4).

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
from estimation.scoring import Place, descend

PRIOR = 30.0
SWEEP = (1.0 / 10.0, 1.0 / math.sqrt(10.0), math.sqrt(10.0), 10.0)
STEP = 0.05
"""First and smallest step of the derivatives: smaller ones see how single measurements pass the gate, or do not."""
LARGEST_STEP = 0.3
"""Further steps are about one sigma, up to this."""
AT_BOUND = 0.01
ITERATIONS, WORTH = 30, 0.5
"""Steps of the search at most, and the gain below which it ends."""
CORRELATED = 0.95
"""Largest correlation of two parameters that is taken from the slopes."""
EDGE = 5.0
"""What putting one parameter back that is not identified may cost, before the others are searched for again."""
KNOWN = math.log(3.0) / 1.96
"""A parameter is identified where its 95 % interval is within a factor of three of it."""

Objective = Callable[[Sequence[Array]], list[Array]]
"""Log-likelihoods (b,) of the parts of all flights at each of some points of log-parameters, the prior left out."""


@dataclass(frozen=True, slots=True)
class Found:
    """Where a search ended: log-parameters (p,), and the objective there with its prior."""

    point: Array
    value: float


@dataclass(frozen=True, slots=True)
class Certainty:
    """How well log-parameters are known: 1-sigma (p,), infinite on a bound, where none means
    anything; ``at_bound`` (p,) those that lie on one; ``information`` (p, p) the curvature, without these."""

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
        if free.any():
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

    def parts(self, points: Sequence[Array]) -> Array:
        """Return the log-likelihoods of the parts at points within the bounds (n, b)."""
        self.evaluations += len(points)
        return np.array(self.objective(points))

    def values(self, points: Sequence[Array]) -> Array:
        """Return the objective, minus the log-likelihood with its prior, at points within the bounds."""
        return self._objective(points, self.parts(points))

    def run(self, start: Array, sweep: bool = True) -> Found:
        """Return where the search from a start ends."""
        point = np.clip(start, self.lower, self.upper)
        if sweep:
            point = self._swept(point)

        def evaluate(x: Array) -> Place[Array]:
            parts = self.parts([x])
            return Place(x, float(self._objective([x], parts)[0]), parts[0])

        steps = np.full(len(point), STEP)

        def derivatives(place: Place[Array]) -> tuple[Array, Array]:
            nonlocal steps
            gradient, H = self._slopes(place, steps)
            steps = _one_sigma(H)
            return gradient, H

        end, _ = descend(
            evaluate, derivatives, evaluate(point), self.lower, self.upper, iterations=ITERATIONS, tolerance=WORTH
        )  # fmt: skip
        return Found(end.x, end.value)

    def _objective(self, points: Sequence[Array], parts: Array) -> Array:
        prior = [0.5 * float(np.sum((p - self.centre) ** 2)) / math.log(PRIOR) ** 2 for p in points]
        out: Array = np.array(prior) - parts.sum(axis=1)
        return out

    def _slopes(self, place: Place[Array], steps: Array) -> tuple[Array, Array]:
        """Return gradient (p,) and curvature (p, p) of the objective, by differences over ``steps`` (p,) or as far as
        the bounds allow.

        The diagonal of the curvature is that of the differences where it is positive, else of the slopes' squares; how
        parameters answer to each other is the correlation of the slopes. So it is positive definite, where second
        differences of a likelihood that is rough need not be.
        """
        n = len(place.x)
        down, up = np.maximum(place.x - steps, self.lower), np.minimum(place.x + steps, self.upper)
        points = [_moved(place.x, k, to[k] - place.x[k]) for k in range(n) for to in (down, up)]
        parts = self.parts(points).reshape(n, 2, -1)
        before, after = (place.x - down)[:, None], (up - place.x)[:, None]
        falling = np.divide(
            place.state - parts[:, 0], before, out=np.zeros_like(parts[:, 0]), where=before > 0.0
        )
        rising = np.divide(
            parts[:, 1] - place.state, after, out=np.zeros_like(parts[:, 0]), where=after > 0.0
        )
        # At a bound only one of the two is there.
        one_sided = np.where(before > 0.0, falling, rising)
        both = (falling * after + rising * before) / (before + after)
        slope = np.where((before > 0.0) & (after > 0.0), both, one_sided)
        product = slope @ slope.T
        squares = np.diag(product)
        size = np.sqrt(np.maximum(np.outer(squares, squares), 1e-300))
        correlation = np.clip(product / size, -CORRELATED, CORRELATED)
        np.fill_diagonal(correlation, 1.0)
        bend = -2.0 * (rising - falling).sum(axis=1) / (before + after)[:, 0]
        inside = (before > 0.0)[:, 0] & (after > 0.0)[:, 0]
        curvature = np.where(inside & (bend > 0.0), bend, squares)
        root = np.sqrt(curvature)
        prior = 1.0 / math.log(PRIOR) ** 2
        gradient = prior * (place.x - self.centre) - slope.sum(axis=1)
        return gradient, correlation * np.outer(root, root) + prior * np.eye(n)

    def certainty(self, found: Found) -> tuple[Found, Certainty]:
        """Return what a Newton step from the end of a search gives, where it is better, and how certain it is."""
        x, n = found.point, len(found.point)
        at_bound = self._at_bound(x)
        free = np.flatnonzero(~at_bound)
        information = np.zeros((n, n))
        if not len(free):
            return found, Certainty(np.full(n, np.inf), at_bound, information)
        place = Place(x, found.value, self.parts([x])[0])
        _, near = self._slopes(place, np.full(n, STEP))
        gradient, H = self._slopes(place, _one_sigma(near))
        shift = np.zeros(n)
        shift[free] = -np.linalg.solve(H[np.ix_(free, free)], gradient[free])
        y = np.clip(x + np.clip(shift, -0.5, 0.5), self.lower, self.upper)
        parts = self.parts([y])
        value = float(self._objective([y], parts)[0])
        if value < found.value:
            found = Found(y, value)
            _, H = self._slopes(Place(y, value, parts[0]), _one_sigma(H))
            at_bound = self._at_bound(y)
            free = np.flatnonzero(~at_bound)
        information[np.ix_(free, free)] = H[np.ix_(free, free)]
        return found, Certainty(_sigmas(information, ~at_bound), at_bound, information)

    def _at_bound(self, x: Array) -> NDArray[np.bool_]:
        at_bound: NDArray[np.bool_] = (x - self.lower < AT_BOUND) | (self.upper - x < AT_BOUND)
        return at_bound

    def _swept(self, point: Array) -> Array:
        value = float(self.values([point])[0])
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
        return point


def _moved(x: Array, k: int | np.int64, by: float) -> Array:
    y = x.copy()
    y[k] += by
    return y


def _one_sigma(curvature: Array) -> Array:
    """Return steps (p,) of about one sigma."""
    return np.clip(1.0 / np.sqrt(np.diag(curvature)), STEP, LARGEST_STEP)


def _sigmas(curvature: Array, free: NDArray[np.bool_]) -> Array:
    """Return sigmas (p,) of the free parameters from the curvature (p, p), infinite for the others."""
    sigma = np.full(len(curvature), np.inf)
    if free.any():
        sigma[free] = np.sqrt(np.diag(np.linalg.inv(curvature[np.ix_(free, free)])))
    return sigma

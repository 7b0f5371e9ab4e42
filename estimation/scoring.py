"""Fisher's scoring within bounds: the largest posterior of parameters whose expected information is known.

Newton's method with the expected information in the place of the Hessian (Jennrich and Sampson, 1976), or with another
curvature that, like it, is positive definite wherever the search stands, so that every step goes downhill. A step that
does not gain is damped after Levenberg and Marquardt; parameters on a bound that the slope holds there stay out of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Generic, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

DAMPING, LEAST_DAMPING, MORE = 0.1, 1e-4, 4.0
"""Share of the information that is added to it: at first, at least, and the factor from one trial to the next."""
UNDAMPED = 0.3
"""Information [1] that damping counts of a parameter of which hardly anything is known."""
TRIALS = 10
"""Steps tried from one place, each damped more."""

State = TypeVar("State")


@dataclass(frozen=True, slots=True)
class Place(Generic[State]):
    """A place of the search: parameters ``x`` (p,), the negative log posterior there, and what its derivatives are
    computed from."""

    x: Array
    value: float
    state: State


def descend(
    evaluate: Callable[[Array], Place[State]],
    derivatives: Callable[[Place[State]], tuple[Array, Array]],
    start: Place[State],
    low: Array,
    high: Array,
    *,
    iterations: int,
    tolerance: float,
) -> tuple[Place[State], int]:
    """Return where scoring leads from ``start``, and how many places it has evaluated on the way.

    ``derivatives`` gives gradient (p,) and information (p, p) at a place; ``low`` and ``high`` (p,) bound the
    parameters, and ``start`` lies within them. The search ends after so many ``iterations``, or where a step promises
    to gain less than ``tolerance`` (of the posterior's logarithm).
    """
    at, damping, evaluated = start, DAMPING, 0
    for _ in range(iterations):
        gradient, H = derivatives(at)
        free = np.flatnonzero(~((at.x <= low) & (gradient > 0) | (at.x >= high) & (gradient < 0)))
        if not len(free):
            break
        gained = 0.0
        for _ in range(TRIALS):
            step = np.zeros(len(at.x))
            damped = H[np.ix_(free, free)] + np.diag(damping * (np.diag(H)[free] + UNDAMPED))
            step[free] = np.linalg.solve(damped, -gradient[free])
            x = np.clip(at.x + step, low, high)
            step = x - at.x
            # Less than nothing is promised where a bound has cut the step: a shorter one goes downhill again.
            promised = -float(gradient @ step + 0.5 * step @ H @ step)
            if 0.0 <= promised < tolerance:
                break
            if promised > 0.0:
                there = evaluate(x)
                evaluated += 1
                gained = at.value - there.value
                if gained > 0.0:
                    at = there
                    if gained > 0.5 * promised:
                        damping = max(damping / MORE, LEAST_DAMPING)
                    elif gained < 0.1 * promised:
                        damping *= MORE
                    break
            damping *= MORE
        if gained <= 0.0:
            break
    return at, evaluated

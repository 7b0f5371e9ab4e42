"""Consistency: does the covariance tell the truth about the errors, and the innovations about the noise?

NEES and NIS are errors and innovations squared, normalised by their covariance; over their degrees of
freedom their mean is 1 for an honest filter, and over N independent runs it stays inside a chi-square band
with the stated probability (Bar-Shalom, Li and Kirubarajan, 2001, section 5.4). Innovations of an optimal
filter are white.

``check_jacobian`` compares a measurement's analytic Jacobian with finite differences on the state's
manifold; use it on models of your own before ``LandingEstimator.add_sensor``.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.frames import Array
from estimation.state import Layout, plus

Model = Callable[[Array, Array, Layout], tuple[Array, Array, Array]]


def normalised_squared(error: Array, covariance: Array) -> Array:
    """Return e' P^-1 e, shape (...), of errors (..., k) with covariances (..., k, k); NaN where P is
    singular.

    NEES of estimation errors, NIS of innovations. The covariance is scaled to a unit diagonal first, so
    that metres and radians in one matrix do not spoil the solution.
    """
    scale = np.sqrt(np.einsum("...ii->...i", covariance))
    with np.errstate(divide="ignore", invalid="ignore"):
        unit = covariance / (scale[..., :, None] * scale[..., None, :])
        e = error / scale
    usable = np.isfinite(unit).all(axis=(-2, -1)) & np.isfinite(e).all(axis=-1)
    usable &= np.linalg.det(np.where(usable[..., None, None], unit, np.eye(error.shape[-1]))) > 0.0
    unit = np.where(usable[..., None, None], unit, np.eye(error.shape[-1]))
    e = np.where(usable[..., None], e, 0.0)
    value = np.sum(e * np.linalg.solve(unit, e[..., None])[..., 0], axis=-1)
    return np.where(usable, value, np.nan)


@dataclass(frozen=True, slots=True)
class Band:
    """Bounds between which a mean of normalised squares over its degrees of freedom lies with a probability."""

    low: float
    high: float

    def holds(self, value: float | Array) -> NDArray[np.bool_]:
        """Return whether values lie inside."""
        v = np.asarray(value)
        inside: NDArray[np.bool_] = (v >= self.low) & (v <= self.high)
        return inside


def chi_square_band(dof: int, runs: int = 1, probability: float = 0.95) -> Band:
    """Return the two-sided band of the mean over ``runs`` independent normalised squares, over ``dof``.

    Raises ``ValueError`` for counts below 1 and for a probability that is not between 0 and 1.
    """
    from scipy.special import gammaincinv

    if dof < 1 or runs < 1:
        raise ValueError(f"a band needs at least one run and one degree of freedom, not {runs} and {dof}")
    if not 0.0 < probability < 1.0:
        raise ValueError(f"probability is {probability}; give a number between 0 and 1")
    half = 0.5 * dof * runs
    tail = 0.5 * (1.0 - probability)
    low, high = (float(gammaincinv(half, q)) / half for q in (tail, 1.0 - tail))
    return Band(low, high)


@dataclass(frozen=True, slots=True)
class RunsConsistency:
    """Normalised squares of several runs at the same instants, against the band for that many runs.

    ``mean_over_dof`` is the mean over all runs and instants; ``inside`` the share of instants at which the
    mean over the runs lies in the band (0.95 expected); ``band`` that of one instant.
    """

    dof: int
    runs: int
    instants: int
    mean_over_dof: float
    inside: float
    band: Band

    @property
    def consistent(self) -> bool:
        """True where the mean over all instants is inside the band.

        Instants of one run are correlated, so that the mean over them varies no more than a single one
        does: an honest filter is inside at least as often as the band says.
        """
        return bool(self.band.holds(self.mean_over_dof))


def runs_consistency(values: Array, dof: int, probability: float = 0.95) -> RunsConsistency:
    """Judge normalised squares (runs, instants) of ``dof`` degrees of freedom; NaN entries are left out.

    Raises ``ValueError`` where nothing is finite.
    """
    finite = np.isfinite(values)
    counts = finite.sum(axis=0)
    if not counts.any():
        raise ValueError("no finite value to judge; was the filter running?")
    means = np.where(finite, values, 0.0).sum(axis=0)[counts > 0] / counts[counts > 0] / dof
    inside = [
        bool(chi_square_band(dof, int(n), probability).holds(m))
        for m, n in zip(means, counts[counts > 0], strict=True)
    ]
    runs = int(np.median(counts[counts > 0]))
    return RunsConsistency(
        dof=dof,
        runs=runs,
        instants=len(means),
        mean_over_dof=float(np.average(means, weights=counts[counts > 0])),
        inside=float(np.mean(inside)),
        band=chi_square_band(dof, runs, probability),
    )


@dataclass(frozen=True, slots=True)
class Whiteness:
    """Autocorrelation (lags,) of a sequence at lags 1, 2, ..., and the bound that white noise keeps.

    ``bound`` is 1.96 / sqrt(n) for 95 %; ``outside`` the share of lags beyond it (0.05 expected).
    """

    autocorrelation: Array
    bound: float
    outside: float


def whiteness(values: Array, lags: int = 20) -> Whiteness:
    """Return the normalised autocorrelation of a sequence (n,), or the mean of those of k components (n, k).

    Give innovations divided by their predicted sigma. Raises ``ValueError`` for sequences not longer than
    the lags.
    """
    v = values[:, None] if values.ndim == 1 else values
    n = len(v)
    if n <= lags:
        raise ValueError(f"{n} values are too few for {lags} lags; give more, or ask for fewer")
    v = v - v.mean(axis=0)
    power = np.sum(v * v, axis=0)
    rho = np.array([np.mean(np.sum(v[k:] * v[: n - k], axis=0) / power) for k in range(1, lags + 1)])
    bound = 1.96 / float(np.sqrt(n * v.shape[1]))
    return Whiteness(rho, bound, float(np.mean(np.abs(rho) > bound)))


@dataclass(frozen=True, slots=True)
class JacobianCheck:
    """An analytic Jacobian (m, n) beside the numeric one, and where they differ most.

    ``worst`` is the largest difference over the tolerance's scale (1 is the limit), at the measurement's
    ``row`` and the error state's entry ``column``, ``name``.
    """

    analytic: Array
    numeric: Array
    worst: float
    row: int
    column: int
    name: str

    @property
    def correct(self) -> bool:
        """True where all entries agree."""
        return self.worst <= 1.0

    def __str__(self) -> str:
        """Return the verdict in one sentence."""
        if self.correct:
            return "the Jacobian agrees with finite differences"
        given, found = (j[self.row, self.column] for j in (self.analytic, self.numeric))
        return (
            f"the Jacobian is wrong: d(prediction {self.row}) / d({self.name}) is {given:.6g}, "
            f"finite differences give {found:.6g}"
        )


def check_jacobian(
    model: Model, value: Array, x: Array, layout: Layout, *, step: float = 1e-5, tolerance: float = 1e-5
) -> JacobianCheck:
    """Compare a measurement model's Jacobian with central differences by every entry of the error state.

    ``model(value, nominal, layout)`` returns innovation (m,), Jacobian (m, n) and covariance (m, m), as for
    ``LandingEstimator.add_sensor``: the innovation is measured less predicted, the Jacobian the derivative
    of the prediction. ``value`` should be near what is predicted at the nominal state ``x``. An entry is
    right within ``tolerance`` times the larger of 1 and its size. Raises ``ValueError`` where the shapes do
    not fit.
    """
    innovation, jacobian, covariance = (np.asarray(a, dtype=np.float64) for a in model(value, x, layout))
    m, n = len(np.atleast_1d(innovation)), layout.size
    if innovation.shape != (m,) or jacobian.shape != (m, n) or covariance.shape != (m, m):
        raise ValueError(
            f"the model returned shapes {innovation.shape}, {jacobian.shape} and {covariance.shape}; it must return "
            f"(m,), (m, {n}) and (m, m)"
        )
    numeric = np.empty((m, n))
    for j in range(n):
        error = np.zeros(n)
        error[j] = step
        ahead, behind = (
            np.asarray(model(value, plus(x, s * error, layout.offsets), layout)[0]) for s in (1.0, -1.0)
        )
        numeric[:, j] = (behind - ahead) / (2.0 * step)
    excess = np.abs(jacobian - numeric) / (tolerance * np.maximum(1.0, np.abs(numeric)))
    row, column = np.unravel_index(int(np.argmax(excess)), excess.shape)
    name = layout.names[int(column)]
    return JacobianCheck(jacobian, numeric, float(excess[row, column]), int(row), int(column), name)

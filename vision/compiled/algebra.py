"""Small matrices, medians and robust weights as loops, in place of ``vision.robust`` and ``vision.view``."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numba.extending import overload
from numpy.typing import NDArray

from vision import robust, view
from vision.robust import kept, residual_scale

Array = NDArray[np.float64]
Bool = NDArray[np.bool_]

MANY = 120
"""Values from which selecting is faster than sorting by insertion."""


@overload(view.whole)
def _whole(x: Any) -> Callable[[Any], Any]:
    def index(x: Any) -> Any:
        return int(x)

    return index


@overload(view.either)
def _either(condition: Any, a: Any, b: Any) -> Callable[[Any, Any, Any], Any]:
    def choose(condition: Any, a: Any, b: Any) -> Any:
        return a if condition else b

    return choose


@overload(robust.masked)
def _masked(values: Array, keep: Bool) -> Callable[[Array, Bool], Array]:
    def mask(values: Array, keep: Bool) -> Array:
        out = np.zeros(len(values))
        for i in range(len(values)):
            if keep[i]:
                out[i] = values[i]
        return out

    return mask


@overload(robust.median)
def _median(values: Array) -> Callable[[Array], float]:
    def middle(values: Array) -> float:
        """Sort by insertion where there are about fifty, else select."""
        if len(values) > MANY:
            k = len(values) // 2
            return float(np.partition(values, k)[k])
        ordered = values.copy()
        for i in range(1, len(ordered)):
            value = ordered[i]
            j = i - 1
            while j >= 0 and ordered[j] > value:
                ordered[j + 1] = ordered[j]
                j -= 1
            ordered[j + 1] = value
        return float(ordered[len(ordered) // 2])

    return middle


@overload(robust.times)
def _times(matrix: Array, vector: Array) -> Callable[[Array, Array], Array]:
    def product(matrix: Array, vector: Array) -> Array:
        p, n = matrix.shape
        out = np.empty(p)
        for i in range(p):
            total = 0.0
            for j in range(n):
                total += matrix[i, j] * vector[j]
            out[i] = total
        return out

    return product


@overload(robust.normal_equations)
def _normal_equations(a: Array, weight: Array, b: Array) -> Callable[..., tuple[Array, Array]]:
    def sums(a: Array, weight: Array, b: Array) -> tuple[Array, Array]:
        p, n = a.shape
        matrix, vector = np.zeros((n, n)), np.zeros(n)
        for i in range(p):
            w = weight[i]
            if w != 0.0:
                for j in range(n):
                    wa = w * a[i, j]
                    vector[j] += wa * b[i]
                    for k in range(j + 1):
                        matrix[j, k] += wa * a[i, k]
        for j in range(n):
            for k in range(j):
                matrix[k, j] = matrix[j, k]
        return matrix, vector

    return sums


@overload(robust.inverted)
def _inverted(matrix: Array) -> Callable[[Array], tuple[bool, Array]]:
    def inverse(matrix: Array) -> tuple[bool, Array]:
        """Invert through the Cholesky factor."""
        n = len(matrix)
        low = np.zeros((n, n))
        for j in range(n):
            pivot = matrix[j, j]
            for k in range(j):
                pivot -= low[j, k] * low[j, k]
            if not pivot > 0.0:
                return False, matrix
            low[j, j] = math.sqrt(pivot)
            for i in range(j + 1, n):
                value = matrix[i, j]
                for k in range(j):
                    value -= low[i, k] * low[j, k]
                low[i, j] = value / low[j, j]
        # The factor's inverse, then its square.
        for j in range(n):
            low[j, j] = 1.0 / low[j, j]
            for i in range(j + 1, n):
                value = 0.0
                for k in range(j, i):
                    value -= low[i, k] * low[k, j]
                low[i, j] = value / low[i, i]
        out = np.empty((n, n))
        for i in range(n):
            for j in range(i + 1):
                value = 0.0
                for k in range(i, n):
                    value += low[k, i] * low[k, j]
                out[i, j] = out[j, i] = value
        return True, out

    return inverse


@overload(robust.reweighted)
def _reweighted(
    a: Array, delta: Array, full: Array, change: Array, valid: Bool
) -> Callable[..., tuple[Array, Array, float, float]]:
    def judge(
        a: Array, delta: Array, full: Array, change: Array, valid: Bool
    ) -> tuple[Array, Array, float, float]:
        n = len(delta)
        residual, weight = delta - robust.times(a, change), np.zeros(n)
        size = np.empty(n)
        used, largest = 0, 0.0
        for i in range(n):
            if valid[i]:
                size[used] = abs(residual[i])
                largest = max(largest, size[used])
                used += 1
        scale = residual_scale(robust.median(size[:used]))
        for i in range(n):
            weight[i] = full[i] * kept(abs(residual[i]), scale)
        return residual, weight, scale, largest

    return judge


REPLACED = (
    view.whole,
    view.either,
    robust.masked,
    robust.median,
    robust.times,
    robust.normal_equations,
    robust.inverted,
    robust.reweighted,
)

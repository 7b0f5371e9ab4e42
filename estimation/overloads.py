"""What numba may compile of the plain functions, and how it compiles the small products among them.

Importing this module registers all of them; the loops of ``overload`` take the place of NumPy's products, which numba
would hand to a library made for large matrices.
"""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path

import numpy as np
from numba.extending import overload, register_jitable

from estimation import (
    algebra,
    band,
    camera_age,
    deck,
    frames,
    models,
    parameters,
    relinearise,
    rows,
    state,
    trail,
    update,
    watch,
)
from estimation.frames import Array


@overload(frames.compose)
def _compose(a: Array, b: Array) -> Callable[[Array, Array], Array]:
    """Compile the small product as loops."""

    def product(a: Array, b: Array) -> Array:
        c = np.empty((3, 3))
        for i in range(3):
            for j in range(3):
                c[i, j] = a[i, 0] * b[0, j] + a[i, 1] * b[1, j] + a[i, 2] * b[2, j]
        return c

    return product


@overload(frames.rotate)
def _rotate(m: Array, v: Array) -> Callable[[Array, Array], Array]:
    """Compile the small product as loops."""

    def product(m: Array, v: Array) -> Array:
        u = np.empty(3)
        for i in range(3):
            u[i] = m[i, 0] * v[0] + m[i, 1] * v[1] + m[i, 2] * v[2]
        return u

    return product


@overload(band.product)
def _band_product(T: Array, v: Array) -> Callable[[Array, Array], Array]:
    """Compile the product with a small matrix as loops."""
    if v.ndim == 1:

        def by_vector(T: Array, v: Array) -> Array:
            n = T.shape[0]
            out = np.zeros(n)
            for i in range(n):
                for k in range(n):
                    out[i] += T[i, k] * v[k]
            return out

        return by_vector

    def by_matrix(T: Array, v: Array) -> Array:
        n, m = v.shape
        out = np.zeros((n, m))
        for i in range(n):
            for k in range(n):
                for j in range(m):
                    out[i, j] += T[i, k] * v[k, j]
        return out

    return by_matrix


@overload(models.put)
def _put(target: Array, row: int, column: int, scale: float, block: Array) -> Callable[..., None]:
    """Compile the small assignment as loops, without a product in between."""

    def assign(target: Array, row: int, column: int, scale: float, block: Array) -> None:
        for i in range(3):
            for j in range(3):
                target[row + i, column + j] = scale * block[i, j]

    return assign


_COMPILED = (algebra, band, camera_age, deck, frames, models, relinearise, state, update, watch)
_READ = (parameters, rows, trail)
"""Modules whose functions are compiled, and those of which compiled code takes names alone."""

for _module in _COMPILED:
    for _function in vars(_module).values():
        if (
            inspect.isfunction(_function)
            and _function.__module__ == _module.__name__
            and _function
            not in (
                frames.compose,
                frames.rotate,
                models.put,
                band.band_stationary,
                band.product,
                deck.any_sea,
                deck.prior_motion,
            )
        ):
            register_jitable(_function)

SOURCES = (*(Path(inspect.getfile(module)) for module in (*_COMPILED, *_READ)), Path(__file__))
"""The files that compiled code is made from: code compiled of other contents is never used."""

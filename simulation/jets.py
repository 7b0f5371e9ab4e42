"""Functions of time with their first three derivatives, exact: *jets*.

A jet is an array whose first axis holds value, first, second and third derivative; the second axis is time,
what follows are components: (4, n) or (4, n, k). Sums of jets are sums of arrays, products follow Leibniz's
rule, so that position, velocity, acceleration and jerk of everything that moves here fit each other to
rounding.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_STEP = np.polynomial.Polynomial([0, 0, 0, 0, 0, 126, -420, 540, -315, 70])
_STEP_JET = tuple(_STEP.deriv(k) if k else _STEP for k in range(4))
_CHUNK = 4096


def constant(t_s: Array, value: ArrayLike) -> Array:
    """Return the jet of a constant, shape (4, n) or (4, n, k)."""
    v = np.asarray(value, dtype=np.float64)
    out = np.zeros((4, len(t_s), *v.shape))
    out[0] = v
    return out


def step(t_s: Array, start_s: float, duration_s: float) -> Array:
    """Return the jet, shape (4, n), of a step from 0 to 1, four times continuously differentiable.

    The polynomial of ninth degree whose first four derivatives vanish at both ends. Its largest rate is
    2.46 / duration.
    """
    s = np.clip((t_s - start_s) / duration_s, 0.0, 1.0)
    return np.stack([p(s) / duration_s**k for k, p in enumerate(_STEP_JET)])


def sinusoids(t_s: Array, amplitude: Array, omega_radps: Array, phase_rad: Array) -> Array:
    """Return the jet, shape (4, n), of the sum of A cos(w t + phi); all three of shape (m,)."""
    out = np.empty((4, len(t_s)))
    for a in range(0, len(t_s), _CHUNK):
        angle = np.multiply.outer(t_s[a : a + _CHUNK], omega_radps) + phase_rad
        c, s = np.cos(angle), np.sin(angle)
        part = out[:, a : a + _CHUNK]
        part[0] = c @ amplitude
        part[1] = -s @ (amplitude * omega_radps)
        part[2] = -c @ (amplitude * omega_radps**2)
        part[3] = s @ (amplitude * omega_radps**3)
    return out


def product(a: Array, b: Array) -> Array:
    """Return the jet of the product; a jet (4, n) multiplies every component of one of (4, n, k)."""
    if a.ndim < b.ndim:
        a = a[..., None]
    elif b.ndim < a.ndim:
        b = b[..., None]
    return np.stack(
        [
            a[0] * b[0],
            a[1] * b[0] + a[0] * b[1],
            a[2] * b[0] + 2.0 * a[1] * b[1] + a[0] * b[2],
            a[3] * b[0] + 3.0 * a[2] * b[1] + 3.0 * a[1] * b[2] + a[0] * b[3],
        ]
    )

"""Functions of time with their first three derivatives, exact: *jets*.

A jet is an array whose first axis holds value, first, second and third derivative; the second axis is time,
what follows are components: (4, n) or (4, n, k). Sums of jets are sums of arrays, products follow Leibniz's
rule, so that position, velocity, acceleration and jerk of everything that moves here fit each other to
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Complex = NDArray[np.complex128]

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


def sinusoids(t_s: Array, omega_radps: Array, response: Complex) -> Array:
    """Return the jets of sums of tones, Re(sum of response exp(i w t)), shape (4, n, k).

    ``omega_radps`` (m,) are shared by all k sums, ``response`` (m, k) holds amplitude and phase of each
    tone in each.
    """
    out = np.empty((4, len(t_s), response.shape[1]))
    w = omega_radps[:, None]
    cosines = [response.real, response.real, -response.real, -response.real]
    sines = [-response.imag, -response.imag, response.imag, response.imag]
    for a in range(0, len(t_s), _CHUNK):
        angle = np.multiply.outer(t_s[a : a + _CHUNK], omega_radps)
        c, s = np.cos(angle), np.sin(angle)
        for k in range(4):
            # Every derivative turns the phase by a quarter: cos -> -sin -> -cos -> sin.
            even, odd = (c, s) if k % 2 == 0 else (-s, c)
            out[k, a : a + _CHUNK] = even @ (cosines[k] * w**k) + odd @ (sines[k] * w**k)
    return out


@dataclass(frozen=True, slots=True)
class Tones:
    """Sums of tones on three axes: amplitude, angular frequency [rad/s] and phase [rad], each (3, m)."""

    amplitude: Array
    omega_radps: Array
    phase_rad: Array

    def motion(self, t_s: Array) -> Array:
        """Return their jet, shape (4, n, 3)."""
        response = self.amplitude * np.exp(1j * self.phase_rad)
        axes = [sinusoids(t_s, w, r[:, None]) for w, r in zip(self.omega_radps, response, strict=True)]
        return np.concatenate(axes, axis=2)


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

"""A motion of the sea as a chain of states: white noise through three sections s / (s^2 + 2 zeta w s + w^2).

It has no gain at rest, so that level and place keep their own states, and falls off on both sides of its band. Heave
and the sway in either direction each are such a chain: six states, and seven parameters (gain, three w [rad/s], three
zeta), which are learned in flight (``estimation.heave.bandpass``). The last state is the displacement.

Plain functions of arrays that numba compiles as they stand.
"""

from __future__ import annotations

import math

import numpy as np

from estimation.frames import Array

BAND_SIZE = 6
BAND_PARAMETERS = 7


def band_matrix(band: Array) -> Array:
    """Return f (6, 6) of x' = f x + l w: states of a section are its displacement and velocity."""
    f = np.zeros((BAND_SIZE, BAND_SIZE))
    for s in range(3):
        w, zeta = band[1 + s], band[4 + s]
        f[2 * s, 2 * s + 1] = 1.0
        f[2 * s + 1, 2 * s] = -w * w
        f[2 * s + 1, 2 * s + 1] = -2.0 * zeta * w
        if s > 0:
            f[2 * s + 1, 2 * s - 1] = 1.0
    return f


def product(T: Array, v: Array) -> Array:
    """Return T v for a matrix (n, n) and a vector or matrix (n, ...); compiled as loops."""
    return np.asarray(T @ v)


def discrete_band(band: Array, dt: float) -> tuple[Array, Array]:
    """Return transition and process noise (6, 6) of a chain over ``dt`` [s].

    The transition is a series to third order in dt, the noise Simpson's rule over the step: both good to 1e-5 for
    steps up to 25 ms and periods above 0.8 s.
    """
    f = band_matrix(band)
    f2 = product(f, f)
    f3 = product(f2, f)
    half = 0.5 * dt
    transition = np.eye(BAND_SIZE) + dt * f + (0.5 * dt**2) * f2 + (dt**3 / 6.0) * f3
    # The noise enters the first section's velocity.
    end = band[0] * transition[:, 1]
    middle = band[0] * (half * f[:, 1] + (0.5 * half**2) * f2[:, 1] + (half**3 / 6.0) * f3[:, 1])
    middle[1] += band[0]
    noise = (dt / 6.0) * (4.0 * np.outer(middle, middle) + np.outer(end, end))
    noise[1, 1] += (dt / 6.0) * band[0] ** 2
    return transition, noise


def band_stationary(band: Array) -> Array:
    """Return the covariance (6, 6) of the chain's states once it has run for long."""
    from scipy.linalg import solve_continuous_lyapunov

    drive = np.zeros((BAND_SIZE, BAND_SIZE))
    drive[1, 1] = band[0] ** 2
    covariance = solve_continuous_lyapunov(band_matrix(band), -drive)
    return np.asarray(0.5 * (covariance + covariance.T))


def band_derivatives(x: Array, band: Array) -> Array:
    """Return (6,) the displacement's third, second and first integral, itself, its first and second derivative.

    With z = w / ((s^2 + a s + b) ...), the white noise through the denominators alone, the displacement is z's
    third derivative: z and its five derivatives are the chain's states (6,) in coordinates that mean the same for any
    parameters.
    """
    z = np.empty(BAND_SIZE)
    a2, b2 = 2.0 * band[5] * band[2], band[2] ** 2
    a3, b3 = 2.0 * band[6] * band[3], band[3] ** 2
    z[2], z[3] = x[4], x[5]
    z[4] = x[3] - a3 * z[3] - b3 * z[2]
    z[1] = (x[2] - z[3] - a3 * z[2]) / b3
    z[0] = ((x[0] - x[3] - a2 * x[2]) / b2 - z[2] - a3 * z[1]) / b3
    z[5] = x[1] - a2 * x[3] - b2 * x[2] - a3 * z[4] - b3 * z[3]
    return z


def band_states(z: Array, band: Array) -> Array:
    """Return the chain's states (6,); the inverse of ``band_derivatives``."""
    x = np.empty(BAND_SIZE)
    a2, b2 = 2.0 * band[5] * band[2], band[2] ** 2
    a3, b3 = 2.0 * band[6] * band[3], band[3] ** 2
    x[4], x[5] = z[2], z[3]
    x[2] = z[3] + a3 * z[2] + b3 * z[1]
    x[3] = z[4] + a3 * z[3] + b3 * z[2]
    x[0] = x[3] + a2 * x[2] + b2 * (z[2] + a3 * z[1] + b3 * z[0])
    x[1] = z[5] + a3 * z[4] + b3 * z[3] + a2 * x[3] + b2 * x[2]
    return x


def band_moments(band: Array) -> Array:
    """Return (6,) the variances of z and its five derivatives (``band_derivatives``) in a sea without end.

    E[z_i z_j] is (-1)^((i - j) / 2) m_((i + j) / 2) for even i + j, else 0; the z_k are uncorrelated with the noise
    that drives z_6, but for k = 5: six linear equations for the six moments m. Time is in units of the sections'.
    """
    scale = (band[1] * band[2] * band[3]) ** (1.0 / 3.0)
    polynomial = np.zeros(BAND_SIZE + 1)
    polynomial[0] = 1.0
    for s in range(3):
        w = band[1 + s] / scale
        a = 2.0 * band[4 + s] * w
        for k in range(2 * s + 2, -1, -1):
            value = w * w * polynomial[k]
            if k >= 1:
                value += a * polynomial[k - 1]
            if k >= 2:
                value += polynomial[k - 2]
            polynomial[k] = value
    M = np.zeros((BAND_SIZE, BAND_SIZE + 1))
    for k in range(BAND_SIZE):
        for j in range(k % 2, BAND_SIZE + 1, 2):
            sign = 1.0 if (j - k) % 4 == 0 else -1.0
            M[k, (k + j) // 2] += sign * polynomial[j]
    M[BAND_SIZE - 1, BAND_SIZE] = 0.5 * band[0] ** 2
    m = _solved(M)
    for k in range(BAND_SIZE):
        m[k] *= scale ** (2 * k - 11)
    return m


def _solved(M: Array) -> Array:
    """Return the solution (n,) of the equations (n, n + 1) with their right sides last, by elimination."""
    n = M.shape[0]
    for c in range(n):
        best = c
        for i in range(c + 1, n):
            if abs(M[i, c]) > abs(M[best, c]):
                best = i
        for k in range(c, n + 1):
            M[c, k], M[best, k] = M[best, k], M[c, k]
        for i in range(n):
            if i != c:
                factor = M[i, c] / M[c, c]
                for k in range(c, n + 1):
                    M[i, k] -= factor * M[c, k]
    solution = np.empty(n)
    for i in range(n):
        solution[i] = M[i, n] / M[i, i]
    return solution


def band_integrals(band: Array) -> Array:
    """Return what a sea without end says of the integrals (z, z', z'') from displacement, rate and acceleration.

    (8,): z on the rate, z' on displacement and acceleration, z'' on the rate; then of what remains 1-sigma of z', of
    z'', z on z'' and 1-sigma of z.
    """
    m = band_moments(band)
    tiny = 1e-12
    out = np.empty(8)
    det = m[3] * m[5] - m[4] ** 2
    out[0] = m[2] / m[4]
    out[1] = (m[3] * m[4] - m[2] * m[5]) / det
    out[2] = (m[3] ** 2 - m[2] * m[4]) / det
    out[3] = -m[3] / m[4]
    out[4] = math.sqrt(max(m[1] + out[1] * m[2] - out[2] * m[3], tiny * m[1]))
    second = max(m[2] - m[3] ** 2 / m[4], tiny * m[2])
    both = -m[1] + m[2] * m[3] / m[4]
    out[5] = math.sqrt(second)
    out[6] = both / second
    out[7] = math.sqrt(max(m[0] - m[2] ** 2 / m[4] - both**2 / second, tiny * m[0]))
    return out


def change_of_band(band: Array, new: Array) -> Array:
    """Return T (6, 6) that takes the chain's states from parameters ``band`` (7,) to ``new`` (7,).

    The states mean something else under other parameters. The displacement, its rate and its acceleration stay what
    they are. The integrals, which have no meaning beyond the chain's and whose size is the model's, stay where they
    were within what the sea says of them: what of them the displacement does not tell keeps its value in units of its
    own 1-sigma. So nothing changes with equal parameters.
    """
    old_sea, new_sea = band_integrals(band), band_integrals(new)
    T = np.empty((BAND_SIZE, BAND_SIZE))
    for c in range(BAND_SIZE):
        unit = np.zeros(BAND_SIZE)
        unit[c] = 1.0
        z = band_derivatives(unit, band)
        rest1 = (z[1] - old_sea[1] * z[3] - old_sea[2] * z[5]) / old_sea[4]
        rest2 = (z[2] - old_sea[3] * z[4]) / old_sea[5]
        rest0 = (z[0] - old_sea[0] * z[4] - old_sea[6] * old_sea[5] * rest2) / old_sea[7]
        z[1] = new_sea[1] * z[3] + new_sea[2] * z[5] + new_sea[4] * rest1
        z[2] = new_sea[3] * z[4] + new_sea[5] * rest2
        z[0] = new_sea[0] * z[4] + new_sea[6] * new_sea[5] * rest2 + new_sea[7] * rest0
        T[:, c] = band_states(z, new)
    return T

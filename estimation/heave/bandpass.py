"""A learned spectrum as a small state-space model, for use inside a filter.

White noise through a chain of second-order sections, each s / (s^2 + 2 zeta w s + w^2): the gain is zero at
DC, so that the block leaves level and drift to their own states, and falls off on both sides of the peak.
Three sections (six states) follow a sea's spectrum closely; two blocks of two sections (eight states) also
follow wind sea and swell together. Sections are fitted by the Whittle divergence of (spectrum + noise) to
(model + noise).
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.scoring import Place, descend

Array = NDArray[np.float64]

ITERATIONS, TOLERANCE = 60, 0.01
"""Steps of the search at most, and the gain below which it ends: of the divergence summed over the frequencies."""
NARROWEST = 0.02
"""Smallest damping of a section: narrower ones hold on to a phase that a growing swell leaves."""


@dataclass(frozen=True, slots=True)
class BandPass:
    """x' = F x + L w with w white of unit density; heave = ``heave_row`` x [m], rate = ``rate_row`` x [m/s].

    ``f`` (n, n), ``l`` (n, blocks), ``stationary`` (n, n) covariance of x at rest with itself. States of a
    section are its displacement and velocity; the output of a section is its velocity, which drives the next.
    ``omega_radps`` and ``zeta`` (sections,) are the sections' frequencies and dampings, ``divergence`` the
    mean Whittle divergence to the spectrum, per frequency (0 is equal).
    """

    f: Array
    l: Array
    heave_row: Array
    rate_row: Array
    stationary: Array
    omega_radps: Array
    zeta: Array
    divergence: float

    @property
    def size(self) -> int:
        """Number of states."""
        return len(self.f)

    @property
    def parameters(self) -> Array:
        """Gain of each block, then the sections' w [rad/s], then their zeta: (7,) for one block of three."""
        return np.concatenate([self.l.max(axis=0), self.omega_radps, self.zeta])

    @property
    def sd_m(self) -> float:
        """Standard deviation of the heave [m]."""
        return math.sqrt(float(self.heave_row @ self.stationary @ self.heave_row))

    def discrete(self, dt_s: float) -> tuple[Array, Array]:
        """Transition (n, n) and process noise covariance (n, n) over ``dt_s`` [s], exact for white noise."""
        from scipy.linalg import expm

        if not dt_s >= 0:
            raise ValueError("dt_s: must not be negative")
        n = self.size
        blocks = np.zeros((2 * n, 2 * n))
        blocks[:n, :n], blocks[:n, n:] = -self.f, self.l @ self.l.T
        blocks[n:, n:] = self.f.T
        turned = expm(blocks * dt_s)
        phi = turned[n:, n:].T
        noise = phi @ turned[:n, n:]
        return phi, 0.5 * (noise + noise.T)

    def density(self, frequency_hz: Array) -> Array:
        """One-sided spectral density of the heave [m^2/Hz] at ``frequency_hz`` (m,)."""
        s = 2j * np.pi * np.asarray(frequency_hz, np.float64)[:, None, None]
        response = self.heave_row @ np.linalg.solve(s * np.eye(self.size) - self.f, self.l)
        return np.asarray(2.0 * np.sum(np.abs(response) ** 2, axis=-1), np.float64)

    def autocovariance(self, lag_s: Array) -> Array:
        """Covariance of the heave with itself ``lag_s`` (m,) later [m^2]."""
        rows = [self.heave_row @ self.discrete(abs(float(t)))[0] @ self.stationary for t in lag_s]
        return np.array(rows) @ self.heave_row


def fit_band_pass(
    frequency_hz: Array,
    density_m2ps: Array,
    noise_density_m2ps: float,
    *,
    blocks: int = 1,
    previous: BandPass | None = None,
) -> BandPass:
    """Fit one block of three sections (6 states) or two blocks of two (8 states) to a one-sided density
    [m^2/Hz].

    ``frequency_hz`` (m,) evenly spaced; ``noise_density_m2ps`` the one-sided density of the measurement
    noise: what lies below it is not worth fitting. ``previous`` of the same form is where the search begins.
    Raises ValueError for anything that is not a finite positive density.
    """
    frequency = np.asarray(frequency_hz, np.float64)
    density = np.asarray(density_m2ps, np.float64)
    if frequency.ndim != 1 or frequency.shape != density.shape or len(frequency) < 8:
        raise ValueError("density_m2ps: must have the shape of frequency_hz, (m,) with m >= 8")
    if not np.all(np.isfinite(density)) or np.any(density < 0) or density.max() <= 0:
        raise ValueError("density_m2ps: must be finite, not negative and somewhere positive")
    if not noise_density_m2ps > 0:
        raise ValueError("noise_density_m2ps: must be positive")
    if blocks not in {1, 2}:
        raise ValueError("blocks: must be 1 (six states) or 2 (eight states)")
    order = [3] if blocks == 1 else [2, 2]
    omega, scale = 2.0 * np.pi * frequency, float(density.max())
    wanted = density / scale
    noise = noise_density_m2ps / scale
    low, high = math.log(omega[0]), math.log(omega[-1])

    def evaluate(x: Array) -> Place[tuple[Array, Array]]:
        model, gradient = _density(omega, x, order)
        ratio = (wanted + noise) / (model + noise)
        return Place(x, float(np.sum(ratio - 1.0 - np.log(ratio))), (ratio, gradient / (model + noise)))

    def derivatives(place: Place[tuple[Array, Array]]) -> tuple[Array, Array]:
        ratio, by_log = place.state
        return by_log @ (1.0 - ratio), by_log @ by_log.T

    starts = _starts(omega, wanted, order)
    if previous is not None and [len(o) for o in _grouped(previous)] == order:
        starts = [_parameters(previous, scale)]
    bounds = []
    for sections in order:
        bounds += (
            [(-40.0, 40.0)] + [(low, high)] * sections + [(math.log(NARROWEST), math.log(2.0))] * sections
        )
    least, most = np.array(bounds).T
    best = min(
        (
            descend(
                evaluate, derivatives, evaluate(np.clip(s, least, most)), least, most,
                iterations=ITERATIONS, tolerance=TOLERANCE,
            )[0]
            for s in starts
        ),
        key=lambda place: place.value,
    )  # fmt: skip
    return _assemble(best.x, order, scale, best.value / len(omega))


def _density(omega: Array, x: Array, order: list[int]) -> tuple[Array, Array]:
    """Model density (m,) and its gradient (p, m). Parameters of a block: log gain, log w, log zeta."""
    total, rows, at = np.zeros_like(omega), [], 0
    for sections in order:
        w = np.exp(x[at + 1 : at + 1 + sections])[:, None]
        z = np.exp(x[at + 1 + sections : at + 1 + 2 * sections])[:, None]
        stiff, damp = w**2 - omega**2, 2.0 * z * w * omega
        below = stiff**2 + damp**2
        log_value = x[at] + 2.0 * sections * np.log(omega) - np.log(below).sum(axis=0)
        value = np.exp(np.clip(log_value, -100.0, 100.0))
        total = total + value
        rows.append(value[None])
        rows.append(-value * (4.0 * stiff * w**2 + 2.0 * damp**2) / below)
        rows.append(-value * 2.0 * damp**2 / below)
        at += 1 + 2 * sections
    return total, np.vstack(rows)


def _starts(omega: Array, wanted: Array, order: list[int]) -> list[Array]:
    """Sections around the peak; two blocks also around the two halves of the power."""
    power = np.cumsum(wanted) / wanted.sum()
    quantile = [float(omega[int(np.searchsorted(power, q))]) for q in (0.25, 0.5, 0.75)]
    peak = float(omega[int(np.argmax(wanted))])
    if order == [3]:
        centres = [[[peak, 1.15 * peak, 1.4 * peak]], [[quantile[0], quantile[1], quantile[2]]]]
    else:
        centres = [
            [[peak, 1.1 * peak], [1.7 * peak, 1.9 * peak]],
            [[quantile[0], quantile[0]], [quantile[2], quantile[2]]],
            [[0.6 * peak, 0.65 * peak], [peak, 1.1 * peak]],
        ]
    starts = []
    for choice in centres:
        x: list[float] = []
        for sections, at in zip(order, choice, strict=True):
            block = np.concatenate([[0.0], np.log(at), np.full(sections, math.log(0.25))])
            value, _ = _density(omega, block, [sections])
            block[0] = -math.log(float(value.max()))
            x.extend(block)
        starts.append(np.array(x))
    return starts


def _assemble(x: Array, order: list[int], scale: float, divergence: float) -> BandPass:
    """State-space form; the noise of each block has unit density and enters its first section."""
    from scipy.linalg import solve_continuous_lyapunov

    n, at, row = 2 * sum(order), 0, 0
    f, l = np.zeros((n, n)), np.zeros((n, len(order)))
    heave, rate = np.zeros(n), np.zeros(n)
    omegas, zetas = [], []
    for k, sections in enumerate(order):
        gain = math.sqrt(0.5 * scale) * math.exp(0.5 * x[at])
        w = np.exp(x[at + 1 : at + 1 + sections])
        z = np.exp(x[at + 1 + sections : at + 1 + 2 * sections])
        l[row + 1, k] = gain
        for i in range(sections):
            f[row, row + 1] = 1.0
            f[row + 1, row], f[row + 1, row + 1] = -(w[i] ** 2), -2.0 * z[i] * w[i]
            if i:
                f[row + 1, row - 1] = 1.0
            row += 2
        heave[row - 1] = 1.0
        rate += f[row - 1]
        omegas.append(w)
        zetas.append(z)
        at += 1 + 2 * sections
    stationary = solve_continuous_lyapunov(f, -l @ l.T)
    stationary = 0.5 * (stationary + stationary.T)
    return BandPass(f, l, heave, rate, stationary, np.concatenate(omegas), np.concatenate(zetas), divergence)


def _grouped(block: BandPass) -> list[Array]:
    """Section frequencies by block."""
    each = len(block.omega_radps) // block.l.shape[1]
    return [block.omega_radps[k * each : (k + 1) * each] for k in range(block.l.shape[1])]


def _parameters(block: BandPass, scale: float) -> Array:
    """Invert ``_assemble`` for a density divided by ``scale``."""
    groups, at, x = _grouped(block), 0, []
    for k, omega in enumerate(groups):
        gain = float(block.l[:, k].max())
        zeta = block.zeta[at : at + len(omega)]
        x.append(
            np.concatenate([[2.0 * math.log(gain / math.sqrt(0.5 * scale))], np.log(omega), np.log(zeta)])
        )
        at += len(omega)
    return np.concatenate(x)

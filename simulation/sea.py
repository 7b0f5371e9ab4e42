"""The sea: wave spectra, and seas drawn from them as sums of sinusoids.

One-sided elevation spectra S(w) [m^2 s/rad] over angular frequency w [rad/s]; the significant height is
four times the square root of their area. Deep water: wave number k = w^2 / g. A sea is a finite sum of
components with random phases, so that elevation, slope and orbital motion have exact derivatives at any
time.
"""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

GRAVITY_MPS2 = 9.81

BEAUFORT_HS_M: dict[int, float] = {0: 0.02, 1: 0.1, 2: 0.2, 3: 0.6}
"""Significant wave height of the open sea at Beaufort 0 to 3 [m] (World Meteorological Organization; 0 is
given the ripple that is left of a calm).
"""
BEAUFORT_WIND_MPS: dict[int, float] = {0: 0.1, 1: 1.0, 2: 2.5, 3: 4.4}
"""Middle of the mean wind speed of Beaufort 0 to 3 [m/s]."""


def pierson_moskowitz(omega_radps: Array, hs_m: float, tp_s: float) -> Array:
    """Return the Pierson-Moskowitz spectrum in its two-parameter form (Bretschneider, ITTC 1978)."""
    wp = 2.0 * np.pi / tp_s
    w = np.maximum(omega_radps, 1e-9)
    spectrum: Array = 5.0 / 16.0 * hs_m**2 * wp**4 / w**5 * np.exp(-1.25 * np.minimum((wp / w) ** 4, 500.0))
    return spectrum


def jonswap(omega_radps: Array, hs_m: float, tp_s: float, gamma: float = 3.3) -> Array:
    """Return the JONSWAP spectrum of peak enhancement ``gamma`` (Hasselmann et al., 1973).

    Scaled to the significant height with 1 - 0.287 ln(gamma) (DNV-RP-C205, 3.5.5), good to one percent for
    gamma from 1 to 7.
    """
    wp = 2.0 * np.pi / tp_s
    width = np.where(omega_radps <= wp, 0.07, 0.09)
    peak = np.exp(-0.5 * ((omega_radps - wp) / (width * wp)) ** 2)
    spectrum: Array = (1.0 - 0.287 * np.log(gamma)) * pierson_moskowitz(omega_radps, hs_m, tp_s) * gamma**peak
    return spectrum


def developed_period_s(hs_m: float) -> float:
    """Return the peak period [s] of the fully developed sea of a significant height (Pierson and Moskowitz,
    1964).

    Hs = 0.21 U^2/g and w_p = 0.877 g/U, with the wind speed U eliminated.
    """
    return float(2.0 * np.pi / 0.877 * np.sqrt(hs_m / (0.21 * GRAVITY_MPS2)))


class Wave(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """One system of waves: ``kind`` is "jonswap", "pierson-moskowitz" or "swell" (JONSWAP with gamma 7).

    ``direction_rad`` is where the waves run to, from north towards east; ``spread_rad`` the 1-sigma about it.
    """

    kind: str
    hs_m: float
    tp_s: float
    direction_rad: float = 0.0
    spread_rad: float = 0.3

    def spectrum(self, omega_radps: Array) -> Array:
        """Return the elevation spectrum; raises ``ValueError`` for an unknown kind."""
        if self.kind == "jonswap":
            return jonswap(omega_radps, self.hs_m, self.tp_s)
        if self.kind == "pierson-moskowitz":
            return pierson_moskowitz(omega_radps, self.hs_m, self.tp_s)
        if self.kind == "swell":
            return jonswap(omega_radps, self.hs_m, self.tp_s, gamma=7.0)
        raise ValueError(f"wave kind {self.kind!r} is unknown; use jonswap, pierson-moskowitz or swell")


@dataclass(frozen=True, slots=True)
class Sea:
    """A drawn sea: component amplitudes [m], angular frequencies [rad/s], phases [rad], directions [rad];
    all (m,).
    """

    amplitude_m: Array
    omega_radps: Array
    phase_rad: Array
    direction_rad: Array

    @classmethod
    def draw(cls, waves: list[Wave], rng: np.random.Generator, components: int = 80) -> Sea:
        """Draw a sea with ``components`` sinusoids for each system of waves.

        Frequencies are drawn one from each of as many bands of equal width, which keeps the sum from
        repeating; amplitudes are those of the band's energy, phases uniform.
        """
        parts: list[tuple[Array, Array, Array, Array]] = []
        for wave in waves:
            wp = 2.0 * np.pi / wave.tp_s
            edges = np.linspace(0.4 * wp, 4.0 * wp, components + 1)
            omega = edges[:-1] + np.diff(edges) * rng.random(components)
            # Energy of the band, not at the drawn frequency, so that the height is the one asked for.
            fine = edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(16) + 0.5) / 16.0
            energy = wave.spectrum(fine.ravel()).reshape(fine.shape).mean(axis=1) * np.diff(edges)
            phase = 2.0 * np.pi * rng.random(components)
            direction = wave.direction_rad + wave.spread_rad * rng.standard_normal(components)
            parts.append((np.sqrt(2.0 * energy), omega, phase, direction))
        if not parts:
            return cls(*(np.zeros(0) for _ in range(4)))
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    @property
    def significant_height_m(self) -> float:
        """Four times the standard deviation of the elevation [m]."""
        return float(4.0 * np.sqrt(np.sum(self.amplitude_m**2) / 2.0))


def beaufort(force: int, direction_rad: float = 0.0) -> list[Wave]:
    """Return the wind sea of Beaufort 0 to 3: a JONSWAP sea of the scale's height and its developed period.

    Raises ``ValueError`` for any other force.
    """
    if force not in BEAUFORT_HS_M:
        raise ValueError(f"Beaufort {force} is not among the seas that are flown over; use 0, 1, 2 or 3")
    hs = BEAUFORT_HS_M[force]
    return [Wave("jonswap", hs, developed_period_s(hs), direction_rad)]

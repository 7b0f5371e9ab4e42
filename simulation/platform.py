"""An anchored raft: how it heaves, sways and tilts in a sea, with exact derivatives.

The response amplitude operators are those of a small raft of length L: the waves' elevation averaged over L
(a sinc of k L / 2), followed by a resonance of second order. Heave follows the averaged elevation, sway the
averaged horizontal orbital motion along each wave's direction, tilt the averaged slope. On its anchor line
the raft drifts slowly inside the circle ``r_plat``.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import msgspec
import numpy as np

from simulation.jets import Array, Complex, Tones, constant, sinusoids
from simulation.sea import GRAVITY_MPS2, Sea


class Raft(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A raft and its mooring.

    ``length_m``; natural period [s] and damping ratio of heave and of tilt; ``circle_m`` is r_plat, the
    radius that the slow drift stays in; ``drift_period_s`` its typical period; ``freeboard_m`` the deck
    above the mean level.
    """

    length_m: float = 2.0
    heave_period_s: float = 1.4
    heave_damping: float = 0.25
    tilt_period_s: float = 1.6
    tilt_damping: float = 0.3
    circle_m: float = 2.0
    drift_period_s: float = 45.0
    freeboard_m: float = 0.4

    def heave_rao(self, omega_radps: Array) -> Complex:
        """Return heave over elevation, complex, shape (m,)."""
        return self._averaged(omega_radps) * _resonance(omega_radps, self.heave_period_s, self.heave_damping)

    def tilt_rao(self, omega_radps: Array) -> Complex:
        """Return tilt over wave slope, complex, shape (m,)."""
        return self._averaged(omega_radps) * _resonance(omega_radps, self.tilt_period_s, self.tilt_damping)

    def _averaged(self, omega_radps: Array) -> Array:
        k = omega_radps**2 / GRAVITY_MPS2
        averaged: Array = np.sinc(k * self.length_m / (2.0 * np.pi))
        return averaged


def _resonance(omega_radps: Array, period_s: float, damping: float) -> Complex:
    ratio = omega_radps * period_s / (2.0 * np.pi)
    return np.asarray(1.0 / (1.0 - ratio**2 + 2.0j * damping * ratio), dtype=np.complex128)


@dataclass(frozen=True, slots=True)
class PlatformMotion:
    """The deck's centre over time, NED from the anchor's place at the mean level, and its tilt.

    ``position`` is a jet (4, n, 3); ``normal`` (4, n, 3) the jet of a vector along the deck's downward
    normal, not normalised (1 in its third component, the slopes in the others).
    """

    position: Array
    normal: Array


@dataclass(frozen=True, slots=True)
class Platform:
    """A raft in a sea; ``drift`` is its slow motion on the anchor line, in the first two axes."""

    raft: Raft
    sea: Sea
    drift: Tones = field(repr=False)

    @classmethod
    def draw(cls, raft: Raft, sea: Sea, rng: np.random.Generator, tones: int = 4) -> Platform:
        """Draw the slow drift on the anchor line; it never leaves the circle."""
        share = rng.dirichlet(np.ones(tones), size=2)
        # Neither axis ever exceeds the circle over the square root of two.
        amplitude = np.vstack([share * raft.circle_m / np.sqrt(2.0), np.zeros((1, tones))])
        omega = 2.0 * np.pi / (raft.drift_period_s * rng.uniform(0.7, 2.0, size=(3, tones)))
        return cls(raft, sea, Tones(amplitude, omega, 2.0 * np.pi * rng.random((3, tones))))

    def motion(self, t_s: Array) -> PlatformMotion:
        """Return the deck's motion at the times t_s (n,)."""
        sea, raft = self.sea, self.raft
        waves = sea.amplitude_m * np.exp(1j * sea.phase_rad)
        heave = raft.heave_rao(sea.omega_radps) * waves
        # Deep water: the orbital motion along the waves' direction is a quarter period behind the elevation, and as
        # large; the slope is as late, and k = w^2 / g times as large.
        sway = -1j * heave
        slope = -1j * raft.tilt_rao(sea.omega_radps) * waves * sea.omega_radps**2 / GRAVITY_MPS2
        north, east = np.cos(sea.direction_rad), np.sin(sea.direction_rad)
        both = np.stack([sway * north, sway * east, -heave, slope * north, slope * east], axis=1)
        moved = sinusoids(t_s, sea.omega_radps, both)
        position = constant(t_s, (0.0, 0.0, -raft.freeboard_m)) + moved[:, :, :3]
        # A deck that rises towards north has a downward normal that leans north.
        normal = constant(t_s, (0.0, 0.0, 1.0))
        normal[:, :, :2] += moved[:, :, 3:]
        position[:, :, :2] += self.drift.motion(t_s)[:, :, :2]
        return PlatformMotion(position, normal)

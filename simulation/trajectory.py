"""The true motion of a multirotor on a flight to the platform, exact and consistent in all its derivatives.

The path is planned as smooth steps from place to place; wind sway is added in the air, and before touchdown
the vehicle takes up the deck's motion and rides on it. The attitude follows from the motion as a
multirotor's does: the thrust, which is specific force less the rotors' drag, points along the body's up
axis, and the yaw is planned. The angular velocity is the exact derivative of that attitude.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

from simulation.jets import Array, Tones, constant, product, step
from simulation.platform import Platform

PHASES = ("rest", "climb", "cruise", "hover", "descent", "deck")


class Plan(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """A flight as durations and places. Lengths in m, NED from the anchor at the mean sea level; yaw in rad.

    ``start_m`` is the place of take-off (a quay), ``legs_m`` the places flown to one after the other at
    ``altitude_m`` above the sea, before the platform; each leg takes ``leg_s``. ``gear_m`` is the height of
    the inertial sensor above the deck when the vehicle stands on it. ``yaw_rad`` holds the heading at
    start, and then that at the end of each leg, the last one towards the platform included.
    """

    rest_s: float = 8.0
    climb_s: float = 8.0
    leg_s: float = 12.0
    hover_s: float = 14.0
    descent_s: float = 16.0
    deck_s: float = 4.0
    altitude_m: float = 15.0
    gear_m: float = 0.1
    start_m: tuple[float, float, float] = (-40.0, -25.0, -2.0)
    legs_m: tuple[tuple[float, float], ...] = ((20.0, 30.0),)
    yaw_rad: tuple[float, ...] = (0.6, 1.2, -0.5)

    def __post_init__(self) -> None:
        """Raise ``ValueError`` for durations that are not positive and for a number of headings that does
        not fit.
        """
        for name in ("rest_s", "climb_s", "leg_s", "hover_s", "descent_s", "deck_s"):
            if not getattr(self, name) > 0.0:
                raise ValueError(f"plan.{name} is {getattr(self, name)}; give a positive duration")
        if len(self.yaw_rad) != len(self.legs_m) + 2:
            raise ValueError(
                f"plan.yaw_rad has {len(self.yaw_rad)} headings; give {len(self.legs_m) + 2}: at the start, and "
                "one for each leg and the last leg to the platform"
            )

    @property
    def cruise_s(self) -> float:
        """Time from the end of the climb to the arrival over the platform [s]."""
        return self.leg_s * (len(self.legs_m) + 1)

    @property
    def bounds_s(self) -> dict[str, tuple[float, float]]:
        """Begin and end of each phase [s]."""
        durations = (self.rest_s, self.climb_s, self.cruise_s, self.hover_s, self.descent_s, self.deck_s)
        ends = np.cumsum(durations)
        return {
            name: (float(end - d), float(end)) for name, end, d in zip(PHASES, ends, durations, strict=True)
        }

    @property
    def duration_s(self) -> float:
        """Duration of the whole flight [s]."""
        return self.bounds_s["deck"][1]

    @property
    def touchdown_s(self) -> float:
        """Time of contact [s]."""
        return self.bounds_s["descent"][1]


class Rock(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """Rocking on purpose: for ``duration_s`` from ``start_s`` on [s] the vehicle goes round in a small circle,
    tilted by ``tilt_deg``, once in ``period_s``; or to and fro, the first half of the time towards north, then towards
    east. It is let in and out over a second at both ends.
    """

    start_s: float = 0.0
    duration_s: float = 0.0
    tilt_deg: float = 6.0
    period_s: float = 1.2
    path: Literal["circle", "to and fro"] = "circle"

    def motion(self, t_s: Array, gravity_mps2: float) -> Array:
        """Return the displacement, a jet (4, n, 3) [m]."""
        omega = 2.0 * np.pi / self.period_s
        radius = gravity_mps2 * np.tan(np.radians(self.tilt_deg)) / omega**2
        circle = Tones(
            radius * np.array([[1.0], [1.0], [0.0]]),
            np.full((3, 1), omega),
            np.array([[0.0], [np.pi / 2.0], [0.0]]),
        ).motion(t_s)
        if self.path == "circle":
            return product(self._shown(t_s, self.start_s, self.duration_s), circle)
        half = 0.5 * self.duration_s
        for axis in range(2):
            shown = self._shown(t_s, self.start_s + axis * half, half)
            circle[:, :, axis : axis + 1] = product(shown, circle[:, :, axis : axis + 1])
        return circle

    def _shown(self, t_s: Array, start_s: float, duration_s: float) -> Array:
        return step(t_s, start_s, 1.0) - step(t_s, start_s + duration_s - 1.0, 1.0)


def _none() -> Tones:
    return Tones(np.zeros((3, 0)), np.zeros((3, 0)), np.zeros((3, 0)))


@dataclass(frozen=True, slots=True)
class Wind:
    """Mean wind and gusts, NED [m/s], and the sway that they cause in the vehicle's place [m]."""

    mean_mps: tuple[float, float, float] = (0.0, 0.0, 0.0)
    gust: Tones = field(default_factory=_none)
    sway: Tones = field(default_factory=_none)

    @classmethod
    def draw(
        cls, speed_mps: float, direction_rad: float, sway_m: float, rng: np.random.Generator, tones: int = 6
    ) -> Wind:
        """Draw wind that blows towards a direction, gusts of 15 % of its speed, and sway of ``sway_m``
        (1-sigma).
        """
        mean = (float(speed_mps * np.cos(direction_rad)), float(speed_mps * np.sin(direction_rad)), 0.0)
        axes = np.array([1.0, 1.0, 0.3])
        return cls(
            mean, _draw_tones(0.15 * speed_mps * axes, rng, tones), _draw_tones(sway_m * axes, rng, tones)
        )


def _draw_tones(sigma: Array, rng: np.random.Generator, tones: int) -> Tones:
    """Draw tones from 0.08 to 0.6 Hz whose sum has these standard deviations (3,); slow ones are the larger."""
    omega = 2.0 * np.pi * np.exp(rng.uniform(np.log(0.08), np.log(0.6), size=(3, tones)))
    weight = rng.uniform(0.5, 1.0, size=(3, tones)) / omega
    amplitude = np.sqrt(2.0) * sigma[:, None] * weight / np.linalg.norm(weight, axis=1, keepdims=True)
    return Tones(amplitude, omega, rng.uniform(0.0, 2.0 * np.pi, size=(3, tones)))


@dataclass(frozen=True, slots=True)
class Motion:
    """The vehicle (its inertial sensor) at the times ``t_s`` (n,).

    ``position_m``, ``velocity_mps``, ``acceleration_mps2`` (n, 3) NED; ``quaternion`` (n, 4) and ``R_nb``
    (n, 3, 3) body to NED; ``angular_velocity_radps`` and ``specific_force_mps2`` (n, 3) in the body frame.
    """

    t_s: Array
    position_m: Array
    velocity_mps: Array
    acceleration_mps2: Array
    quaternion: Array
    R_nb: Array
    angular_velocity_radps: Array
    specific_force_mps2: Array


@dataclass(frozen=True, slots=True)
class Trajectory:
    """A flight by plan in a wind to a platform, rocking where asked to. ``drag_per_s`` is the rotors' linear drag over
    mass.
    """

    plan: Plan
    wind: Wind
    platform: Platform
    gravity_mps2: float
    drag_per_s: float = 0.25
    rock: Rock | None = None

    def phase(self, t_s: Array) -> NDArray[np.int64]:
        """Return the phase of each time, as an index of ``PHASES``."""
        ends = [b[1] for b in self.plan.bounds_s.values()]
        index: NDArray[np.int64] = np.searchsorted(ends[:-1], t_s, side="right")
        return index

    def motion(self, t_s: Array) -> Motion:
        """Return the true motion at any times [s]."""
        plan = self.plan
        deck = self.platform.motion(t_s)
        climb, descent = plan.bounds_s["climb"], plan.bounds_s["descent"]
        # In the air: from just after lift-off until the deck's motion has been taken up.
        match_s = 0.5 * plan.descent_s
        ride = step(t_s, descent[1] - 1.2 * match_s, match_s)
        airborne = product(step(t_s, climb[0], 0.5 * plan.climb_s), constant(t_s, 1.0) - ride)
        mean_deck = constant(t_s, (0.0, 0.0, -self.platform.raft.freeboard_m))
        position = self._path(t_s)
        position += product(airborne, self.wind.sway.motion(t_s)) + product(ride, deck.position - mean_deck)
        if self.rock is not None:
            position += self.rock.motion(t_s, self.gravity_mps2)
        relative_wind = constant(t_s, self.wind.mean_mps) + self.wind.gust.motion(t_s)
        force = position[2] - [0.0, 0.0, self.gravity_mps2]
        force_rate = position[3]
        # Thrust = specific force + drag; on the deck what stands for it is the deck's upward normal.
        v, a = position[1] - relative_wind[0], position[2] - relative_wind[1]
        drag = self.drag_per_s * product(airborne, np.stack([v, a, a, a]))[:2]
        stand = -self.gravity_mps2 * deck.normal[:2]
        aloft = constant(t_s, 1.0) - ride
        thrust = aloft[0][:, None] * (force + drag[0]) + ride[0][:, None] * stand[0]
        thrust_rate = (
            aloft[0][:, None] * (force_rate + drag[1])
            + aloft[1][:, None] * (force + drag[0])
            + ride[0][:, None] * stand[1]
            + ride[1][:, None] * stand[0]
        )
        R, rates = _attitude(thrust, thrust_rate, *self._yaw(t_s)[:2])
        return Motion(
            t_s=t_s,
            position_m=position[0],
            velocity_mps=position[1],
            acceleration_mps2=position[2],
            quaternion=quaternions(R),
            R_nb=R,
            angular_velocity_radps=rates,
            specific_force_mps2=np.einsum("nji,nj->ni", R, force),
        )

    def _path(self, t_s: Array) -> Array:
        """Return the planned path, a jet (4, n, 3), without sway and deck motion."""
        plan = self.plan
        bounds = plan.bounds_s
        start = np.array(plan.start_m)
        end_down = -self.platform.raft.freeboard_m - plan.gear_m
        path = constant(t_s, start)
        path[:, :, 2] += step(t_s, bounds["climb"][0], plan.climb_s) * (-plan.altitude_m - start[2])
        here = start[:2]
        for k, there in enumerate([*plan.legs_m, (0.0, 0.0)]):
            leg = step(t_s, bounds["cruise"][0] + k * plan.leg_s, plan.leg_s)
            path[:, :, :2] += leg[:, :, None] * (np.array(there) - here)
            here = np.array(there)
        path[:, :, 2] += step(t_s, bounds["descent"][0], plan.descent_s) * (end_down + plan.altitude_m)
        return path

    def _yaw(self, t_s: Array) -> Array:
        plan = self.plan
        yaw = constant(t_s, plan.yaw_rad[0])
        for k, change in enumerate(np.diff(plan.yaw_rad)):
            yaw = yaw + step(t_s, plan.bounds_s["cruise"][0] + k * plan.leg_s, plan.leg_s) * change
        return yaw


def quaternions(matrices: Array) -> Array:
    """Return the unit quaternions (n, 4), w x y z with w >= 0, of rotation matrices (n, 3, 3) (largest
    component).
    """
    m = matrices
    d = np.einsum("nii->ni", m)
    trace = d.sum(axis=1, keepdims=True)
    # 4 q q' from the matrix; its row of the largest diagonal element is q, up to its length.
    outer = np.empty((len(m), 4, 4))
    outer[:, 0, 0] = 1.0 + trace[:, 0]
    outer[:, [1, 2, 3], [1, 2, 3]] = 1.0 + 2.0 * d - trace
    for k, (i, j) in enumerate(((1, 2), (2, 0), (0, 1)), start=1):
        outer[:, 0, k] = outer[:, k, 0] = m[:, j, i] - m[:, i, j]
        outer[:, i + 1, j + 1] = outer[:, j + 1, i + 1] = m[:, i, j] + m[:, j, i]
    best = np.argmax(np.einsum("nii->ni", outer), axis=1)
    q = outer[np.arange(len(m)), best]
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    signed: Array = np.where(q[:, :1] < 0.0, -q, q)
    return signed


def _attitude(up: Array, up_rate: Array, yaw: Array, yaw_rate: Array) -> tuple[Array, Array]:
    """Return R_nb (n, 3, 3) and the body's angular velocity (n, 3) from the direction that the body's up
    axis takes (n, 3, of any length) with its derivative, and from the yaw (n,) with its own.

    The body's axes are b3 = -up, b2 along b3 x (cos yaw, sin yaw, 0), b1 = b2 x b3; omega = vee(R' dR/dt).
    """
    b3, d3 = _unit(-up, -up_rate)
    c = np.stack([np.cos(yaw), np.sin(yaw), np.zeros_like(yaw)], axis=1)
    dc = yaw_rate[:, None] * np.stack([-np.sin(yaw), np.cos(yaw), np.zeros_like(yaw)], axis=1)
    b2, d2 = _unit(np.cross(b3, c), np.cross(d3, c) + np.cross(b3, dc))
    b1, d1 = np.cross(b2, b3), np.cross(d2, b3) + np.cross(b2, d3)
    rates = np.stack([np.sum(b3 * d2, axis=1), np.sum(b1 * d3, axis=1), np.sum(b2 * d1, axis=1)], axis=1)
    return np.stack([b1, b2, b3], axis=2), rates


def _unit(v: Array, dv: Array) -> tuple[Array, Array]:
    length = np.linalg.norm(v, axis=1, keepdims=True)
    u = v / length
    return u, (dv - u * np.sum(u * dv, axis=1, keepdims=True)) / length

"""Vision fixes of a simulated camera, drawn from the very description that the estimator uses.

A fix is the target's centre in the camera, ``P^c = (1 + s) R_cb exp(m)' (R_nb' (P_platform - P) - l)``, with noise
across and along the line of sight as ``config.vision`` states them. Range scale ``s``, mounting error ``m`` and the
age of the content at its stamp are drawn once for a flight from their priors (the age within its box), and the age
wanders as its walk says. There is no fix while the target's centre is outside the picture, nearer or farther than
it can be recognised, or hidden.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import msgspec
import numpy as np
from numpy.typing import NDArray

from estimation.frames import R_CB_NOMINAL, euler_to_quat, quat_exp, quat_to_matrix
from estimation.sensor_config import VisionConfig
from estimation.update import MAX_LATENCY_S
from simulation.jets import Array
from simulation.trajectory import Trajectory

_Angle = Annotated[float, msgspec.Meta(gt=0.0, lt=180.0)]


class View(msgspec.Struct, forbid_unknown_fields=True, frozen=True, kw_only=True):
    """What a camera can see of the target: angles of view across and along the picture, the ranges at which the
    target is recognised, how far outside of the picture (in the target's plane) its centre may lie, since a part of the
    rings is enough (at most, and as a share of the distance, since they leave a near picture with the centre), and
    times [s] at which it is hidden.
    """

    horizontal_deg: _Angle = 62.2
    vertical_deg: _Angle = 48.8
    nearest_m: float = 0.3
    farthest_m: float = 34.0
    outside_m: float = 0.0
    outside_share: float = 0.25
    hidden_s: tuple[tuple[float, float], ...] = ()

    @classmethod
    def of_target(cls, diameter_m: float) -> View:
        """Return how the recommended ring target of this outer diameter [m] is recognised in 640x480 pixels.

        From what ``TargetDetector`` recognises in rendered pictures (``benchmarks/fix_model.py``): nearer than a
        diameter a part of the rings is enough. Over the target's middle it sees the small rings down to a tenth of the
        diameter.
        """
        return cls(nearest_m=0.1 * diameter_m, farthest_m=34.0 * diameter_m, outside_m=0.15 * diameter_m)

    def sees(self, t_s: Array, seen_m: Array) -> NDArray[np.bool_]:
        """Return at which of the times t_s (n,) a target at ``seen_m`` (n, 3), camera axes, is seen."""
        across, along = (math.tan(math.radians(0.5 * a)) for a in (self.horizontal_deg, self.vertical_deg))
        x, y, z = seen_m.T
        distance = np.linalg.norm(seen_m, axis=1)
        reach = np.minimum(self.outside_m, self.outside_share * z)
        seen: NDArray[np.bool_] = (
            (z > 0.0) & (np.abs(x) < across * z + reach) & (np.abs(y) < along * z + reach)
        )
        seen &= (distance > self.nearest_m) & (distance < self.farthest_m)
        for begin, end in self.hidden_s:
            seen &= (t_s < begin) | (t_s >= end)
        return seen


@dataclass(frozen=True, slots=True)
class CameraErrors:
    """What is constant, or slow, in a flight's fixes: range scale, mounting (3,) [rad], age less the calibrated one
    (n,) [s] at each time of content.
    """

    scale: float
    mount_rad: Array
    latency_s: Array

    @classmethod
    def draw(cls, config: VisionConfig, t_s: Array, rng: np.random.Generator) -> CameraErrors:
        """Draw them from the priors that the estimator is told."""
        scale = float(config.scale_sigma * rng.standard_normal())
        mount = config.mount_sigma_rad * rng.standard_normal(3)
        steps = config.latency_walk * np.sqrt(np.diff(t_s, prepend=t_s[:1])) * rng.standard_normal(len(t_s))
        steps[:1] = config.latency_sigma_s * rng.standard_normal()
        latency = np.cumsum(steps)
        return cls(scale, mount, np.clip(latency, -config.latency_s, MAX_LATENCY_S - config.latency_s))


@dataclass(frozen=True, slots=True)
class Fixes:
    """Fixes ``position_cam_m`` (n, 3), the covariances that they state (n, 6), upper triangles, and ``seen`` (n,):
    where there is a fix at all.
    """

    position_cam_m: Array
    covariance_m2: Array
    seen: NDArray[np.bool_]


def seen_from(config: VisionConfig, position_m: Array, R_nb: Array, deck_m: Array, mount_rad: Array) -> Array:
    """Return the target's centre in a camera with this mounting error, without noise, (n, 3), for vehicles at
    ``position_m`` (n, 3) with attitudes ``R_nb`` (n, 3, 3) and targets at ``deck_m`` (n, 3), NED.
    """
    body = np.einsum("nji,nj->ni", R_nb, deck_m - position_m) - np.array(config.lever_arm_m)
    R_cb = R_CB_NOMINAL @ quat_to_matrix(euler_to_quat(*config.mount_rpy_rad)).T
    seen: Array = body @ (R_cb @ quat_to_matrix(quat_exp(mount_rad)).T).T
    return seen


def draw_fixes(
    config: VisionConfig, view: View, trajectory: Trajectory, t_s: Array, errors: CameraErrors,
    rng: np.random.Generator,
) -> Fixes:  # fmt: skip
    """Draw the fixes whose content is of the times t_s (n,)."""
    m = trajectory.motion(t_s)
    deck = trajectory.platform.motion(t_s).position[0]
    return noisy(
        config, view, t_s, seen_from(config, m.position_m, m.R_nb, deck, errors.mount_rad), errors, rng
    )


def noisy(
    config: VisionConfig, view: View, t_s: Array, true: Array, errors: CameraErrors, rng: np.random.Generator
) -> Fixes:
    """Draw the fixes of targets at ``true`` (n, 3), camera axes. Their noise is what they state and the floor."""
    distance = np.maximum(np.linalg.norm(true, axis=1, keepdims=True), 1e-6)
    ray = true / distance
    across, along = config.angle_sigma_rad * distance, config.range_sigma * distance
    white = rng.standard_normal((len(t_s), 3))
    along_ray = np.sum(white * ray, axis=1, keepdims=True) * ray
    noise = across * (white - along_ray) + along * along_ray
    noise += config.floor_m * rng.standard_normal((len(t_s), 3))
    stated = (along**2 - across**2)[:, :, None] * ray[:, :, None] * ray[:, None, :]
    stated += across[:, :, None] ** 2 * np.eye(3)
    upper = stated[:, [0, 0, 0, 1, 1, 2], [0, 1, 2, 1, 2, 2]]
    return Fixes((1.0 + errors.scale) * true + noise, upper, view.sees(t_s, true))

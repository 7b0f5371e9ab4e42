"""The result of looking at one image: a fix, or the reason why there is none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True)
class VisionFix:
    """Where the target's centre is, in the camera frame.

    ``position_cam_m`` (3,) is P^c of seed (4.27); ``covariance_m2`` (3, 3). ``rings`` are the indices of
    the edges that were measured (into ``RingTarget.edges_m``), ``residual_px`` the scatter of their
    displacements from the model, ``tilt_rad`` (2,) the rotation of the deck about the level x and y axes
    where it was estimated, else None. ``share`` of the visible edge length that agrees with the model,
    ``blur_px`` the blur's 1-sigma. ``rotation`` takes the camera to the plane of the target (``R_nc`` for a
    level deck). ``points_px`` (n, 2) are the places that were compared and ``agrees`` (n,) the outcome.
    """

    position_cam_m: Array
    covariance_m2: Array
    rings: tuple[int, ...]
    residual_px: float
    share: float
    blur_px: float
    method: str
    rotation: Array
    tilt_rad: Array | None = None
    points_px: Array | None = None
    agrees: NDArray[np.bool_] | None = None


@dataclass(frozen=True, slots=True)
class NoFix:
    """No target, and why. False in a condition."""

    reason: str

    def __bool__(self) -> bool:
        """Return False, so that ``if fix:`` reads well."""
        return False

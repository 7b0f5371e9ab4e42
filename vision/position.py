"""From a fit in the level plane to the target's position in camera axes, with the errors that are stated."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from estimation.frames import skew
from vision.lines import Edges
from vision.refine import Fit

Array = NDArray[np.float64]

SHARP_BLUR_PX = 0.7
BLUR_ERROR = 0.04
"""Error of an edge's place that all edges share, per pixel of blur beyond that of a sharp picture, where blurred
edges reach their neighbours."""
GROWTH_ERROR = 0.06
"""The same per pixel of growth beyond what noise explains: it is taken as equal for all edges, and is not quite."""


@dataclass(frozen=True, slots=True)
class Positions:
    """Turns fits into positions; the errors are 1-sigma, as ``TargetDetector`` states them."""

    edges: Edges
    attitude_sigma_rad: float
    focal_sigma: float
    principal_point_sigma_px: float
    model_error_px: float

    def of(self, fit: Fit, known_attitude: bool) -> tuple[Array, Array]:
        """Return P^c [m] and its covariance [m^2]."""
        plane, kappa = fit.plane, fit.kappa
        ray = np.array([fit.centre[0], fit.centre[1], 1.0])
        back = plane.rotation.T
        position = back @ ray / kappa
        jacobian = np.empty((3, 5))
        jacobian[:, :2] = back[:, :2] / kappa
        jacobian[:, 2] = -position / kappa
        jacobian[:, 3:] = (back @ skew(ray))[:, :2] / kappa
        unit = float(plane.units_per_pixel(fit.centre[0], fit.centre[1]))
        # The wider an edge and the nearer its neighbours, the more the shape of its profile matters.
        gap_px = float(self.edges.near_m[list(fit.edges)].min()) * kappa / unit
        crowding = min(1.0, 6.0 * fit.blur_px / gap_px)
        blur_error = BLUR_ERROR * max(0.0, fit.blur_px - SHARP_BLUR_PX) * crowding
        growth = math.sqrt(max(0.0, fit.growth_px**2 - fit.growth_sigma_px**2))
        outward = math.hypot(self.model_error_px, blur_error, GROWTH_ERROR * growth)
        sigmas = (self.focal_sigma, self.principal_point_sigma_px, self.principal_point_sigma_px, outward)
        shifts = fit.considered * sigmas
        covariance = jacobian @ (fit.covariance + shifts @ shifts.T) @ jacobian.T
        if known_attitude and self.attitude_sigma_rad > 0.0:
            turn = skew(position)
            covariance += self.attitude_sigma_rad**2 * (turn @ turn.T)
        return position, 0.5 * (covariance + covariance.T)

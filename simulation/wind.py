"""Wind near the sea: a mean and Dryden's turbulence as the vehicle meets it.

The low-altitude form of MIL-F-8785C: sigma_w is a tenth of the wind at 20 ft, sigma_u and sigma_v, and the lengths,
grow with the height (taken as 3 m where it is less: the form is not given below). Turbulence is carried past the
vehicle by the mean wind (Taylor's hypothesis), at 1 m/s or faster.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from simulation.jets import Array

_FOOT_M = 0.3048


@dataclass(slots=True)
class Turbulence:
    """Gusts along (u), across (v) and down (w) the mean wind, from one first-order and two second-order filters."""

    speed_mps: float
    direction_rad: float
    rng: np.random.Generator
    _u: float = 0.0
    _vw: Array = field(default_factory=lambda: np.zeros((2, 2)))

    def step(self, height_m: float, dt_s: float) -> Array:
        """Return the wind (3,), NED, after a time ``dt_s`` at this height; the filters' step is exact."""
        if self.speed_mps <= 0.0:
            return np.zeros(3)
        h = max(height_m, 3.0) / _FOOT_M
        slope = 0.177 + 0.000823 * min(h, 1000.0)
        sigma_w = 0.1 * self.speed_mps
        sigma = np.array([sigma_w / slope**0.4, sigma_w])
        length = np.array([h / slope**1.2, h]) * _FOOT_M
        pace = max(self.speed_mps, 1.0)
        a = pace / length
        decay = math.exp(-a[0] * dt_s)
        white = self.rng.standard_normal(5)
        self._u = decay * self._u + sigma[0] * math.sqrt(1.0 - decay * decay) * white[0]
        gusts = [self._u]
        for k in range(2):
            gusts.append(self._second(k, float(sigma[k]), float(a[k]), dt_s, white[1 + 2 * k : 3 + 2 * k]))
        c, s = math.cos(self.direction_rad), math.sin(self.direction_rad)
        along, across = self.speed_mps + gusts[0], gusts[1]
        return np.array([along * c - across * s, along * s + across * c, gusts[2]])

    def _second(self, k: int, sigma: float, a: float, dt: float, white: Array) -> float:
        """Step y of (1 + sqrt(3) s/a) / (1 + s/a)^2 driven by white noise, scaled to a standard deviation of sigma.

        States z' = -a z + n, y' = -a y + a z have the exact transition exp(-a dt) [[1, 0], [a dt, 1]]; the noise of a
        step is what that takes away from the stationary covariance.
        """
        # By hand: matrices of two rows, many times a second.
        z, y = self._vw[k].tolist()
        e, q = math.exp(-a * dt), a * dt
        r11 = 0.5 * (1.0 - e * e) / a
        r21 = (0.25 - e * e * (0.5 * q + 0.25)) / a
        r22 = (0.25 - e * e * (0.5 * q * q + 0.5 * q + 0.25)) / a
        l11 = math.sqrt(r11 + 1e-18)
        l21 = r21 / l11
        l22 = math.sqrt(max(r22 + 1e-18 - l21 * l21, 0.0))
        w1, w2 = white.tolist()
        z, y = e * z + l11 * w1, e * (q * z + y) + l21 * w1 + l22 * w2
        self._vw[k] = z, y
        # sqrt(3) z + (1 - sqrt(3)) y has the variance (1/a) (3/2 + (1 - r)^2/4 + r (1 - r)/2), r = sqrt(3): 1/a.
        r = math.sqrt(3.0)
        variance = (r * r * 0.5 + (1.0 - r) ** 2 * 0.25 + 2.0 * r * (1.0 - r) * 0.25) / a
        return float(sigma * (r * z + (1.0 - r) * y) / math.sqrt(variance))

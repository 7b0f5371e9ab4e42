"""Where local positions in a log are measured from, and in what metres.

ArduPilot converts between degrees and local metres on a sphere, not on the WGS-84 ellipsoid: one degree of
latitude is 111 318.845 m, one of longitude that times the cosine of the latitude (``Location.cpp``). A filter
that works on the ellipsoid sees the same fixes up to 0.35 % farther apart, so each origin comes with the two
factors that turn the log's metres north and east into metres on the ellipsoid at that place.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from estimation.frames import WGS84_A_M, WGS84_E2

_DEGREE_M = 111_318.84502145034
"""Length of one degree of latitude on ArduPilot's sphere [m] (0.011131884502145034 m per 1e-7 deg)."""


def ardupilot_scales(latitude_deg: float) -> tuple[float, float]:
    """Return the factors north and east from ArduPilot's local metres to metres on the ellipsoid."""
    latitude = math.radians(latitude_deg)
    w2 = 1.0 - WGS84_E2 * math.sin(latitude) ** 2
    meridian = WGS84_A_M * (1.0 - WGS84_E2) / w2**1.5
    normal = WGS84_A_M / math.sqrt(w2)
    sphere = math.degrees(_DEGREE_M)
    return meridian / sphere, normal / sphere


def ardupilot_origin(
    places: NDArray[np.float64], position_ned_m: NDArray[np.float64]
) -> tuple[float, float, float] | None:
    """Return the point [deg, deg, m] from which local positions (n, 3) are measured.

    ``places`` (n, 3) are the same positions as latitude, longitude [deg] and altitude [m].

    The median over the log removes the rounding to 1e-7 deg. None where no row is finite.
    """
    latitude_deg, longitude_deg, altitude_m = places.T
    north, east, down = position_ned_m.T
    latitude = latitude_deg - north / _DEGREE_M
    longitude = longitude_deg - east / (_DEGREE_M * np.cos(np.radians(0.5 * (latitude_deg + latitude))))
    points = np.stack([latitude, longitude, altitude_m + down], axis=1)
    points = points[np.isfinite(points).all(axis=1)]
    if len(points) == 0:
        return None
    middle = np.median(points, axis=0)
    return float(middle[0]), float(middle[1]), float(middle[2])

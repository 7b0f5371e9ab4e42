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


def ardupilot_positions(
    places: NDArray[np.float64], origin: tuple[float, float, float]
) -> NDArray[np.float64]:
    """Return local NED positions (n, 3) [m], by ArduPilot's sphere, of places (n, 3) [deg, deg, m].

    Law: inverse of ``ardupilot_origin``: the origin of these positions and places is ``origin``.
    """
    latitude, longitude, altitude = places.T
    north = (latitude - origin[0]) * _DEGREE_M
    east = (longitude - origin[1]) * _DEGREE_M * np.cos(np.radians(0.5 * (latitude + origin[0])))
    return np.stack([north, east, origin[2] - altitude], axis=1)


def describe_origin(
    name: str, point: tuple[float, float, float], scales: tuple[float, float] = (1.0, 1.0)
) -> dict[str, str]:
    """Return an origin as metadata: latitude, longitude [deg], altitude [m], factors north and east."""
    values = dict(zip(("latitude_deg", "longitude_deg", "altitude_m"), point, strict=True))
    values |= {"north_scale": scales[0], "east_scale": scales[1]}
    return {f"{name}_{key}": repr(float(value)) for key, value in values.items()}

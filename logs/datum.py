"""Where local positions in a log are measured from, and in what metres.

Autopilots convert between degrees and local metres on a sphere, not on the WGS-84 ellipsoid: ArduPilot's has
a radius of 6 378 100 m (``Location.cpp``: 0.011131884502145034 m per 1e-7 deg of latitude), PX4's one of
6 371 000 m (``geo.h``). A filter that works on the ellipsoid sees the same fixes up to half a percent nearer
together or farther apart, so each origin comes with the two factors that turn the log's metres north and east
into metres on the ellipsoid at that place.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from estimation.frames import WGS84_A_M, WGS84_E2

_DEGREE_M = 111_318.84502145034
"""Length of one degree of latitude on ArduPilot's sphere [m] ."""


ARDUPILOT_RADIUS_M = math.degrees(_DEGREE_M)
PX4_RADIUS_M = 6_371_000.0


def sphere_scales(latitude_deg: float, radius_m: float) -> tuple[float, float]:
    """Return the factors north and east from local metres on a sphere to metres on the ellipsoid."""
    latitude = math.radians(latitude_deg)
    w2 = 1.0 - WGS84_E2 * math.sin(latitude) ** 2
    meridian = WGS84_A_M * (1.0 - WGS84_E2) / w2**1.5
    normal = WGS84_A_M / math.sqrt(w2)
    return meridian / radius_m, normal / radius_m


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
    name: str, point: tuple[float, float, float], radius_m: float = ARDUPILOT_RADIUS_M
) -> dict[str, str]:
    """Return an origin as metadata: latitude, longitude [deg], altitude [m], factors north and east."""
    scales = sphere_scales(point[0], radius_m)
    values = dict(zip(("latitude_deg", "longitude_deg", "altitude_m"), point, strict=True))
    values |= {"north_scale": scales[0], "east_scale": scales[1]}
    return {f"{name}_{key}": repr(float(value)) for key, value in values.items()}

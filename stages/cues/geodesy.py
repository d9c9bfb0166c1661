"""Level displacements between nearby WGS84 positions.

    east = (N + h) cos(latitude) d_longitude,   north = (M + h) d_latitude

M and N are the ellipsoid's radii of curvature along the meridian and the prime vertical, at the mean latitude. Over
1 km the error is below 1 mm (the next term is cubic in the angle).

Source: NGA.STND.0036, WGS 84 (semi-axis, flattening); Snyder, Map Projections - A Working Manual, USGS 1395, p. 24-25.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64

SEMI_MAJOR_M = 6_378_137.0
FLATTENING = 1 / 298.257223563
ECCENTRICITY2 = FLATTENING * (2 - FLATTENING)


class Geographic(NamedTuple):
    """A position on the WGS84 ellipsoid."""

    latitude_rad: float
    longitude_rad: float
    altitude_m: float


def radii_m(latitude_rad: float) -> tuple[float, float]:
    """Radii of curvature [m] along the meridian (M) and the prime vertical (N)."""
    w2 = 1 - ECCENTRICITY2 * math.sin(latitude_rad) ** 2
    return SEMI_MAJOR_M * (1 - ECCENTRICITY2) / w2**1.5, SEMI_MAJOR_M / math.sqrt(w2)


def displacement_enu_m(origin: Geographic, to: Geographic) -> Array64:
    """East, north, up (3,) [m] from one position to another one nearby."""
    M, N = radii_m((origin.latitude_rad + to.latitude_rad) / 2)
    h = (origin.altitude_m + to.altitude_m) / 2
    d_longitude = math.remainder(to.longitude_rad - origin.longitude_rad, math.tau)
    east = (N + h) * math.cos((origin.latitude_rad + to.latitude_rad) / 2) * d_longitude
    return np.array([east, (M + h) * (to.latitude_rad - origin.latitude_rad), to.altitude_m - origin.altitude_m])


def moved(origin: Geographic, enu_m: Array64) -> Geographic:
    """The position some metres (3,) east, north, up of another one: the inverse of `displacement_enu_m`, to 1 mm."""
    h, mean_rad = origin.altitude_m + float(enu_m[2]) / 2, origin.latitude_rad
    for _ in range(3):
        mean_rad = origin.latitude_rad + float(enu_m[1]) / (radii_m(mean_rad)[0] + h) / 2
    latitude_rad, N = 2 * mean_rad - origin.latitude_rad, radii_m(mean_rad)[1]
    longitude_rad = origin.longitude_rad + float(enu_m[0]) / ((N + h) * math.cos(mean_rad))
    return Geographic(latitude_rad, longitude_rad, origin.altitude_m + float(enu_m[2]))

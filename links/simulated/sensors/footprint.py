"""The spot that a pulse lights, as sub-rays: where they leave the sensor, which way, and their shares of its power.

Source: VLP-16 user manual 63-9243 (elevations, vertical offsets); footprint 3.0 x 1.5 mrad: VLS-128 user manual
63-9483, table F-1, the same family's optics. The patterns are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.world.mesh import Array32, Array64
from links.velodyne import vlp16
from stages.compiled import compiled

ELEVATION_RAD = np.radians(np.array(vlp16.ELEVATION_DEG, dtype=np.float64))
VERTICAL_OFFSET_M = 1e-3 * np.array(vlp16.VERTICAL_OFFSET_MM)
FOOTPRINT_RAD = (3.0e-3, 1.5e-3)  # full width along the scan, across it
APERTURE_M = (12.7e-3, 9.5e-3)  # the beam where it leaves the sensor


@dataclass(frozen=True, eq=False)
class Pattern:
    """Sub-rays of one pulse: (k, 2) in halves of the footprint, along and across the scan, and their shares (k,)."""

    offsets: Array64
    shares: Array64


COARSE = Pattern(
    np.array([(0.0, 0.0), (-0.6, -0.6), (-0.6, 0.6), (0.6, -0.6), (0.6, 0.6)]),
    np.array([1 / 3, 1 / 6, 1 / 6, 1 / 6, 1 / 6]),
)
FINE = Pattern(
    np.array([(u, v) for u in np.linspace(-6 / 7, 6 / 7, 7) for v in np.linspace(-0.8, 0.8, 5)]), np.full(35, 1 / 35)
)
DIAGONAL = Pattern(np.array([(0.0, 0.0), (-0.6, -0.6), (0.6, 0.6)]), np.array([1 / 3, 1 / 3, 1 / 3]))
MEDIUM = Pattern(
    np.array([(u, v) for u in np.linspace(-0.8, 0.8, 5) for v in (-2 / 3, 0.0, 2 / 3)]), np.full(15, 1 / 15)
)

FOOTPRINTS = {"dense": (COARSE, FINE), "sparse": (DIAGONAL, MEDIUM)}
"""By `LidarSettings.footprint`: the pattern of every pulse, and that of one at an edge; near a drone or bird: FINE."""

COARSE_SPREAD_M = 0.3  # a pulse whose coarse sub-rays differ by more sees an edge and is cast again, finely


@compiled
def sees_edge(ranges_m: Array32, spread_m: float) -> NDArray[np.bool_]:
    """Pulses (n,) whose sub-rays (n, k) differ by more than the spread, or of which only some meet anything."""
    found = np.zeros(len(ranges_m), dtype=np.bool_)
    for i in range(len(ranges_m)):
        lowest = highest = ranges_m[i, 0]
        for r in ranges_m[i]:
            lowest, highest = min(lowest, r), max(highest, r)
        found[i] = np.isfinite(lowest) and highest > lowest + np.float32(spread_m)
    return found


@compiled
def sub_rays(
    azimuth_rad: Array64,
    laser: NDArray[np.intp],
    R_world_lidar: Array64,
    t_world_lidar_m: Array64,
    offsets: Array64,
) -> tuple[Array32, Array32]:
    """Origins and unit directions (n, k, 3) in the world of the sub-rays of pulses (n,).

    Axis in the lidar frame: (cos w sin a, cos w cos a, sin w), from (0, 0, vertical offset of the laser).
    """
    count, rays = len(azimuth_rad), len(offsets)
    origins = np.empty((count, rays, 3), dtype=np.float32)
    directions = np.empty((count, rays, 3), dtype=np.float32)
    ray, start = np.empty(3), np.empty(3)
    for i in range(count):
        ca, sa = np.cos(azimuth_rad[i]), np.sin(azimuth_rad[i])
        cw, sw = np.cos(ELEVATION_RAD[laser[i]]), np.sin(ELEVATION_RAD[laser[i]])
        R = R_world_lidar[i]
        for k in range(rays):
            u, v = offsets[k]
            turn, lift = u * FOOTPRINT_RAD[0] / 2, v * FOOTPRINT_RAD[1] / 2
            across, up = u * APERTURE_M[0] / 2, v * APERTURE_M[1] / 2
            # axis + turn * e_across + lift * e_up, with e_across = (ca, -sa, 0) and e_up = (-sw sa, -sw ca, cw)
            ray[0] = cw * sa + turn * ca - lift * sw * sa
            ray[1] = cw * ca - turn * sa - lift * sw * ca
            ray[2] = sw + lift * cw
            ray /= np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
            start[0] = across * ca - up * sw * sa
            start[1] = -across * sa - up * sw * ca
            start[2] = VERTICAL_OFFSET_M[laser[i]] + up * cw
            for j in range(3):
                directions[i, k, j] = R[j, 0] * ray[0] + R[j, 1] * ray[1] + R[j, 2] * ray[2]
                origins[i, k, j] = t_world_lidar_m[i, j] + R[j, 0] * start[0] + R[j, 1] * start[1] + R[j, 2] * start[2]
    return origins, directions

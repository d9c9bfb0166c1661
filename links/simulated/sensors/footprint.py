"""The spot that a pulse lights, as sub-rays: where they leave the sensor, which way, and their shares of its power.

Source: VLP-16 user manual 63-9243 (elevations, vertical offsets); footprint 3.0 x 1.5 mrad: VLS-128 user manual
63-9483, table F-1, the same family's optics. The patterns are ours.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from links.simulated.kernels import lidar as kernels
from links.simulated.kernels.ray_casting import Array32
from links.velodyne import vlp16
from stages.geometry import Array64

ELEVATION_RAD = np.radians(np.array(vlp16.ELEVATION_DEG, dtype=np.float64))
VERTICAL_OFFSET_M = 1e-3 * np.array(vlp16.VERTICAL_OFFSET_MM)


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


def sub_rays(
    azimuth_rad: Array64,
    laser: NDArray[np.intp],
    R_world_lidar: Array64,
    t_world_lidar_m: Array64,
    offsets: Array64,
) -> tuple[Array32, Array32]:
    """Origins and unit directions (n, k, 3) in the world of the sub-rays of pulses (n,)."""
    elevation_rad, offset_m = ELEVATION_RAD[laser], VERTICAL_OFFSET_M[laser]
    return kernels.sub_rays(azimuth_rad, elevation_rad, offset_m, R_world_lidar, t_world_lidar_m, offsets)

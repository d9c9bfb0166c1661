"""Compiled functions that draw points into a depth image.

Source: see `stages/sweep/depth_image.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.kernels.compiled import compiled


@compiled
def keep_nearest(
    xyz_vehicle_m: NDArray[np.float32], origin_m: NDArray[np.float64], focal_px: float, depth_m: NDArray[np.float32]
) -> int:
    """Draw points (n, 3) into depth_m (N, N) in place; keeping the nearest depth. Returns the number inside the image.

    column u = floor(focal x / z + N / 2), row v = floor(focal y / z + N / 2), with (x, y, z) = point - origin, z > 0.
    """
    height, width = depth_m.shape
    inside = 0
    for i in range(xyz_vehicle_m.shape[0]):
        z = xyz_vehicle_m[i, 2] - origin_m[2]
        if z <= 0.0:
            continue
        u = math.floor(focal_px * (xyz_vehicle_m[i, 0] - origin_m[0]) / z + 0.5 * width)
        v = math.floor(focal_px * (xyz_vehicle_m[i, 1] - origin_m[1]) / z + 0.5 * height)
        if 0 <= u < width and 0 <= v < height:
            inside += 1
            if depth_m[v, u] == 0.0 or z < depth_m[v, u]:
                depth_m[v, u] = z
    return inside

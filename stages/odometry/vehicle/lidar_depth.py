"""Depths of image features from LiDAR points near their rays.

Points within `reach` of a ray r, with u, v = p . e1, p . e2 over p . r, lie on one plane when 1 / (p . r) is linear in
(u, v); its value on the ray is the feature's inverse depth q. Only sums are stored, so that
each slice of points is processed once and improves the rays it covers.

Source: P V.B (scale from projected LiDAR points); ours: the plane in inverse depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.odometry.lidar_depth import add, solve
from stages.odometry.visual.two_view import across

SUMS = 10  # 1, u, v, uu, uv, vv, q, qu, qv, qq


@dataclass(frozen=True, slots=True)
class Depths:
    """Inverse depths (n,) [1/m] and their sigma; NaN where no LiDAR point constrains them."""

    inverse_m: Array64
    sigma: Array64


class RayDepths:
    """Accumulated sums for the rays (n, 3) of one image."""

    def __init__(self, ray: Array64, reach_rad: float) -> None:
        self._ray, self._reach = np.ascontiguousarray(ray), reach_rad
        self._frames = np.stack([across(r) for r in ray]) if len(ray) else np.zeros((0, 3, 2))
        self._sums = np.zeros((len(ray), SUMS))

    def add(self, xyz_camera_m: Array64) -> None:
        """Add points (m, 3) in the camera frame of the rays' image."""
        if len(xyz_camera_m):
            add(self._ray, self._frames, self._sums, xyz_camera_m, self._reach)

    def depths(self) -> Depths:
        """Inverse depths from the points added so far."""
        return Depths(*solve(self._sums, self._reach))

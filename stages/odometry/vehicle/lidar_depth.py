"""How far away the features of a picture are, from LiDAR points around their rays.

Points within `reach` of a ray r, with u, v = p . e1, p . e2 over p . r, lie on one plane when 1 / (p . r) is linear in
(u, v); its value on the ray is the feature's inverse depth q. Sums are kept, not points, so that a slice costs what it
holds and a ray gets better with each one.

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
    """Inverse depths (n,) [1/m] and their sigma; NaN where the LiDAR says nothing."""

    inverse_m: Array64
    sigma: Array64


class RayDepths:
    """Sums for the rays (n, 3) of one picture."""

    def __init__(self, ray: Array64, reach_rad: float) -> None:
        self._ray, self._reach = np.ascontiguousarray(ray), reach_rad
        self._frames = np.stack([across(r) for r in ray]) if len(ray) else np.zeros((0, 3, 2))
        self._sums = np.zeros((len(ray), SUMS))

    def add(self, xyz_camera_m: Array64) -> None:
        """Points (m, 3) in the camera frame of the rays' picture."""
        if len(xyz_camera_m):
            add(self._ray, self._frames, self._sums, xyz_camera_m, self._reach)

    def depths(self) -> Depths:
        """What is known so far."""
        return Depths(*solve(self._sums, self._reach))

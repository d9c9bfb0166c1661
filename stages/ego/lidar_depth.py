"""How far away the features of a picture are, from LiDAR points around their rays.

Points within `reach` of a ray r, with u, v = p . e1, p . e2 over p . r, lie on one plane when 1 / (p . r) is linear in
(u, v); its value on the ray is the feature's inverse depth q. Sums are kept, not points, so that a slice costs what it
holds and a ray gets better with each one.

Source: P V.B (scale from projected LiDAR points); ours: the plane in inverse depth.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.compiled import compiled
from stages.geometry import Array64
from stages.pictures.two_view import across

LEAST_POINTS = 5
LEAST_SPREAD = 0.15  # of the reach, one sigma of u and of v: points on one ring say nothing across it
ROUGHNESS = 0.06  # of the inverse depth, one sigma: rougher is no plane (a corner, leaves)
RANGE_M = 0.03  # one sigma of the LiDAR
NEAREST_M = 0.8
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
            _add(self._ray, self._frames, self._sums, xyz_camera_m, self._reach)

    def depths(self) -> Depths:
        """What is known so far."""
        return Depths(*_solve(self._sums, self._reach))


@compiled
def _add(ray: Array64, frames: Array64, sums: Array64, points: Array64, reach: float) -> None:
    least = math.cos(math.atan(reach * math.sqrt(2.0)))
    for i in range(len(points)):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        length = math.sqrt(x * x + y * y + z * z)
        if not length > NEAREST_M:
            continue
        for k in range(len(ray)):
            along = x * ray[k, 0] + y * ray[k, 1] + z * ray[k, 2]
            if along < least * length:
                continue
            u = (x * frames[k, 0, 0] + y * frames[k, 1, 0] + z * frames[k, 2, 0]) / along
            v = (x * frames[k, 0, 1] + y * frames[k, 1, 1] + z * frames[k, 2, 1]) / along
            if abs(u) > reach or abs(v) > reach:
                continue
            q = 1.0 / along
            s = sums[k]
            s[0] += 1.0
            s[1] += u
            s[2] += v
            s[3] += u * u
            s[4] += u * v
            s[5] += v * v
            s[6] += q
            s[7] += q * u
            s[8] += q * v
            s[9] += q * q


@compiled
def _solve(sums: Array64, reach: float) -> tuple[Array64, Array64]:
    n = len(sums)
    inverse, sigma = np.full(n, np.nan), np.full(n, np.nan)
    for k in range(n):
        s = sums[k]
        if s[0] < LEAST_POINTS:
            continue
        mu, mv, mq = s[1] / s[0], s[2] / s[0], s[6] / s[0]
        uu, uv, vv = s[3] / s[0] - mu * mu, s[4] / s[0] - mu * mv, s[5] / s[0] - mv * mv
        det = uu * vv - uv * uv
        wide = (LEAST_SPREAD * reach) ** 2
        if uu + vv < 2.0 * wide or det < wide * wide:
            continue
        qu, qv, qq = s[7] / s[0] - mq * mu, s[8] / s[0] - mq * mv, s[9] / s[0] - mq * mq
        a, b = (vv * qu - uv * qv) / det, (uu * qv - uv * qu) / det
        rough = math.sqrt(max(qq - a * qu - b * qv, 0.0))
        q = mq - a * mu - b * mv
        if q <= 0.0 or rough > ROUGHNESS * mq:
            continue
        extrapolated = (vv * mu * mu - 2.0 * uv * mu * mv + uu * mv * mv) / det
        noise = max(rough, RANGE_M * q * q)
        inverse[k] = q
        sigma[k] = math.sqrt(
            noise * noise * (1.0 + extrapolated) / s[0] + (0.3 * rough) ** 2 + (0.2 * RANGE_M * q * q) ** 2
        )
    return inverse, sigma

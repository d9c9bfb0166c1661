"""Compiled functions that fit inverse depths of rays to LiDAR points.

Source: see `stages/odometry/vehicle/lidar_depth.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

LEAST_POINTS = 5
LEAST_SPREAD = 0.15  # of the reach: least sigma of u and v; points on one ring do not constrain the plane across it
ROUGHNESS = 0.06  # of the inverse depth, one sigma: a larger one is no plane (corners, leaves)
RANGE_M = 0.03  # one sigma of the LiDAR
NEAREST_M = 0.8


@compiled
def add(ray: Array64, frames: Array64, sums: Array64, points: Array64, reach: float) -> None:
    """Add points (m, 3) to the sums (n, SUMS) of the rays (n, 3) within `reach` [rad]; frames (n, 3, 2): their axes."""
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
def solve(sums: Array64, reach: float) -> tuple[Array64, Array64]:
    """Inverse depths (n,) [1/m] and their sigma from the sums (n, SUMS); NaN where no plane fits."""
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

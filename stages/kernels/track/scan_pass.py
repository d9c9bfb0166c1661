"""Compiled functions that predict a track's Kalman filter and relate it to the slices of a scan pass.

Source: see `stages/track/scan_pass.py` and `stages/track/kalman.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

SCAN_COS = math.cos(math.radians(24.0))  # a slice covers 15 deg to each side of its middle and 5 deg along the scan


@compiled
def largest_sigma_m(P: Array64) -> float:
    """Largest sigma of the position in a covariance (6, 6)."""
    return math.sqrt(np.linalg.eigvalsh(np.ascontiguousarray(P[:3, :3]))[-1])


@compiled
def misfit(xyz_m: Array64, x: Array64, P: Array64) -> float:
    """Squared Mahalanobis distance of a position (3,), with a sigma of 0.3 m, from that of a state."""
    away = xyz_m - x[:3]
    return float(away @ np.linalg.solve(P[:3, :3] + 0.3**2 * np.eye(3), away))


@compiled
def line_of_sight(R: Array64, t: Array64, origin_m: Array64, x: Array64, axis: Array64) -> tuple[Array64, float, bool]:
    """(vector to a state's position (3,) [m], its length, whether the slice covers it), in the vehicle frame.

    R, t are T_map_vehicle at the slice; origin (3,) and axis (3,) are the origin and mean direction of its beams.
    """
    away = R.T @ (x[:3] - t) - origin_m
    range_m = math.sqrt(away @ away)
    return away, range_m, range_m >= 0.5 and bool(away @ axis >= range_m * math.sqrt(axis @ axis) * SCAN_COS)


@compiled
def forward_kernel(x: Array64, P: Array64, dt_s: float, q_p: float, q_pv: float, q_v: float) -> tuple[Array64, Array64]:
    """State (6,) and covariance (6, 6) after dt_s of constant velocity; q_*: process noise per axis."""
    F = np.eye(6)
    F[0, 3] = F[1, 4] = F[2, 5] = dt_s
    forward = F @ P @ F.T
    for axis in range(3):
        forward[axis, axis] += q_p
        forward[axis, axis + 3] += q_pv
        forward[axis + 3, axis] += q_pv
        forward[axis + 3, axis + 3] += q_v
    return F @ x, forward

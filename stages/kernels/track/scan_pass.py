"""Compiled functions that predict a track's Kalman filter and relate it to the slices of a scan pass.

Source: see `stages/track/scan_pass.py` and `stages/track/kalman.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


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
def line_of_sight(
    R_first: Array64,
    t_first: Array64,
    R_last: Array64,
    t_last: Array64,
    origin_m: Array64,
    x: Array64,
    after_s: float,
    span_s: float,
    axis: Array64,
    half_rad: float,
    reach_m: float,
) -> tuple[Array64, Array64, Array64, bool]:
    """(vector (3,) [m] to a state's position, extrapolated to the state's time, its velocity (3,) [m/s] within a slice,
    R_map_vehicle (3, 3) of the slice's middle, whether pulses may pass within reach_m of it), in the vehicle frame.

    R, t are T_map_vehicle at the slice's first pulse, after_s after the state x (6,), and at its last, span_s later;
    origin (3,) is that of the beams; axis (3,) and half_rad are the cone around them.
    """
    first = R_first.T @ (x[:3] + after_s * x[3:] - t_first) - origin_m
    last = R_last.T @ (x[:3] + (after_s + span_s) * x[3:] - t_last) - origin_m
    velocity = (last - first) / span_s if span_s > 0.0 else np.zeros(3)
    middle = 0.5 * (first + last)
    range_m = math.sqrt(middle @ middle)
    around_rad = half_rad + math.atan(reach_m / max(range_m, 0.5))
    here = range_m >= 0.5 and bool(middle @ axis >= range_m * math.cos(min(around_rad, math.pi)))
    return first - after_s * velocity, velocity, 0.5 * (R_first + R_last), here


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

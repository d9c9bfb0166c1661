"""Moments of weighted hypotheses: one state with the mean and covariance of all.

Errors (15): theta, position, velocity, accelerometer bias, gyroscope bias, about the most probable hypothesis:

    e_k = x_k - x_base,   m = sum_k w_k e_k,   P = sum_k w_k (P_k + (e_k - m) (e_k - m)^T),   x = x_base + m

The rotation's tangent is then transported by m_theta: G = I - [m_theta]x / 2, P <- G P G^T.

Source: Bar-Shalom, Li, Kirubarajan (2001), 1.4.16; Sola, Deray, Atchuthan, A micro Lie theory (2018), right Jacobian.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled_at_once
from stages.kernels.geometry.so3 import exp_rotation, hat, log_rotation
from stages.kernels.heading.prediction import MATRICES, VECTORS

TYPES = f"({MATRICES}, {VECTORS}, {VECTORS}, {VECTORS}, {MATRICES}, float64[::1])"


@compiled_at_once(TYPES)
def moments(
    R: Array64, xyz_m: Array64, velocity_mps: Array64, bias: Array64, covariance: Array64, weight: Array64
) -> tuple[Array64, Array64, Array64, Array64, Array64]:
    """R (3, 3), position, velocity (3,), bias (6,) and covariance (15, 15) of n hypotheses with weight (n,), sum 1.

    R (n, 3, 3), vectors (n, 3), bias (n, 6), covariance (n, 15, 15).
    """
    n, base = weight.size, np.argmax(weight)
    R_base = R[base].copy()
    off, mean, P = np.empty((n, 15)), np.zeros(15), np.zeros((15, 15))
    for k in range(n):
        off[k, :3] = log_rotation(R_base.T @ R[k].copy())
        off[k, 3:6] = xyz_m[k] - xyz_m[base]
        off[k, 6:9] = velocity_mps[k] - velocity_mps[base]
        off[k, 9:] = bias[k] - bias[base]
        mean += weight[k] * off[k]
    for k in range(n):
        spread = off[k] - mean
        for i in range(15):
            for j in range(15):
                P[i, j] += weight[k] * (covariance[k, i, j] + spread[i] * spread[j])
    G = np.eye(15)
    G[:3, :3] -= 0.5 * hat(mean[:3])
    R_mean = R_base @ exp_rotation(mean[:3])
    return R_mean, xyz_m[base] + mean[3:6], velocity_mps[base] + mean[6:9], bias[base] + mean[9:], G @ P @ G.T

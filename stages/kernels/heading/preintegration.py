"""Preintegration of IMU intervals: one relative motion with its noise and its derivatives by the biases.

From the drone's axes at the first moment, with a = f - b_a and w = omega - b_g of each interval of length h:

    dp <- dp + dv h + dR E(w h / 2) a h^2 / 2
    dv <- dv + dR E(w h / 2) a h                 E = exp of a rotation vector: `a` is the mean over the interval
    dR <- dR E(w h)

The noise is white with a density for each axis of each sensor. Errors are (theta, v, p): dR exp(theta), dv + v, dp + p.

Source: Forster, Carlone, Dellaert, Scaramuzza, On-manifold preintegration (T-RO 2017), eq. 33 to 45.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled_at_once
from stages.kernels.geometry.so3 import exp_rotation, hat


@compiled_at_once("(float64[::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1], float64[:, ::1])")
def preintegrate(
    step_s: Array64, force_mps2: Array64, rate_radps: Array64, force_noise: Array64, rate_noise: Array64, bias: Array64
) -> tuple[Array64, Array64, Array64, Array64, Array64]:
    """dR (3, 3), dv (3,), dp (3,), their derivatives (9, 6) by (b_a, b_g), and their covariance (9, 9).

    step_s (n,), force, rate and their noise densities (n, 3) in drone axes; bias (2, 3): accelerometer, gyroscope.
    """
    dR, dv, dp = np.eye(3), np.zeros(3), np.zeros(3)
    J, C = np.zeros((9, 6)), np.zeros((9, 9))
    A, B = np.eye(9), np.zeros((9, 6))
    for i in range(step_s.size):
        h = step_s[i]
        a, w = force_mps2[i] - bias[0], rate_radps[i] - bias[1]
        half = exp_rotation(0.5 * h * w)
        middle = dR @ half
        turned = middle @ a
        A[:3, :3] = exp_rotation(-h * w)
        by_middle = -(middle @ hat(a)) * h
        B[:3, 3:] = -h * np.eye(3) + 0.5 * h * h * hat(w)
        by_turn, by_rate = by_middle @ half.T, -0.5 * h * by_middle
        A[3:6, :3], A[6:, :3] = by_turn, 0.5 * h * by_turn
        B[3:6, 3:], B[6:, 3:] = by_rate, 0.5 * h * by_rate
        for k in range(3):
            A[6 + k, 3 + k] = h
        B[3:6, :3], B[6:, :3] = -h * middle, -0.5 * h * h * middle
        J[:] = A @ J + B
        C[:] = A @ C @ A.T
        scaled = middle * force_noise[i]
        S = scaled @ scaled.T
        for k in range(3):
            C[k, k] += rate_noise[i, k] ** 2 * h
        C[3:6, 3:6] += S * h
        C[6:, 6:] += S * (h**3 / 3.0)
        C[3:6, 6:] += S * (0.5 * h * h)
        C[6:, 3:6] += S * (0.5 * h * h)
        dp = dp + h * dv + 0.5 * h * h * turned
        dv = dv + h * turned
        dR = dR @ exp_rotation(h * w)
    return dR, dv, dp, J, C

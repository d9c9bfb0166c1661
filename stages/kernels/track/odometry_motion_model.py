"""Compiled functions that propagate a track by the drone's odometry at unknown yaw.

Source: see `stages/track/odometry_motion_model.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled, compiled_at_once
from stages.kernels.geometry.smooth_motion import log_p, model_of

YAWS = 120
DRIFT_MPS = 0.15  # velocity drift of both odometries
FREE_MPS, FREE_MPS2 = 6.0, 3.0  # speed and acceleration of another object, one sigma


@compiled
def add_odometry_motion(
    x: Array64,
    P: Array64,
    dt_s: float,
    then_m: Array64,
    then_mps: Array64,
    now_m: Array64,
    now_mps: Array64,
    confidence: float,
    m_1: complex,
    m_2: complex,
) -> None:
    """Add to state (6,) and covariance (6, 6) the odometry's motion (3,) beyond constant velocity, at unknown yaw."""
    steps = np.empty(2, dtype=np.complex128)  # horizontal: of position and velocity
    for k in range(2):
        step = (now_m - then_m - dt_s * then_mps) if k == 0 else (now_mps - then_mps)
        x[3 * k + 2] += confidence * step[2]
        steps[k] = complex(step[0], step[1])
        moved = steps[k] * m_1
        x[3 * k] += moved.real
        x[3 * k + 1] += moved.imag
    for i in range(2):
        for j in range(2):
            K = steps[i] * steps[j].conjugate() * (confidence - abs(m_1) ** 2)
            pseudo = steps[i] * steps[j] * (m_2 - m_1 * m_1)
            P[3 * i, 3 * j] += 0.5 * (K + pseudo).real  # x of position and velocity
            P[3 * i + 1, 3 * j + 1] += 0.5 * (K - pseudo).real  # y of both
            across = 0.5 * (pseudo - K).imag  # E Re z Im z'
            P[3 * i, 3 * j + 1] += across
            P[3 * j + 1, 3 * i] += across


@compiled_at_once("(float64[::1], float64[:, ::1], float64[:, ::1], float64)")
def weigh_yaws(t_s: Array64, x_m: Array64, odometry_m: Array64, sigma_m: float) -> tuple[Array64, float]:
    """ln p (YAWS,) of a path x (n, 3) given the odometry (n, 3) at each yaw, and given any other object."""
    x, d = x_m.copy(), odometry_m.copy()
    for axis in range(3):
        x[:, axis] -= x[:, axis].mean()
        d[:, axis] -= d[:, axis].mean()
    drone, free = model_of(t_s, sigma_m, DRIFT_MPS, 0.0), model_of(t_s, sigma_m, FREE_MPS, FREE_MPS2)
    upright = log_p(drone, t_s, x[:, 2] - d[:, 2])
    turned = np.empty(YAWS)
    for k in range(YAWS):
        c, s = math.cos(math.tau * k / YAWS), math.sin(math.tau * k / YAWS)
        turned[k] = upright + log_p(drone, t_s, x[:, 0] - c * d[:, 0] + s * d[:, 1])
        turned[k] += log_p(drone, t_s, x[:, 1] - s * d[:, 0] - c * d[:, 1])
    other = 0.0
    for axis in range(3):
        other += log_p(free, t_s, x[:, axis].copy())
    return turned, other

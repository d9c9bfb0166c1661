"""Compiled functions that compute the paper's mean shift, Equation (6).

Source: see `stages/track/mean_shift.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


@compiled
def within(points_m: NDArray[np.float32], t_0: NDArray[np.float64], radius_m: float) -> NDArray[np.int64]:
    """F: indices of the points (n, 3) within radius_m of t_0 (3,)."""
    index = np.empty(points_m.shape[0], dtype=np.int64)
    n = 0
    for i in range(points_m.shape[0]):
        dx, dy, dz = points_m[i, 0] - t_0[0], points_m[i, 1] - t_0[1], points_m[i, 2] - t_0[2]
        if dx * dx + dy * dy + dz * dz <= radius_m * radius_m:
            index[n] = i
            n += 1
    return index[:n]


@compiled
def mean_shift(
    points_m: NDArray[np.float64], t_0: NDArray[np.float64], max_iterations: int, tolerance_m: float
) -> tuple[Array64, Array64, int, float]:
    """Equation (6) over points (n, 3), n > 0, from t_0 (3,), until a step is shorter than tolerance_m.

    Returns (t (3,) [m], the weights C (n,) of the last step, iterations, last step [m]).
    """
    n = points_m.shape[0]
    weights = np.empty(n)
    t = t_0.copy()
    shift_m = math.inf
    iterations = 0
    while iterations < max_iterations and shift_m >= tolerance_m:
        sum_w = sum_x = sum_y = sum_z = 0.0
        for i in range(n):
            dx, dy, dz = points_m[i, 0] - t[0], points_m[i, 1] - t[1], points_m[i, 2] - t[2]
            w = math.exp(-(dx * dx + dy * dy + dz * dz))
            weights[i] = w
            sum_w += w
            sum_x += w * dx
            sum_y += w * dy
            sum_z += w * dz
        step_x, step_y, step_z = sum_x / sum_w, sum_y / sum_w, sum_z / sum_w
        t[0] += step_x
        t[1] += step_y
        t[2] += step_z
        shift_m = math.sqrt(step_x * step_x + step_y * step_y + step_z * step_z)
        iterations += 1
    return t, weights, iterations, shift_m

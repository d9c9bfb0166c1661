"""Compiled function that separates white noise from a smooth local curve.

Source: see `stages/odometry/drone/imu_noise.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

PARAMETERS = 3  # of a parabola


@compiled
def residual_variance(stamp_ns: NDArray[np.int64], values: Array64) -> Array64:
    """Variance (m,) of white noise in values (n, m): residuals of a parabola in time, n > 3.

    The powers of time are made orthonormal by modified Gram-Schmidt.
    """
    n, m = values.shape
    basis, span_ns = np.empty((PARAMETERS, n)), max(float(stamp_ns[n - 1] - stamp_ns[0]), 1.0)
    for i in range(n):
        t = (stamp_ns[i] - stamp_ns[0]) / span_ns - 0.5
        basis[0, i], basis[1, i], basis[2, i] = 1.0, t, t * t
    for k in range(PARAMETERS):
        for j in range(k):
            basis[k] -= np.sum(basis[k] * basis[j]) * basis[j]
        basis[k] /= max(math.sqrt(np.sum(basis[k] * basis[k])), 1e-12)
    variance = np.empty(m)
    for column in range(m):
        residual = values[:, column].copy()
        for k in range(PARAMETERS):
            residual -= np.sum(residual * basis[k]) * basis[k]
        variance[column] = np.sum(residual * residual) / (n - PARAMETERS)
    return variance

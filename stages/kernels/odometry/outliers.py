"""Compiled test of an IMU sample against the median of the last ones.

Source: see `stages/odometry/drone/imu_outliers.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled_at_once


@compiled_at_once("(float64[:, :, ::1], float64[:, ::1], int64, boolean, float64, float64[::1])")
def is_outlier(
    samples: Array64, distances: Array64, row: int, noise_known: bool, factor: float, change: Array64
) -> bool:
    """Whether a vector of the last of samples (n, k, 3), oldest first, is an outlier; never before the noise is known.

    Fills a row of distances (m, k) with those of the last sample's vectors from the medians. An outlier is farther than
    factor times the median of distances plus change (k,).
    """
    found = False
    for k in range(samples.shape[1]):
        square = 0.0
        for axis in range(3):
            square += (samples[-1, k, axis] - np.median(samples[:, k, axis])) ** 2
        distances[row, k] = math.sqrt(square)
    if noise_known:
        for k in range(samples.shape[1]):
            found |= distances[row, k] > factor * np.median(distances[:, k]) + change[k]
    return found

"""Compiled functions that average the directions of pulses.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

# Bounds of a run of returns of one laser, as shares of a drone's span: a longer run is of a larger object; a larger
# step in range, or a wider hole, ends the run.
LONGEST, STEP, HOLE = 1.6, 0.7, 0.6


@compiled
def mean_direction(direction: NDArray[np.float32]) -> Array64:
    """The mean (3,) of directions (n, 3), n > 0, summed in single precision as numpy's mean does."""
    x = y = z = np.float32(0.0)
    for i in range(direction.shape[0]):
        x += direction[i, 0]
        y += direction[i, 1]
        z += direction[i, 2]
    n = np.float32(direction.shape[0])
    return np.array([x / n, y / n, z / n], dtype=np.float64)


@compiled
def mean_unit_direction(direction: NDArray[np.float32]) -> Array64:
    """`mean_direction` as a unit vector (3,); zero for a zero mean."""
    mean = mean_direction(direction)
    return mean / max(math.sqrt(mean[0] ** 2 + mean[1] ** 2 + mean[2] ** 2), 1e-9)

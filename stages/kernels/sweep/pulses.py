"""Compiled function for the directions of pulses, and bounds of the runs of returns.

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
def cone_of(direction: NDArray[np.float32]) -> tuple[Array64, float]:
    """The cone around directions (n, 3), n > 0: their mean as a unit vector (3,), and the largest angle to it [rad].

    For a zero mean the axis is zero, and the cone includes all directions.
    """
    x = y = z = 0.0
    for i in range(direction.shape[0]):
        x += direction[i, 0]
        y += direction[i, 1]
        z += direction[i, 2]
    length = max(math.sqrt(x * x + y * y + z * z), 1e-9 * direction.shape[0])
    x, y, z = x / length, y / length, z / length
    widest = 1.0
    for i in range(direction.shape[0]):
        widest = min(widest, direction[i, 0] * x + direction[i, 1] * y + direction[i, 2] * z)
    axis = np.array([x, y, z])
    return axis, math.pi if x == y == z == 0.0 else math.acos(max(widest, -1.0))

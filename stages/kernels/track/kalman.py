"""Compiled functions that predict a constant-velocity Kalman filter.

Source: see `stages/track/kalman.py`.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


@compiled
def forward_kernel(x: Array64, P: Array64, dt_s: float, q_p: float, q_pv: float, q_v: float) -> tuple[Array64, Array64]:
    F = np.eye(6)
    F[0, 3] = F[1, 4] = F[2, 5] = dt_s
    forward = F @ P @ F.T
    for axis in range(3):
        forward[axis, axis] += q_p
        forward[axis, axis + 3] += q_pv
        forward[axis + 3, axis] += q_pv
        forward[axis + 3, axis + 3] += q_v
    return F @ x, forward

"""Compiled functions that derive the side of the gear play from the servo's motion.

Source: see `stages/calibration/scan_passes.py`.
"""

from __future__ import annotations

import math

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled_at_once

SETTLED_RAD = math.radians(0.5)  # a turn-back is over after that: how play gives way is not modelled so finely


@compiled_at_once("(float64[::1], float64, float64[::1])")
def hangs(position_rad: Array64, play_rad: float, hang: Array64) -> None:
    """Fill hang (m,): +1 where the turntable hangs behind a servo that went up, -1 behind one that went down.

    NaN in between: after a turn-back, until the servo has gone the play and SETTLED_RAD further.
    """
    half = max(play_rad, 0.0) / 2
    lag = beyond = 0.0
    hang[0] = math.nan
    for k in range(1, position_rad.size):
        step = position_rad[k] - position_rad[k - 1]
        pushed = lag + step
        lag = min(max(pushed, -half), half)
        if step * beyond < 0.0:
            beyond = 0.0
        beyond += pushed - lag
        hang[k] = math.nan if abs(beyond) < SETTLED_RAD else math.copysign(1.0, beyond)

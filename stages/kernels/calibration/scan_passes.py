"""Compiled functions that derive the side of the gear play from the servo's motion.

Source: see `stages/calibration/scan_passes.py`.
"""

from __future__ import annotations

import math

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled_at_once

SETTLED_RAD = math.radians(0.5)  # travel beyond the play after which a reversal is complete


@compiled_at_once("(float64[::1], float64, float64[::1])")
def play_sides(position_rad: Array64, play_rad: float, play_side: Array64) -> None:
    """Fill play_side (m,): +1 where the turntable lags a servo that moved up, -1 one that moved down.

    NaN after a reversal, until the servo has crossed the play and SETTLED_RAD more.
    """
    half = max(play_rad, 0.0) / 2
    lag = beyond = 0.0
    play_side[0] = math.nan
    for k in range(1, position_rad.size):
        step = position_rad[k] - position_rad[k - 1]
        pushed = lag + step
        lag = min(max(pushed, -half), half)
        if step * beyond < 0.0:
            beyond = 0.0
        beyond += pushed - lag
        play_side[k] = math.nan if abs(beyond) < SETTLED_RAD else math.copysign(1.0, beyond)

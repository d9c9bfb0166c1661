"""Compiled functions that compute from sector counts whether an object is next to a candidate.

Source: see `stages/detect/candidate.py`.
"""

from __future__ import annotations

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.isolation import FARTHER_0, FREE_0, OCCUPIED_0, SECTORS

# A sector that is free in this many scan passes has no support: a return farther out is another object.
OPEN_PASSES = 3
SIGMA_M = 0.15  # of an observation
ACCELERATION_MPS2 = 4.0


@compiled
def neighbour_score(counts: Array64, free: Array64) -> tuple[float, bool]:
    """(score in [0, 1] that an object is next to it, whether half of the sectors are free) by one scan pass (TALLY,).

    Adds the sectors that are free in this scan pass to free (SECTORS,).
    """
    seen, occupied, farther, behind = 0, False, False, False
    for k in range(SECTORS):
        free[k] += counts[FREE_0 + k] >= 2
        seen += counts[FREE_0 + k] >= 1
        occupied |= counts[OCCUPIED_0 + k] >= 1
        if counts[FARTHER_0 + k] >= 1 and free[k] < OPEN_PASSES:
            farther = True
            behind |= counts[FREE_0 + k] < 1
    score = 1.0 if occupied else (0.5 if behind else (0.15 if farther else 0.0))
    return score, seen >= SECTORS // 2

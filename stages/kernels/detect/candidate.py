"""Compiled functions that rate from one tally whether another object is next to a candidate.

Source: see `stages/detect/candidate.py`.
"""

from __future__ import annotations

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.isolation import FARTHER_0, FREE_0, OCCUPIED_0, SECTORS

OPEN_LOOKS = 3  # a sector free in this many scan passes has no support: a return behind it is another object
SIGMA_M = 0.15  # of a sighting
ACCELERATION_MPS2 = 4.0


@compiled
def neighbour_score(around: Array64, free: Array64) -> tuple[float, bool]:
    """Neighbour score by the tally (TALLY,) of one scan pass, and whether half of the sectors were observed.

    Adds the sectors that are free in this pass to free (SECTORS,).
    """
    seen, taken, farther, behind = 0, False, False, False
    for k in range(SECTORS):
        free[k] += around[FREE_0 + k] >= 2
        seen += around[FREE_0 + k] >= 1
        taken |= around[OCCUPIED_0 + k] >= 1
        if around[FARTHER_0 + k] >= 1 and free[k] < OPEN_LOOKS:
            farther = True
            behind |= around[FREE_0 + k] < 1
    score = 1.0 if taken else (0.5 if behind else (0.15 if farther else 0.0))
    return score, seen >= SECTORS // 2

"""Compiled functions of one scan pass: whether an object is next to a candidate, and the number of returns.

Source: see `stages/detect/candidate.py`.
"""

from __future__ import annotations

import math

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.isolation import FARTHER_0, FREE_0, OCCUPIED_0, SECTORS

# A sector that is free in this many scan passes has no support: a return farther out is another object.
OPEN_PASSES = 3
SIGMA_M = 0.15  # of an observation
ACCELERATION_MPS2 = 4.0
SINGLE_RETURN_PER_M = 0.0165  # share of a drone's scan passes with a single return (few at close range), over range
WIRE_SINGLE_RETURN = 0.75  # the same share for a wire
FEW_RETURNS_M = 24.0  # over range: at most this many returns are few; a sixth of those of a beam across a 0.5 m drone
SOME_RETURNS_M = 36.0  # over range: counts up to this one are ambiguous, a wire gives them, too


@compiled
def return_count_nats(returns: float, range_m: float) -> float:
    """Log ratio of the number of returns of one scan pass, drone over wire [nats]."""
    few = returns <= max(1.0, FEW_RETURNS_M / range_m)
    if not few and returns <= SOME_RETURNS_M / range_m:
        return 0.0
    alone = min(max(SINGLE_RETURN_PER_M * range_m, 0.1), 0.7)
    return math.log(alone / WIRE_SINGLE_RETURN) if few else math.log((1 - alone) / (1 - WIRE_SINGLE_RETURN))


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

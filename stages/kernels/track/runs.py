"""Compiled removal of returns that belong to a wall: longer runs of returns than the drone is wide.

Consecutive pulses of one laser differ by 0.2 deg. Consecutive returns at nearly the same range are one run. The
runs of a drone are short, even in front of a wall, because the range steps at its edge. A run with something nearer at
both ends is a glimpse through a gap, between leaves for example: its true extent is not known.

Source: ours, for P III.C; runs end as the detector's chords do (`stages/detect/chords.py`).
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.sweep.pulses import HOLE, LONGEST, STEP
from stages.kernels.track.hull import DEPTH, GAP_RETURN, KIND, LASER, OCCLUDED, RETURN, A, B

LASERS = 256


@compiled
def mask_walls(pulses: Array64, span_m: float) -> None:
    """Mark returns of long runs among a scan pass's pulses (n, COLUMNS), in order of time, as OCCLUDED: no information.

    Returns of a short run that is hidden at both ends become GAP_RETURN.
    """
    first, last, newest = np.full(LASERS, -1), np.full(LASERS, -1), np.full(LASERS, -1)
    run = np.full(pulses.shape[0], -1)  # first row of each row's run
    long = np.zeros(pulses.shape[0], dtype=np.bool_)  # per first row, as are these: whether the neighbour is nearer
    hidden_before, hidden_after = np.zeros_like(long), np.zeros_like(long)
    for i in range(pulses.shape[0]):
        k = int(pulses[i, LASER])
        before, newest[k], j = newest[k], i, last[k]
        goes_on = (
            j >= 0
            and abs(pulses[i, DEPTH] - pulses[j, DEPTH]) <= STEP * span_m
            and math.hypot(pulses[i, A] - pulses[j, A], pulses[i, B] - pulses[j, B]) <= HOLE * span_m
        )
        if j >= 0 and before == j:
            hidden_after[first[k]] = not goes_on and pulses[i, KIND] == OCCLUDED
        if not math.isfinite(pulses[i, DEPTH]):
            continue
        if not goes_on:
            first[k] = i
            hidden_before[i] = before >= 0 and pulses[before, KIND] == OCCLUDED
        last[k], run[i], j = i, first[k], first[k]
        hidden_after[j] = False
        long[j] |= math.hypot(pulses[i, A] - pulses[j, A], pulses[i, B] - pulses[j, B]) > LONGEST * span_m
    for i in range(pulses.shape[0]):
        if pulses[i, KIND] == RETURN:
            j = run[i]
            if long[j]:
                pulses[i, KIND] = OCCLUDED
            elif hidden_before[j] and hidden_after[j]:
                pulses[i, KIND] = GAP_RETURN

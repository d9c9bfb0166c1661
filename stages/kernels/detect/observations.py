"""Compiled functions that classify chords and summarise those of one object.

Source: see `stages/detect/observations.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect import chords as chord
from stages.kernels.sweep.pulses import LONGEST

NONE, BIG, SMALL, HIDDEN = range(4)  # kinds of chords
BALL_BULGE_PER_M = (1.2, 9.0)  # 1 / (2 radius), with what a beam's width adds
BALL_ROUGH_M = 0.02


@compiled
def kinds_of(
    rows: Array64,
    origin_z_m: float,
    span_m: float,
    lowest_rad: float,
    nearest_m: float,
    furthest_m: float,
    clear_m: float,
    kinds: NDArray[np.int64],
) -> tuple[int, int, int]:
    """Kinds of chords (n, COLUMNS): BIG, SMALL and free at both ends, HIDDEN: small, not free, or NONE of these.

    Fills kinds (n,); returns how many are BIG, SMALL, HIDDEN.
    """
    kinds[:] = NONE
    for i in range(rows.shape[0]):
        range_m = rows[i, chord.RANGE]
        if rows[i, chord.LONG] > 0.0:
            kinds[i] = BIG
        elif (
            rows[i, chord.Z] - origin_z_m > math.sin(lowest_rad) * range_m
            and nearest_m <= range_m <= furthest_m
            and rows[i, chord.LENGTH] <= LONGEST * span_m
        ):
            kinds[i] = SMALL if rows[i, chord.FREE] == 2.0 else HIDDEN
    return np.sum(kinds == BIG), np.sum(kinds == SMALL), np.sum(kinds == HIDDEN)


@compiled
def positions_of_kind(rows: Array64, kinds: NDArray[np.int64], kind: int, n: int, R: Array64, t: Array64) -> Array64:
    """Positions (n, 3) of the n chords of a kind, transformed by R (3, 3) and t (3,)."""
    places_m = np.empty((n, 3))
    k = 0
    for i in range(rows.shape[0]):
        if kinds[i] == kind:
            x, y, z = rows[i, chord.X], rows[i, chord.Y], rows[i, chord.Z]
            for j in range(3):
                places_m[k, j] = x * R[j, 0] + y * R[j, 1] + z * R[j, 2] + t[j]
            k += 1
    return places_m


@compiled
def summarise_object(rows: Array64, R: Array64, t: Array64) -> tuple[Array64, Array64, int, float, float]:
    """Of the chords (n, COLUMNS) of one object: middle (3,), and by R (3, 3) and t (3,), hits, range, extent [m]."""
    hits, places = np.ascontiguousarray(rows[:, chord.COUNT]), np.ascontiguousarray(rows[:, :3])
    middle = hits @ places / hits.sum()
    across2 = 0.0
    for axis in range(3):
        across2 += (places[:, axis].max() - places[:, axis].min()) ** 2
    extent_m = max(math.sqrt(across2), rows[:, chord.LENGTH].max())
    return middle, R @ middle + t, int(hits.sum()), rows[:, chord.RANGE].mean(), extent_m


@compiled
def count_ball_chords(rows: Array64) -> tuple[int, int]:
    """Number of chords (n, COLUMNS) with at least five returns that are round and smooth, and of the others."""
    low, high = BALL_BULGE_PER_M
    balls = rugged = 0
    for i in range(rows.shape[0]):
        if rows[i, chord.COUNT] < 5:
            continue
        if (
            low < rows[i, chord.BULGE] < high
            and rows[i, chord.ROUGH] < BALL_ROUGH_M
            and rows[i, chord.GAPS] <= 1
            and rows[i, chord.DEPTH] > 0.2 * rows[i, chord.LENGTH]
        ):
            balls += 1
        else:
            rugged += 1
    return balls, rugged

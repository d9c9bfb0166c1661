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
from stages.kernels.detect.isolation import TALLY, nearest_marked
from stages.kernels.detect.pulse_buffer import count_sectors_all
from stages.kernels.sweep.pulses import LONGEST

NONE, BIG, SMALL, HIDDEN = range(4)  # kinds of chords
BALL_BULGE_PER_M = (1.2, 9.0)  # 1 / (2 radius), with what a beam's width adds
BALL_ROUGH_M = 0.02
X, Y, Z, RANGE, LARGE_OBJECT, RETURNS, TOO_LONG, ROUND, ROUGH, TALLY_0 = range(10)  # columns of an observation
COLUMNS = TALLY_0 + TALLY


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
    """Classify chords (n, COLUMNS): BIG, SMALL (free at both ends), HIDDEN (small, not free at both ends), or NONE.

    Fills kinds (n,); returns the numbers of BIG, SMALL and HIDDEN.
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
    positions_m = np.empty((n, 3))
    k = 0
    for i in range(rows.shape[0]):
        if kinds[i] == kind:
            x, y, z = rows[i, chord.X], rows[i, chord.Y], rows[i, chord.Z]
            for j in range(3):
                positions_m[k, j] = x * R[j, 0] + y * R[j, 1] + z * R[j, 2] + t[j]
            k += 1
    return positions_m


@compiled
def merge_chords(rows: Array64, R: Array64, t: Array64) -> tuple[Array64, Array64, int, float, float]:
    """(middle (3,), that transformed by R, t, returns, range [m], extent [m]) of chords (n, COLUMNS) of one object."""
    hits, centres = np.ascontiguousarray(rows[:, chord.COUNT]), np.ascontiguousarray(rows[:, :3])
    middle = hits @ centres / hits.sum()
    across2 = 0.0
    for axis in range(3):
        across2 += (centres[:, axis].max() - centres[:, axis].min()) ** 2
    extent_m = max(math.sqrt(across2), rows[:, chord.LENGTH].max())
    return middle, R @ middle + t, int(hits.sum()), rows[:, chord.RANGE].mean(), extent_m


@compiled
def round_and_rough(rows: Array64) -> tuple[int, int]:
    """Numbers of chords (n, COLUMNS) with five or more returns that are smooth and round as a ball, and not."""
    low, high = BALL_BULGE_PER_M
    balls = rough = 0
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
            rough += 1
    return balls, rough


@compiled
def group_chords(rows: Array64, reach_m: float, groups: NDArray[np.int64]) -> int:
    """Number of objects; fills groups (n,) with the object of each chord (n, COLUMNS).

    An object's chords are those within reach_m of its first one.
    """
    groups[:] = -1
    count = 0
    for i in range(rows.shape[0]):
        if groups[i] >= 0:
            continue
        for j in range(i, rows.shape[0]):
            x, y, z = (
                rows[j, chord.X] - rows[i, chord.X],
                rows[j, chord.Y] - rows[i, chord.Y],
                rows[j, chord.Z] - rows[i, chord.Z],
            )
            if groups[j] < 0 and math.sqrt(x * x + y * y + z * z) <= reach_m:
                groups[j] = count
        count += 1
    return count


@compiled
def observe(
    rows: Array64,
    groups: NDArray[np.int64],
    R: Array64,
    t: Array64,
    since_ns: NDArray[np.int64],
    span_m: float,
    clear_m: float,
    beam_spacing_rad: float,
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    origin_m: Array64,
    fan: Array64,
    sizes: NDArray[np.int64],
    cell_m: float,
    key: NDArray[np.int64],
    when: NDArray[np.int64],
) -> Array64:
    """The observations (k, COLUMNS) of k objects with chords (n, chord.COLUMNS) in groups (n,), see `group_chords`.

    R (k, 3, 3), t (k, 3): T_map_vehicle of each; since_ns (k,): large objects marked earlier do not count. The recent
    slices are those of `count_sectors_all`, cells, keys and times those of `nearest_marked`.
    """
    found = np.empty((since_ns.size, COLUMNS))
    for k in range(since_ns.size):
        members = rows[groups == k]
        middle, xyz_map_m, returns, away_m, extent_m = merge_chords(members, R[k], t[k])
        found[k, X], found[k, Y], found[k, Z] = xyz_map_m[0], xyz_map_m[1], xyz_map_m[2]
        found[k, RANGE], found[k, RETURNS], found[k, TOO_LONG] = away_m, returns, extent_m > 1.3 * span_m
        found[k, ROUND], found[k, ROUGH] = round_and_rough(members)
        close_m = max(2.4 * span_m, 1.15 * beam_spacing_rad * away_m)  # at least two beam spacings wide
        outer_m = max(clear_m, 1.5 * beam_spacing_rad * away_m)
        found[k, TALLY_0:] = count_sectors_all(
            direction, range_m, origin_m, fan, sizes, middle, 0.3 * span_m, 1.1 * span_m, close_m, outer_m, 0.5
        )
        found[k, LARGE_OBJECT] = nearest_marked(xyz_map_m, cell_m, 1.1 * span_m, clear_m, since_ns[k], key, when)
    return found

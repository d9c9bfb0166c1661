"""Compiled functions that associate observations and slices of pulses with candidates.

Source: see `stages/detect/candidate_table.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.candidate import ACCELERATION_MPS2, SIGMA_M
from stages.kernels.detect.isolation import INNER_HITS, INNER_PASSES, TALLY, count_sectors

FURTHEST_STEP_M = 2.5  # largest distance of an observation from the prediction
MAX_COST = 9.0  # of an observation: squared sigmas
RECENT_NS = 1_500_000_000  # pass-throughs are not counted for candidates observed longer ago
FAN_MARGIN_RAD = 0.02  # beyond a slice's directions
CHUNK = 192  # pulses of a slice for which a candidate is taken as static: 0.6 ms of a VLP-16
X, Y, Z, VX, VY, VZ, P_X, P_XV, P_V = range(9)  # [m], [m/s] in frame map, and their variances
STAMP, SEEN = 0, 1  # [ns]
NO_PULSE, NEAR, OUTSIDE = 0, 1, 2  # status of a candidate: no pulse near its middle; pulses near it; outside the fan


class TableArrays(NamedTuple):
    """The detector's candidates."""

    state: Array64  # (most, columns)
    ns: NDArray[np.int64]  # (most, 2)
    reacquired: NDArray[np.bool_]  # (most,)
    rows: int  # only the first rows are used
    promising_ns: int  # no promising candidate was observed later


@compiled
def first_within(positions_m: Array64, xyz_m: Array64, reach_m: float) -> int:
    """Index of the first of positions (n, 3) within reach_m of xyz_m (3,); -1: none."""
    for k in range(positions_m.shape[0]):
        x, y, z = positions_m[k, 0] - xyz_m[0], positions_m[k, 1] - xyz_m[1], positions_m[k, 2] - xyz_m[2]
        if math.sqrt(x * x + y * y + z * z) < reach_m:
            return k
    return -1


@compiled
def predicted(state: Array64, dt_s: float) -> tuple[float, float, float, float]:
    """Predicted position x, y, z [m] and its variance [m^2] of a row of the table after dt_s."""
    variance = state[P_X] + 2 * dt_s * state[P_XV] + dt_s * dt_s * state[P_V]
    variance += (ACCELERATION_MPS2 * dt_s * dt_s) ** 2 / 4
    return state[X] + dt_s * state[VX], state[Y] + dt_s * state[VY], state[Z] + dt_s * state[VZ], variance


@compiled
def nearest_rows(
    state: Array64, ns: NDArray[np.int64], reacquired: NDArray[np.bool_], rows: int, stamp_ns: int, xyz_m: Array64
) -> tuple[int, int]:
    """Rows of the candidates whose predictions are nearest to an observation, in sigmas; -1: none.

    One of the reacquired candidates and one of the others; only the first `rows` rows count.
    """
    best_reacquired, least_reacquired, best, least = -1, MAX_COST, -1, MAX_COST
    for row in range(rows):
        if stamp_ns < ns[row, STAMP]:
            continue
        x, y, z, variance = predicted(state[row], (stamp_ns - ns[row, STAMP]) * 1e-9)
        away2 = (xyz_m[0] - x) ** 2 + (xyz_m[1] - y) ** 2 + (xyz_m[2] - z) ** 2
        cost = away2 / (variance + SIGMA_M**2)
        if away2 >= FURTHEST_STEP_M**2:
            continue
        if reacquired[row] and cost < least_reacquired:
            best_reacquired, least_reacquired = row, cost
        elif not reacquired[row] and cost < least:
            best, least = row, cost
    return best_reacquired, best


@compiled
def _in_vehicle(R: Array64, t: Array64, x: float, y: float, z: float, xyz_m: Array64) -> None:
    """Fill xyz (3,) in frame vehicle with a position in frame map; R, t are T_map_vehicle."""
    x, y, z = x - t[0], y - t[1], z - t[2]
    for k in range(3):
        xyz_m[k] = R[0, k] * x + R[1, k] * y + R[2, k] * z


@compiled
def count_pulses(
    state: Array64,
    ns: NDArray[np.int64],
    promising: NDArray[np.bool_],
    rows: int,
    R_first: Array64,
    t_first: Array64,
    R_last: Array64,
    t_last: Array64,
    axis: Array64,
    half_rad: float,
    origin_m: Array64,
    stamp_ns: NDArray[np.int64],
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    disc_m: float,
    most_variance: float,
    found: NDArray[np.int64],
) -> int:
    """Fill found (rows, 3) with status, returns and pass-throughs of a slice's pulses at each candidate's middle.

    Returns the number of rows that are not NO_PULSE. R, t are T_map_vehicle at the slice's first and last pulse; axis
    (3,) and half_rad are the cone around its directions; stamp (k,), direction (k, 3) and range (k,) its pulses.
    """
    tally, first, last = np.zeros(TALLY, dtype=np.int64), np.empty(3), np.empty(3)
    n, count = range_m.size, 0
    start_ns, end_ns = stamp_ns[0], stamp_ns[n - 1]
    fan_cos = math.cos(min(half_rad + FAN_MARGIN_RAD, math.pi))
    for row in range(rows):
        found[row] = 0
        if not promising[row] or end_ns - ns[row, SEEN] > RECENT_NS:
            continue
        x, y, z, variance = predicted(state[row], (start_ns - ns[row, STAMP]) * 1e-9)
        _in_vehicle(R_first, t_first, x, y, z, first)
        x, y, z, variance = predicted(state[row], (end_ns - ns[row, STAMP]) * 1e-9)
        _in_vehicle(R_last, t_last, x, y, z, last)
        if variance > most_variance:
            continue
        away = 0.5 * (first + last) - origin_m
        length = math.sqrt(away @ away)
        if length > 0.5 and away @ axis > length * fan_cos:
            tally[INNER_HITS] = tally[INNER_PASSES] = 0
            for k in range(0, n, CHUNK):
                end = min(k + CHUNK, n)
                share = (stamp_ns[(k + end) // 2] - start_ns) / max(end_ns - start_ns, 1)
                centre = first + share * (last - first)
                count_sectors(
                    direction[k:end], range_m[k:end], origin_m, centre, disc_m, math.inf, math.inf, disc_m, 1.0, tally
                )
            found[row, 1], found[row, 2] = tally[INNER_HITS], tally[INNER_PASSES]
            found[row, 0] = NEAR if tally[INNER_HITS] + tally[INNER_PASSES] > 0 else NO_PULSE
        else:
            found[row, 0] = OUTSIDE
        count += found[row, 0] != NO_PULSE
    return count

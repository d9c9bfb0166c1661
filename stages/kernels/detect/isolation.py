"""Compiled functions that tally the pulses around a position and map remembered returns.

Source: see `stages/detect/isolation.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

SECTORS = 8
INNER_HITS, INNER_PASSES, NEARER, FREE_0 = 0, 1, 2, 3  # FREE_0.. 8 free, then 8 occupied
OCCUPIED_0 = FREE_0 + SECTORS
FARTHER_0 = OCCUPIED_0 + SECTORS  # 8 with a return, but not close
TALLY = FARTHER_0 + SECTORS
BITS = 16  # log2 of the map's table size
MAP_SIZE = 1 << BITS


class MarkedCells(NamedTuple):
    """A map of cells that were marked, as a hash table."""

    cell_m: float
    key: NDArray[np.int64]
    when: NDArray[np.int64]  # [ns]


@compiled
def count_sectors(
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    origin_m: Array64,
    centre_m: Array64,
    disc_m: float,
    inner_m: float,
    close_m: float,
    outer_m: float,
    depth_m: float,
    tally: NDArray[np.int64],
) -> None:
    """Add the pulses (n, 3), (n,) around centre_m (3,) to the tally (TALLY,)."""
    x, y, z = centre_m[0] - origin_m[0], centre_m[1] - origin_m[1], centre_m[2] - origin_m[2]
    R = math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / R, y / R, z / R
    level = math.hypot(ux, uy)
    if level < 1e-6:
        ax, ay = 1.0, 0.0
    else:
        ax, ay = -uy / level, ux / level  # a: horizontal, orthogonal to the line of sight; b = u x a
    bx, by, bz = -uz * ay, uz * ax, ux * ay - uy * ax
    least = math.cos(min(outer_m / R * 1.05, 1.5))
    for i in range(range_m.size):
        dx, dy, dz = direction[i, 0], direction[i, 1], direction[i, 2]
        along = dx * ux + dy * uy + dz * uz
        if along < least:
            continue
        a = R * (dx * ax + dy * ay) / along
        b = R * (dx * bx + dy * by + dz * bz) / along
        away = math.sqrt(a * a + b * b)
        if away > outer_m:
            continue
        r = range_m[i]
        deep = depth_m + 1.2 * away  # a wire may run towards the sensor
        if r > 0.0 and r < R - deep:
            tally[NEARER] += 1
            continue
        hit = r > 0.0 and r < R + deep
        if away <= disc_m:
            if hit:
                tally[INNER_HITS] += 1
            else:
                tally[INNER_PASSES] += 1
        elif away >= inner_m and (hit or away <= close_m):
            sector = _sector(a, b)
            if hit and away <= close_m:
                tally[OCCUPIED_0 + sector] += 1
            elif hit:
                tally[FARTHER_0 + sector] += 1
            else:
                tally[FREE_0 + sector] += 1


@compiled
def _sector(a: float, b: float) -> int:
    """Index of the sector, one of SECTORS of 45 deg, that holds the direction (a, b); counter-clockwise from -a."""
    if b < 0.0:
        if a < 0.0:
            return 0 if b > a else 1
        return 2 if -b > a else 3
    if a > 0.0:
        return 4 if b < a else 5
    return 6 if b > -a else 7


@compiled
def _cell(x: int, y: int, z: int) -> int:
    return ((x * 73856093) ^ (y * 19349663) ^ (z * 83492791)) & (MAP_SIZE - 1)


@compiled
def mark_cells(
    points_m: Array64, cell_m: float, stamp_ns: int, key: NDArray[np.int64], when: NDArray[np.int64]
) -> None:
    """Mark the cells of points (n, 3); a hash collision overwrites the older cell."""
    for i in range(points_m.shape[0]):
        x, y, z = (
            math.floor(points_m[i, 0] / cell_m),
            math.floor(points_m[i, 1] / cell_m),
            math.floor(points_m[i, 2] / cell_m),
        )
        cell = _cell(x, y, z)
        key[cell] = (x + 4096) | ((y + 4096) << 16) | ((z + 4096) << 32)
        when[cell] = stamp_ns


@compiled
def nearest_marked(
    centre_m: Array64,
    cell_m: float,
    least_m: float,
    most_m: float,
    since_ns: int,
    key: NDArray[np.int64],
    when: NDArray[np.int64],
) -> float:
    """Distance [m] to the nearest marked cell's centre between least_m and most_m of centre_m (3,); inf without one."""
    reach = math.ceil(most_m / cell_m)
    x0, y0, z0 = (
        math.floor(centre_m[0] / cell_m),
        math.floor(centre_m[1] / cell_m),
        math.floor(centre_m[2] / cell_m),
    )
    best = math.inf
    for x in range(x0 - reach, x0 + reach + 1):
        for y in range(y0 - reach, y0 + reach + 1):
            for z in range(z0 - reach, z0 + reach + 1):
                cell = _cell(x, y, z)
                if when[cell] < since_ns or key[cell] != (x + 4096) | ((y + 4096) << 16) | ((z + 4096) << 32):
                    continue
                away = math.sqrt(
                    ((x + 0.5) * cell_m - centre_m[0]) ** 2
                    + ((y + 0.5) * cell_m - centre_m[1]) ** 2
                    + ((z + 0.5) * cell_m - centre_m[2]) ** 2
                )
                if least_m <= away <= most_m:
                    best = min(best, away)
    return best

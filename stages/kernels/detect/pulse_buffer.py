"""Compiled functions that buffer recent pulses and search them around a position.

Source: see `stages/detect/isolation.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.detect.isolation import TALLY, count_sectors

WINDOW_NS = 8_600_000  # before the newest slice: 31 deg of a rotor at 600 rpm
ROUNDED_RAD = 1e-3  # bound of the rounding of directions


@compiled
def keep_slice(
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    origin_m: Array64,
    axis: Array64,
    half_rad: float,
    start_ns: int,
    end_ns: int,
    k: int,
    directions: NDArray[np.float32],
    ranges_m: NDArray[np.float32],
    origins_m: Array64,
    fans: Array64,
    sizes: NDArray[np.int64],
    ends_ns: NDArray[np.int64],
) -> None:
    """Write a slice and its cone (axis, half_rad) into row k of the buffer; slices before the window get size 0."""
    directions[k, : range_m.size] = direction
    ranges_m[k, : range_m.size] = range_m
    origins_m[k], fans[k, :3], fans[k, 3] = origin_m, axis, half_rad
    sizes[k], ends_ns[k] = range_m.size, end_ns
    for row in range(sizes.size):
        if start_ns - ends_ns[row] > WINDOW_NS:
            sizes[row] = 0


@compiled
def is_outside(fan: Array64, origin_m: Array64, centre_m: Array64, outer_m: float) -> bool:
    """Whether no pulse of a slice comes within `outer_m` of a position (3,), as in `count_sectors`."""
    x, y, z = centre_m[0] - origin_m[0], centre_m[1] - origin_m[1], centre_m[2] - origin_m[2]
    away_m = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    angle_rad = math.acos(min(max((x * fan[0] + y * fan[1] + z * fan[2]) / away_m, -1.0), 1.0))
    return angle_rad > fan[3] + min(outer_m / away_m * 1.05, 1.5) + ROUNDED_RAD


@compiled
def count_sectors_all(
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    origin_m: Array64,
    fan: Array64,
    sizes: NDArray[np.int64],
    centre_m: Array64,
    disc_m: float,
    inner_m: float,
    close_m: float,
    outer_m: float,
    depth_m: float,
) -> Array64:
    """The tally (TALLY,) of slices (k, most, 3), (k, most), of each the first `sizes` (k,) pulses."""
    tally = np.zeros(TALLY, dtype=np.int64)
    for k in range(sizes.size):
        n = sizes[k]
        if n == 0 or is_outside(fan[k], origin_m[k], centre_m, outer_m):
            continue
        count_sectors(
            direction[k, :n], range_m[k, :n], origin_m[k], centre_m, disc_m, inner_m, close_m, outer_m, depth_m, tally
        )
    return tally.astype(np.float64)

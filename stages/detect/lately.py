"""The last slices, kept to be asked what they found around a place.

Source: ours; DESIGN, The graph: detect.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.compiled import compiled
from stages.detect.surroundings import TALLY, look_around
from stages.geometry import Array64
from stages.messages import SweptPulses

WINDOW_NS = 8_600_000  # what is kept: 31 deg of a rotor at 600 rpm and the slice that is begun
MOST_SLICES = 16  # of them
ROUNDED_RAD = 1e-3  # more than directions are rounded by


class Lately:
    """The last slices' pulses side by side, so that one compiled call looks at all of them."""

    def __init__(self) -> None:
        self._direction = np.empty((MOST_SLICES, 0, 3), dtype=np.float32)
        self._range_m = np.empty((MOST_SLICES, 0), dtype=np.float32)
        self._origin_m = np.zeros((MOST_SLICES, 3))
        self._sizes = np.zeros(MOST_SLICES, dtype=np.int64)  # 0: none, or too old
        self._end_ns = np.zeros(MOST_SLICES, dtype=np.int64)
        self._fan = np.zeros((MOST_SLICES, 4))  # mean direction, and how far any pulse is beside it [rad]
        self._next = 0

    def add(self, pulses: SweptPulses, axis: Array64, end_ns: int) -> None:
        """One more, its mean direction (3,), and when its last pulse left; those before the window are forgotten."""
        n, k = pulses.range_m.size, self._next
        missing = n - self._range_m.shape[1]
        if missing > 0:
            self._direction = np.pad(self._direction, ((0, 0), (0, missing), (0, 0)))
            self._range_m = np.pad(self._range_m, ((0, 0), (0, missing)))
        keep_slice(
            pulses.direction_vehicle, pulses.range_m, np.array(pulses.origin_vehicle_m), axis, end_ns, k,
            self._direction, self._range_m, self._origin_m, self._fan, self._sizes, self._end_ns,
        )  # fmt: skip
        self._next = (k + 1) % MOST_SLICES

    def around(
        self, centre_m: Array64, disc_m: float, inner_m: float, close_m: float, outer_m: float, depth_m: float
    ) -> Array64:
        """What they found around a place (3,) of the vehicle frame: (TALLY,); see `look_around`."""
        return look_around_all(
            self._direction, self._range_m, self._origin_m, self._fan, self._sizes,
            centre_m, disc_m, inner_m, close_m, outer_m, depth_m,
        )  # fmt: skip


@compiled
def keep_slice(
    direction: NDArray[np.float32],
    range_m: NDArray[np.float32],
    origin_m: Array64,
    axis: Array64,
    end_ns: int,
    k: int,
    directions: NDArray[np.float32],
    ranges_m: NDArray[np.float32],
    origins_m: Array64,
    fans: Array64,
    sizes: NDArray[np.int64],
    ends_ns: NDArray[np.int64],
) -> None:
    """Write a slice into row k of what is kept, its `fan` with it; those before the window get the size 0."""
    widest = 1.0
    for i in range(range_m.size):
        along = 0.0
        for j in range(3):
            directions[k, i, j] = direction[i, j]
            along += direction[i, j] * axis[j]
        ranges_m[k, i] = range_m[i]
        widest = min(widest, along)
    origins_m[k], fans[k, :3], fans[k, 3] = origin_m, axis, math.acos(max(widest, -1.0))
    sizes[k], ends_ns[k] = range_m.size, end_ns
    for row in range(sizes.size):
        if end_ns - ends_ns[row] > WINDOW_NS:
            sizes[row] = 0


@compiled
def passes_by(fan: Array64, origin_m: Array64, centre_m: Array64, outer_m: float) -> bool:
    """Whether no pulse of a slice comes within `outer_m` of a place (3,), as `look_around` takes it."""
    x, y, z = centre_m[0] - origin_m[0], centre_m[1] - origin_m[1], centre_m[2] - origin_m[2]
    away_m = max(math.sqrt(x * x + y * y + z * z), 1e-9)
    beside = math.acos(min(max((x * fan[0] + y * fan[1] + z * fan[2]) / away_m, -1.0), 1.0))
    return beside > fan[3] + min(outer_m / away_m * 1.05, 1.5) + ROUNDED_RAD


@compiled
def look_around_all(
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
        if n == 0 or passes_by(fan[k], origin_m[k], centre_m, outer_m):
            continue
        look_around(
            direction[k, :n], range_m[k, :n], origin_m[k], centre_m, disc_m, inner_m, close_m, outer_m, depth_m, tally
        )
    return tally.astype(np.float64)

"""Isolation: which sectors around a position are free or occupied, and where large objects are.

Around a position at range R, in the plane across the line of sight:

    inner disc     the object itself: returns, and pulses that passed
    ring           8 sectors between `inner` and `close`: free when a pulse went on farther than R there, occupied when
                   one returned near R, within `depth` and a slope
    farther        up to `outer`: objects there count where no free space is measured in between

A drone hovers freely: pulses pass it on every side. An object on a pole or wire, at a tree or at the end of a wall has
a neighbour. A sector that no pulse crossed gives no information.

Source: ours; DESIGN, "a small cluster with *measured* emptiness around it".
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.detect.isolation import MAP_SIZE, MarkedCells, mark_cells, nearest_marked
from stages.kernels.detect.pulse_buffer import keep_slice
from stages.messages import SweptPulses

MAX_SLICES = 16


class RecentPulses:
    """Pulses of the most recent slices in arrays, so that one compiled call processes all of them."""

    def __init__(self) -> None:
        self._direction = np.empty((MAX_SLICES, 0, 3), dtype=np.float32)
        self._range_m = np.empty((MAX_SLICES, 0), dtype=np.float32)
        self._origin_m = np.zeros((MAX_SLICES, 3))
        self._sizes = np.zeros(MAX_SLICES, dtype=np.int64)  # 0: none, or too old
        self._end_ns = np.zeros(MAX_SLICES, dtype=np.int64)
        self._fan = np.zeros((MAX_SLICES, 4))  # mean direction, and the largest angle of a pulse from it [rad]
        self._next = 0

    def add(self, pulses: SweptPulses, axis: Array64, half_rad: float, end_ns: int) -> None:
        """Add a slice with the cone around its directions and its last pulse's time; remove those before the window."""
        n, k = pulses.range_m.size, self._next
        missing = n - self._range_m.shape[1]
        if missing > 0:
            self._direction = np.pad(self._direction, ((0, 0), (0, missing), (0, 0)))
            self._range_m = np.pad(self._range_m, ((0, 0), (0, missing)))
        keep_slice(
            pulses.direction_vehicle, pulses.range_m, np.array(pulses.origin_vehicle_m), axis, half_rad,
            pulses.stamp_ns, end_ns, k, self._direction, self._range_m, self._origin_m, self._fan, self._sizes,
            self._end_ns,
        )  # fmt: skip
        self._next = (k + 1) % MAX_SLICES

    @property
    def arrays(self) -> tuple[NDArray[np.float32], NDArray[np.float32], Array64, Array64, NDArray[np.int64]]:
        """Directions, ranges, origins, cones and sizes of the slices, as `count_sectors_all` takes them."""
        return self._direction, self._range_m, self._origin_m, self._fan, self._sizes


class LargeObjectMap:
    """Map of walls, ground, trunks and crowns: cells with a chord longer than any drone."""

    def __init__(self, cell_m: float = 0.5) -> None:
        self._cell_m = cell_m
        self._key = np.zeros(MAP_SIZE, dtype=np.int64)
        self._when = np.zeros(MAP_SIZE, dtype=np.int64)

    @property
    def arrays(self) -> MarkedCells:
        """The cells, as compiled functions take them."""
        return MarkedCells(self._cell_m, self._key, self._when)

    def add(self, points_m: Array64, stamp_ns: int) -> None:
        """Add points (n, 3) of large objects, in a static frame."""
        mark_cells(points_m, self._cell_m, stamp_ns, self._key, self._when)

    def nearest_m(self, centre_m: Array64, least_m: float, most_m: float, since_ns: int) -> float:
        """Distance to the nearest one observed since then, beyond least_m (the object itself); inf beyond most_m."""
        return float(nearest_marked(centre_m, self._cell_m, least_m, most_m, since_ns, self._key, self._when))

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

from stages.geometry.frames import Array64
from stages.kernels.detect.isolation import MAP_SIZE, nearest_remembered, remember


class LargeObjectMap:
    """Map of walls, ground, trunks and crowns: cells with a chord longer than any drone."""

    def __init__(self, cell_m: float = 0.5) -> None:
        self._cell_m = cell_m
        self._key = np.zeros(MAP_SIZE, dtype=np.int64)
        self._when = np.zeros(MAP_SIZE, dtype=np.int64)

    def add(self, points_m: Array64, stamp_ns: int) -> None:
        """Add points (n, 3) of large objects, in a static frame."""
        remember(points_m, self._cell_m, stamp_ns, self._key, self._when)

    def nearest_m(self, centre_m: Array64, least_m: float, most_m: float, since_ns: int) -> float:
        """Distance to the nearest one observed since then, beyond least_m (the object itself); inf beyond most_m."""
        return float(nearest_remembered(centre_m, self._cell_m, least_m, most_m, since_ns, self._key, self._when))

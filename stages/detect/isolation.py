"""What was measured around a place: sectors pulses flew through, sectors in which something stands, big things.

Around a place at range R, in the plane across the line of sight:

    inner disc     the thing itself: hits, and pulses that passed
    ring           8 sectors between `inner` and `close`: free when a pulse went on farther than R there, occupied when
                   one returned near R, within `depth` and a slope
    farther        up to `outer`: what stands there counts where nothing says that it is free in between

A drone hangs free: pulses pass it on every side. What stands on a pole, hangs on a wire, sticks out of a tree or ends a
wall has something beside it. A sector nothing flew through says nothing.

Source: ours; DESIGN, "a small cluster with *measured* emptiness around it".
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.detect.isolation import MAP_SIZE, nearest_remembered, remember


class BigThings:
    """Where walls, ground, trunks and crowns stand: cells in which a beam's chord was longer than any drone."""

    def __init__(self, cell_m: float = 0.5) -> None:
        self._cell_m = cell_m
        self._key = np.zeros(MAP_SIZE, dtype=np.int64)
        self._when = np.zeros(MAP_SIZE, dtype=np.int64)

    def add(self, points_m: Array64, stamp_ns: int) -> None:
        """Points (n, 3) of big things, in a frame in which they stand still."""
        remember(points_m, self._cell_m, stamp_ns, self._key, self._when)

    def nearest_m(self, centre_m: Array64, least_m: float, most_m: float, since_ns: int) -> float:
        """How near the nearest one seen since then is; inf beyond most_m. Nearer than least_m is the thing itself."""
        return float(nearest_remembered(centre_m, self._cell_m, least_m, most_m, since_ns, self._key, self._when))

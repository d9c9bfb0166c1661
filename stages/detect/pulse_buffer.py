"""Ring buffer of the most recent slices, from which the surroundings of a position are measured.

Source: ours; DESIGN, The graph: detect.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.detect.pulse_buffer import keep_slice, look_around_all
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
        self._fan = np.zeros((MAX_SLICES, 4))  # mean direction, and how far any pulse is beside it [rad]
        self._next = 0

    def add(self, pulses: SweptPulses, axis: Array64, end_ns: int) -> None:
        """Add a slice with its mean direction (3,) and the time of its last pulse; remove those before the window."""
        n, k = pulses.range_m.size, self._next
        missing = n - self._range_m.shape[1]
        if missing > 0:
            self._direction = np.pad(self._direction, ((0, 0), (0, missing), (0, 0)))
            self._range_m = np.pad(self._range_m, ((0, 0), (0, missing)))
        keep_slice(
            pulses.direction_vehicle, pulses.range_m, np.array(pulses.origin_vehicle_m), axis, end_ns, k,
            self._direction, self._range_m, self._origin_m, self._fan, self._sizes, self._end_ns,
        )  # fmt: skip
        self._next = (k + 1) % MAX_SLICES

    def isolation(
        self, centre_m: Array64, disc_m: float, inner_m: float, close_m: float, outer_m: float, depth_m: float
    ) -> Array64:
        """Sector counts (TALLY,) around a position (3,) in the vehicle frame; see `look_around`."""
        return look_around_all(
            self._direction, self._range_m, self._origin_m, self._fan, self._sizes,
            centre_m, disc_m, inner_m, close_m, outer_m, depth_m,
        )  # fmt: skip

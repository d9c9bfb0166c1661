"""The drone fixes of a run in memory, 160 bytes each, so that an hour of them fits for the summary.

Source: ours.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import overload

import numpy as np

from stages.messages import DroneFix, MeanShiftResult

INTEGERS, FLOATS = 4, 16  # numbers of each kind per fix
NO_MEAN_SHIFT = -1, 0.0  # iterations and shift_m of a fix without it


class FixLog(Sequence[DroneFix]):
    """Fixes in order of arrival, stored in arrays; indexing makes a new DroneFix."""

    def __init__(self) -> None:
        self._integers, self._floats = array("q"), array("d")

    def append(self, fix: DroneFix) -> None:
        """Append a fix."""
        velocity = fix.velocity_vehicle_mps
        iterations, shift_m = NO_MEAN_SHIFT
        if fix.mean_shift is not None:
            iterations, shift_m = fix.mean_shift.iterations, fix.mean_shift.shift_m
        self._integers.extend((fix.stamp_ns, fix.hits, iterations, fix.track_id))
        self._floats.append(shift_m)
        self._floats.extend(fix.xyz_vehicle_m.tolist())
        self._floats.extend(fix.covariance_m2.ravel().tolist())
        self._floats.extend((np.nan, np.nan, np.nan) if velocity is None else velocity.tolist())

    def __len__(self) -> int:
        return len(self._integers) // INTEGERS

    @overload
    def __getitem__(self, which: int) -> DroneFix: ...
    @overload
    def __getitem__(self, which: slice) -> list[DroneFix]: ...
    def __getitem__(self, which: int | slice) -> DroneFix | list[DroneFix]:
        rows = range(len(self))[which]
        return self._fix(rows) if isinstance(rows, int) else [self._fix(row) for row in rows]

    def _fix(self, row: int) -> DroneFix:
        stamp_ns, hits, iterations, track_id = self._integers[INTEGERS * row : INTEGERS * (row + 1)]
        shift_m, *floats = self._floats[FLOATS * row : FLOATS * (row + 1)]
        velocity = np.array(floats[12:])
        return DroneFix(
            stamp_ns=stamp_ns,
            xyz_vehicle_m=np.array(floats[:3]),
            covariance_m2=np.array(floats[3:12]).reshape(3, 3),
            hits=hits,
            mean_shift=None
            if iterations == NO_MEAN_SHIFT[0]
            else MeanShiftResult(iterations=iterations, shift_m=shift_m),
            track_id=track_id,
            velocity_vehicle_mps=None if np.isnan(velocity[0]) else velocity,
        )

"""The fixes of a run, 160 bytes each: an hour's are kept in memory for its summary.

Source: ours.
"""

from __future__ import annotations

from array import array
from collections.abc import Sequence
from typing import overload

import numpy as np

from stages.messages import DroneFix

WHOLE, REAL = 4, 16  # numbers of a fix: whole ones, and others


class FixLog(Sequence[DroneFix]):
    """Fixes in order; each is made anew when it is asked for."""

    def __init__(self) -> None:
        self._whole, self._real = array("q"), array("d")

    def append(self, fix: DroneFix) -> None:
        """One more."""
        velocity = fix.velocity_vehicle_mps
        self._whole.extend((fix.stamp_ns, fix.hits, fix.iterations, fix.track_id))
        self._real.append(fix.shift_m)
        self._real.extend(fix.xyz_vehicle_m.tolist())
        self._real.extend(fix.covariance_m2.ravel().tolist())
        self._real.extend((np.nan, np.nan, np.nan) if velocity is None else velocity.tolist())

    def __len__(self) -> int:
        return len(self._whole) // WHOLE

    @overload
    def __getitem__(self, which: int) -> DroneFix: ...
    @overload
    def __getitem__(self, which: slice) -> list[DroneFix]: ...
    def __getitem__(self, which: int | slice) -> DroneFix | list[DroneFix]:
        rows = range(len(self))[which]
        return self._fix(rows) if isinstance(rows, int) else [self._fix(row) for row in rows]

    def _fix(self, row: int) -> DroneFix:
        stamp_ns, hits, iterations, track_id = self._whole[WHOLE * row : WHOLE * (row + 1)]
        shift_m, *real = self._real[REAL * row : REAL * (row + 1)]
        velocity = np.array(real[12:])
        return DroneFix(
            stamp_ns=stamp_ns,
            xyz_vehicle_m=np.array(real[:3]),
            covariance_m2=np.array(real[3:12]).reshape(3, 3),
            hits=hits,
            iterations=iterations,
            shift_m=shift_m,
            track_id=track_id,
            velocity_vehicle_mps=None if np.isnan(velocity[0]) else velocity,
        )

"""By how much a picture contradicts what was known of tilt and yaw: it is given out as uncertain as it is far off.

Leaves and cars have verticals of their own: one picture's word against the turns felt is not taken over, two pictures'
is.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.align.lock import YawLock
from stages.align.reckoning import Reckoned, Reckoning
from stages.align.refine import Refined
from stages.align.spectra import quarter_difference
from stages.geometry import Array64

SURPRISE_RAD = math.radians(0.3)  # beyond the tilts' own errors
SURE_RAD2 = math.radians(1.0) ** 2  # of the turns felt between two pictures: worse ones contradict nobody


class Surprise:
    """Lays each pair of pictures beside dead reckoning, which takes their tilts over."""

    def __init__(self, reckoning: Reckoning, lock: YawLock) -> None:
        self._reckoning, self._lock = reckoning, lock
        self._tilted_before = False  # the pictures before contradicted the turns felt

    def off_rad(self, vehicle_ns: int, refined: Refined, reckoned: Reckoned) -> Array64:
        """(3,) the drone's axes; zero where nothing is contradicted. To be asked before the lock takes the yaw."""
        off_yaw_rad = self._yaw_rad(refined, reckoned)
        return self._tilt_rad(vehicle_ns, refined, reckoned) + off_yaw_rad * refined.R_drone_level[:, 2]

    def _yaw_rad(self, refined: Refined, reckoned: Reckoned) -> float:
        """Of this picture's yaw from what was known before; 0 if that is near."""
        lock = self._lock
        if lock.offset_rad is None or lock.relocked or not lock.variance_rad2 < SURE_RAD2:
            return 0.0
        off_rad = quarter_difference(refined.yaw_rad - reckoned.yaw_rad - lock.offset_rad)
        near_rad = 3.0 * math.hypot(refined.yaw_sigma_rad, math.sqrt(lock.variance_rad2)) + SURPRISE_RAD
        return off_rad if abs(off_rad) > near_rad else 0.0

    def _tilt_rad(self, vehicle_ns: int, refined: Refined, reckoned: Reckoned) -> Array64:
        """(3,) by which the pictures contradict the turns felt since the last ones."""
        off = self._reckoning.tilt_off(vehicle_ns, refined, reckoned.yaw_rad)
        tilts = float(np.trace(refined.covariance[:4, :4])) / 2 + reckoned.variance_rad2
        surprised = float(np.linalg.norm(off)) > 3.0 * math.sqrt(tilts) + SURPRISE_RAD
        if not surprised or self._tilted_before or not reckoned.variance_rad2 < SURE_RAD2:
            self._reckoning.correct(vehicle_ns, refined, reckoned.yaw_rad)
        self._tilted_before = surprised
        return off if surprised and reckoned.variance_rad2 < SURE_RAD2 else np.zeros(3)

"""Yaw of frame `odom` in `map`, R_map_odom = Rz(yaw), with the growth of its variance.

Source: ours; the usual drift of autopilots and links, in degrees per minute.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

DRIFT_RAD_PER_S = math.radians(2.0) / 60  # heading drift of both odometries
WALK_RAD2_PER_S = math.radians(0.1) ** 2


@dataclass(frozen=True)
class Yaw:
    """Yaw at a time, by motion, by vanishing points or by the pose."""

    stamp_ns: int
    yaw_rad: float
    variance_rad2: float

    @property
    def sigma_rad(self) -> float:
        """Sigma at its own time."""
        return math.sqrt(self.variance_rad2)

    def sigma_at(self, stamp_ns: int) -> float:
        """Sigma at another time [rad], with the drift since."""
        dt = abs(stamp_ns - self.stamp_ns) * 1e-9
        return math.sqrt(self.variance_rad2 + (DRIFT_RAD_PER_S * dt) ** 2 + WALK_RAD2_PER_S * dt)

    def inflated(self, by_rad2: float) -> Yaw:
        """The same yaw with `by_rad2` added to its variance."""
        return Yaw(self.stamp_ns, self.yaw_rad, self.variance_rad2 + by_rad2)


def apart_rad(a_rad: float, b_rad: float) -> float:
    """Angle between two yaws, 0 to pi."""
    return abs(math.remainder(a_rad - b_rad, 2 * math.pi))

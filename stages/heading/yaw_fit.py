"""The yaw of the autopilot's own frame in the map frame, as somebody told it once: R_map_odom = Rz(yaw).

Source: ours; sizes of the drift: links' and autopilots' usual degrees a minute.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

DRIFT_RAD_PER_S = math.radians(2.0) / 60  # both odometries' headings, while nothing measures them
WALK_RAD2_PER_S = math.radians(0.1) ** 2


@dataclass(frozen=True)
class Yaw:
    """By motion, by the streets or by the pose; at a time."""

    stamp_ns: int
    yaw_rad: float
    variance_rad2: float

    @property
    def sigma_rad(self) -> float:
        """When it was told."""
        return math.sqrt(self.variance_rad2)

    def sigma_at(self, stamp_ns: int) -> float:
        """[rad], with what has drifted since."""
        dt = abs(stamp_ns - self.stamp_ns) * 1e-9
        return math.sqrt(self.variance_rad2 + (DRIFT_RAD_PER_S * dt) ** 2 + WALK_RAD2_PER_S * dt)

    def inflated(self, by_rad2: float) -> Yaw:
        """The same yaw, known worse."""
        return Yaw(self.stamp_ns, self.yaw_rad, self.variance_rad2 + by_rad2)


def apart_rad(a_rad: float, b_rad: float) -> float:
    """Angle between two yaws, 0 to pi."""
    return abs(math.remainder(a_rad - b_rad, 2 * math.pi))

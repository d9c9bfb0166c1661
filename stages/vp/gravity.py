"""Which way is up for the drone at a picture's time, and how it turns, from the autopilot's attitudes around it.

Source: ours.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from stages.geometry.lens import Array64
from stages.messages import DroneAttitude

KEPT = 100  # attitudes: one or two seconds


@dataclass(slots=True)
class GravityTrail:
    """The latest attitudes."""

    _kept: deque[DroneAttitude] = field(default_factory=lambda: deque[DroneAttitude](maxlen=KEPT))

    def add(self, attitude: DroneAttitude) -> None:
        """Remember one."""
        self._kept.append(attitude)

    def at(self, stamp_ns: int, age_s: float) -> Array64 | None:
        """Up (3,), unit, drone axes; None when no attitude is near enough. Turned on by the rate of the nearest one."""
        nearest = self._nearest(stamp_ns, age_s)
        if nearest is None:
            return None
        up = np.asarray(nearest.R_odom_drone)[2]
        after_s = (stamp_ns - nearest.stamp_ns) * 1e-9
        up = up - after_s * np.cross(nearest.angular_velocity_drone_radps, up)  # up stands still, the axes turn
        return up / np.linalg.norm(up)

    def rate_radps(self, stamp_ns: int, age_s: float) -> Array64 | None:
        """How the drone turns (3,), its own axes; None when no attitude is near enough."""
        nearest = self._nearest(stamp_ns, age_s)
        return None if nearest is None else np.asarray(nearest.angular_velocity_drone_radps)

    def _nearest(self, stamp_ns: int, age_s: float) -> DroneAttitude | None:
        nearest = min(self._kept, key=lambda a: abs(a.stamp_ns - stamp_ns), default=None)
        return None if nearest is None or abs(nearest.stamp_ns - stamp_ns) > age_s * 1e9 else nearest

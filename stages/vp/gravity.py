"""Direction of gravity and angular rate of the drone at the time of an image, from the autopilot's attitudes.

Source: ours.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field

import numpy as np

from stages.geometry.lens import Array64
from stages.messages import DroneAttitude

MAX_ATTITUDES = 100  # one or two seconds


@dataclass(slots=True)
class AttitudeBuffer:
    """The newest attitudes of the drone."""

    _attitudes: deque[DroneAttitude] = field(default_factory=lambda: deque[DroneAttitude](maxlen=MAX_ATTITUDES))

    def add(self, attitude: DroneAttitude) -> None:
        """Append an attitude."""
        self._attitudes.append(attitude)

    def up_at(self, stamp_ns: int, age_s: float) -> Array64 | None:
        """Unit vector (3,) upwards in drone axes, extrapolated from the nearest attitude by its rate.

        None when no attitude is within `age_s`.
        """
        nearest = self._nearest(stamp_ns, age_s)
        if nearest is None:
            return None
        up = np.asarray(nearest.R_odom_drone)[2]
        after_s = (stamp_ns - nearest.stamp_ns) * 1e-9
        up = up - after_s * np.cross(nearest.angular_velocity_drone_radps, up)  # up is fixed, the axes rotate
        return up / np.linalg.norm(up)

    def rate_radps(self, stamp_ns: int, age_s: float) -> Array64 | None:
        """Angular rate (3,) of the drone, drone axes; None when no attitude is within `age_s`."""
        nearest = self._nearest(stamp_ns, age_s)
        return None if nearest is None else np.asarray(nearest.angular_velocity_drone_radps)

    def _nearest(self, stamp_ns: int, age_s: float) -> DroneAttitude | None:
        nearest = min(self._attitudes, key=lambda a: abs(a.stamp_ns - stamp_ns), default=None)
        return None if nearest is None or abs(nearest.stamp_ns - stamp_ns) > age_s * 1e9 else nearest

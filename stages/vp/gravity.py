"""Direction of gravity and angular rate of the drone at the time of an image, from its tilt.

Source: ours.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field

import numpy as np

from stages.geometry.lens import Array64
from stages.messages import DroneTilt

MAX_TILTS = 100  # one or two seconds
UNKNOWN_RAD_PER_S = 0.5  # roll and pitch rate, one sigma, of a drone in flight whose rate is not known


@dataclass(slots=True)
class TiltBuffer:
    """The newest tilts of the drone."""

    _tilts: deque[DroneTilt] = field(default_factory=lambda: deque[DroneTilt](maxlen=MAX_TILTS))

    def add(self, tilt: DroneTilt) -> None:
        """Append a tilt."""
        self._tilts.append(tilt)

    def up_at(self, stamp_ns: int, age_s: float) -> tuple[Array64, float] | None:
        """Unit vector (3,) upwards in drone axes and its sigma [rad], from the nearest tilt, extrapolated by its rate.

        None when no tilt is within `age_s`.
        """
        nearest = self._nearest(stamp_ns, age_s)
        if nearest is None:
            return None
        up = np.asarray(nearest.up_drone)
        after_s = (stamp_ns - nearest.stamp_ns) * 1e-9
        rate = nearest.angular_velocity_drone_radps
        if rate is None:
            return up, math.hypot(nearest.sigma_rad, UNKNOWN_RAD_PER_S * after_s)
        up = up - after_s * np.cross(rate, up)  # up is fixed, the axes rotate
        return up / np.linalg.norm(up), nearest.sigma_rad

    def rate_radps(self, stamp_ns: int, age_s: float) -> Array64 | None:
        """Angular rate (3,) of the drone, drone axes; None when no tilt with a rate is within `age_s`."""
        nearest = self._nearest(stamp_ns, age_s)
        rate = None if nearest is None else nearest.angular_velocity_drone_radps
        return None if rate is None else np.asarray(rate)

    def _nearest(self, stamp_ns: int, age_s: float) -> DroneTilt | None:
        nearest = min(self._tilts, key=lambda tilt: abs(tilt.stamp_ns - stamp_ns), default=None)
        return None if nearest is None or abs(nearest.stamp_ns - stamp_ns) > age_s * 1e9 else nearest

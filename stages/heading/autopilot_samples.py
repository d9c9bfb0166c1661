"""Recent verticals and, while independent of our poses, odometry of the autopilot, by time.

Source: ours.
"""

from __future__ import annotations

from collections import deque
from typing import NamedTuple

from stages.geometry.frames import Array64
from stages.messages import DroneMotion

NEAR_NS = 150_000_000  # largest difference between the times of a sample and of a measurement
KEPT = 128


class OdometrySample(NamedTuple):
    """The autopilot's position and attitude in its own frame at one time."""

    xyz_odom_m: Array64  # (3,)
    R_odom_drone: Array64  # (3, 3)
    segment: int  # a new one after each reset of its estimate


class AutopilotSamples:
    """What the autopilot states of itself."""

    def __init__(self) -> None:
        self._motions: deque[DroneMotion] = deque(maxlen=KEPT)

    def add(self, motion: DroneMotion) -> None:
        """Add an IMU interval with the autopilot's vertical and, while independent, its odometry."""
        if motion.up_drone is not None or motion.autopilot is not None:
            self._motions.append(motion)

    def up_drone(self, stamp_ns: int) -> Array64 | None:
        """The vertical (3,) in drone axes by the autopilot's roll and pitch; None: not known."""
        near = self._nearest(stamp_ns)
        return None if near is None else near.up_drone

    def odometry(self, stamp_ns: int) -> OdometrySample | None:
        """Its odometry, propagated to a time by its velocity; None: not known, or not independent of our poses."""
        near = self._nearest(stamp_ns)
        if near is None or near.autopilot is None:
            return None
        own = near.autopilot
        xyz_odom_m = own.xyz_odom_m + (stamp_ns - near.stamp_ns) * 1e-9 * own.velocity_odom_mps
        return OdometrySample(xyz_odom_m, own.R_odom_drone, own.odom_segment)

    def _nearest(self, stamp_ns: int) -> DroneMotion | None:
        near = min(self._motions, key=lambda motion: abs(motion.stamp_ns - stamp_ns), default=None)
        return None if near is None or abs(near.stamp_ns - stamp_ns) > NEAR_NS else near

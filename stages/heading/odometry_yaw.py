"""Yaw of the autopilot's frame `odom` in `map` (yaw_fit.py), and how long it stays valid.

It is kept while nothing measures it, also over gaps of the LiDAR, until the headings of both odometries have drifted
too far, the autopilot may have changed its yaw during a telemetry gap, or sources contradict each other
(fused_heading.py).

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64, heading_rad
from stages.heading.fused_heading import Heading
from stages.heading.motion_yaw import MotionYaw, Point
from stages.heading.yaw_fit import Yaw
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import DroneAttitude, DroneLocalPosition, DroneOdometry
from stages.odometry.drone.trajectory import AutopilotTrajectory

MOTION_DEG = 6.0  # largest sigma of a yaw by motion
SILENCE_S, SILENCE_RAD = 3.0, math.radians(45.0)  # a longer telemetry gap may hide a turn of frame odom
SILENT_RAD = math.radians(1.0)  # sigma added by a shorter telemetry gap


class OdometryYaw:
    """R_map_odom by all its sources, and whether they agree."""

    def __init__(self, errors: FuseErrors, sigma_rad: float) -> None:
        """`sigma_rad`: largest sigma of a usable yaw."""
        self._sigma_rad = sigma_rad
        self.by_motion = MotionYaw(errors, min(math.radians(MOTION_DEG), sigma_rad))
        self.heading = Heading()
        self.yaw: Yaw | None = None

    def add(self, trail: AutopilotTrajectory, telemetry: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """Add telemetry to the trajectory; a gap that may hide a turn of frame odom adds variance."""
        before_ns, silences = trail.attitude_ns, trail.gaps
        R_before = None if before_ns is None else trail.R_odom_drone(before_ns)
        rate = 0.0 if before_ns is None else trail.rate_radps(before_ns)
        trail.add(telemetry)
        after_ns = trail.attitude_ns
        if trail.gaps == silences or before_ns is None or R_before is None or after_ns is None:
            return
        R_after, silent_s = trail.R_odom_drone(after_ns), (after_ns - before_ns) * 1e-9
        assert R_after is not None
        turn = float(np.linalg.norm(log_rotation(R_before.T @ R_after)))
        unexplained = max(turn - silent_s * max(rate, trail.rate_radps(after_ns)), 0.0)
        if silent_s > SILENCE_S or unexplained > SILENCE_RAD:
            self.forget()
        elif self.yaw is not None:
            self.yaw = self.yaw.inflated(unexplained**2 + SILENT_RAD**2)

    def add_point(self, point: Point) -> bool:
        """Add a fix with the autopilot's position; False: the drone's motion contradicts the yaw."""
        if not self.by_motion.add(point) or self.by_motion.coarse_yaw is None:
            return True
        self.heading.add_motion_yaw(self.by_motion.coarse_yaw)
        motion_yaw, own = self.by_motion.yaw, self.useful(point.stamp_ns)
        if own is not None:
            if not self.heading.denies(point.stamp_ns, own.yaw_rad, own.sigma_at(point.stamp_ns)):
                return True
            self.yaw = None
            return False
        if motion_yaw is not None and not self.heading.contradiction:
            self.yaw = motion_yaw
        return True

    def confirms(self, stamp_ns: int, yaw_rad: float, sigma_rad: float) -> bool:
        """Whether the drone's motion agrees with a yaw and with none of its other branches."""
        denied = self.heading.denies(stamp_ns, yaw_rad, sigma_rad)
        return not denied and self.by_motion.confirms(stamp_ns, yaw_rad, sigma_rad)

    def motion_agrees(self, stamp_ns: int) -> bool:
        """Whether the drone's motion has confirmed the yaw."""
        return self.yaw is not None and self.heading.agrees(stamp_ns, self.yaw.yaw_rad, self.yaw.sigma_at(stamp_ns))

    def useful(self, stamp_ns: int) -> Yaw | None:
        """The yaw; None: never measured, or it has drifted too far since."""
        return self.yaw if self.yaw is not None and self.yaw.sigma_at(stamp_ns) <= self._sigma_rad else None

    def known(self, stamp_ns: int) -> Yaw | None:
        """The usable yaw; None also while its sources contradict each other."""
        return None if self.heading.contradiction else self.useful(stamp_ns)

    def remember(self, stamp_ns: int, R_map_odom: Array64, variance_rad2: float) -> None:
        """Take the yaw of the pose, unless its variance is larger than that of the present yaw."""
        if self.yaw is None or math.sqrt(variance_rad2) <= self.yaw.sigma_at(stamp_ns):
            self.yaw = Yaw(stamp_ns, heading_rad(R_map_odom), variance_rad2)

    def forget(self) -> None:
        """Drop all yaws."""
        self.yaw = None
        self.by_motion.restart()
        self.heading.forget_motion()

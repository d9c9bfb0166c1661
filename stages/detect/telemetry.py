"""The drone's telemetry as the detector uses it: local position and odometry of the autopilot, and its IMU.

Source: ours; DESIGN, The graph: `odometry` ("autopilot odometry when present").
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Iterable

import numpy as np

from stages.detect.candidate import START_SPEED_MPS, Candidate, Observation
from stages.detect.flight import path_sigma_m
from stages.detect.motion_log_ratios import MotionLogRatios, compare_motion
from stages.detect.reacquire import reacquire
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import DroneLocalPosition, DroneMotion, DroneOdometry
from stages.odometry.drone.inertial_path import InertialPath
from stages.odometry.drone.telemetry import DroneTelemetry

MOVES_MPS = 1.0  # faster, it flies
IMU_PASSES = 3  # scan passes that show no acceleration yet
MIN_PASSES_SINCE = 3  # scan passes after which the path since a reacquisition is compared alone


class DetectorTelemetry:
    """Local position and odometry of the drone; the local position has precedence where both are present."""

    def __init__(self) -> None:
        self._position, self._odometry = DroneTelemetry(), DroneTelemetry()
        self._both = (self._position, self._odometry)
        self._imu = InertialPath()

    def add_position(self, position: DroneLocalPosition) -> None:
        """Add a local position."""
        self._position.add_position(position)

    def add_odometry(self, odometry: DroneOdometry) -> None:
        """Add an odometry message."""
        self._odometry.add_odometry(odometry)

    def add_motion(self, motion: DroneMotion) -> None:
        """Add an interval of the IMU."""
        self._imu.add(motion)

    def by_imu(self, c: Candidate, motion_known: bool) -> MotionLogRatios | None:
        """Log ratios of a candidate's path by the accelerations that the IMU measured; None: no IMU, or no path yet."""
        if c.scan_passes <= IMU_PASSES:
            return None
        return compare_motion(self._imu.path, c.path_ns, c.path_m, path_sigma_m(c.range_m), motion_known, by_imu=True)

    def of(self, c: Candidate, motion_known: bool) -> MotionLogRatios | None:
        """Log ratios of a candidate's path against telemetry; None: no telemetry.

        For a reacquired candidate, the path since then counts alone where it contradicts the odometry: two objects may
        match the displacement by chance, while the second one moves differently.
        """
        if len(c.path_ns) < 2:
            return None
        log_ratios = self._of(c, 0, motion_known)
        if log_ratios is None or not c.reacquired_at or c.scan_passes - c.reacquired_at < MIN_PASSES_SINCE:
            return log_ratios
        since = self._of(c, bisect_left(c.path_ns, c.reacquired_ns), motion_known)
        return since if since is not None and since.denied else log_ratios

    def _of(self, c: Candidate, first: int, motion_known: bool) -> MotionLogRatios | None:
        """The same from observation number `first` on."""
        path_ns, path_m, log_ratios = c.path_ns[first:], c.path_m[first:], None
        for telemetry in self._both:
            log_ratios = log_ratios or compare_motion(telemetry, path_ns, path_m, path_sigma_m(c.range_m), motion_known)
        return log_ratios

    def reacquire(self, candidates: Iterable[Candidate], s: Observation) -> tuple[Candidate, Array64] | None:
        """The candidate that a distant observation continues, and its velocity (3,); see `reacquire.py`."""
        for telemetry in self._both:
            if match := reacquire(candidates, s, telemetry):
                return match
        return None

    def moves(self, stamp_ns: int) -> bool:
        """Whether the drone reports that it flies: then it is not a static object seen before."""
        for telemetry in self._both:  # asked for every observation of a static object
            speed = telemetry.speed_mps(stamp_ns)
            if speed is not None and math.hypot(*speed) > MOVES_MPS:
                return True
        return False

    def expected_motion(self, trail: VehicleTrajectory, now_ns: int) -> tuple[Array64, float, float]:
        """Expected velocity (3,) of a drone, its sigma on each axis, and the level speed that it reports (0: none).

        Without telemetry the drone is expected to follow the vehicle.
        """
        speeds = [telemetry.speed_mps(now_ns) for telemetry in self._both]
        for speed in speeds:
            if speed is not None:
                return np.array([0.0, 0.0, speed[1]]), 0.3 + 0.7 * speed[0], speed[0]
        return trail.velocity_mps(now_ns), START_SPEED_MPS / 2, 0.0

"""Frame `map` by the vehicle's motion: whether it stands still, and the error of the vehicle's pose in it.

A possible jump of the vehicle's odometry starts a new frame (stages/geometry/trajectory.py). Extrapolation beyond the
newest pose: stages/geometry/extrapolation.py. A vehicle turns no more than along the arc of its turning radius over its
displacement: an odometry that shows more after a gap has restarted with another yaw. (A turn in several moves is taken
for a restart, too.)

Source: ours.
"""

from __future__ import annotations

import enum
import math

import numpy as np

from stages.geometry.extrapolation import Pose3
from stages.geometry.frames import Array64, heading_rad
from stages.geometry.trajectory import RECENT_NS, VehicleTrajectory
from stages.messages import VehicleMotion

TURNING_RADIUS_M = 4.0  # the least of a car, assumed; a vehicle that turns tighter is taken for a restarted odometry
YAW_NOISE_RAD = math.radians(3.0)  # largest error of an odometry over a gap, assumed


class MapChange(enum.Enum):
    """Why the map frame may be another one."""

    START = enum.auto()  # the first pose: before, it was the vehicle frame
    GAP = enum.auto()  # the vehicle's odometry was silent, and may have restarted unnoticed
    JUMP = enum.auto()  # its poses contradict those before


class MapFrame:
    """The vehicle's trajectory in `map`."""

    def __init__(self, parked: bool) -> None:
        """`parked`: the vehicle is stationary, even without VehicleMotion."""
        self._parked = parked
        self.turn_rad = math.pi
        """By how much the frame may be turned about the vehicle since the newest gap, either way."""
        self.vehicle = VehicleTrajectory(joined=False)

    def add(self, motion: VehicleMotion) -> MapChange | None:
        """Add a vehicle pose; None: the map frame is the same."""
        before_ns = self.vehicle.newest_ns
        before = None if before_ns is None else self.vehicle.at(before_ns)
        if not self.vehicle.add(motion):
            return None
        if before_ns is None or before is None:
            return MapChange.START
        start_ns = self.vehicle.frame_start_ns
        turned_rad, possible_rad = _turns(before, self.vehicle.at(start_ns))
        self.turn_rad = min(2.0 * possible_rad, math.pi)  # the vehicle may have turned one way, the frame the other
        return MapChange.JUMP if start_ns - before_ns < RECENT_NS or turned_rad > possible_rad else MapChange.GAP

    def is_fixed(self, stamp_ns: int) -> bool:
        """Whether the vehicle's motion is known, so that the map frame does not move."""
        return self._parked or self.vehicle.known_at(stamp_ns)

    def vehicle_covariance_m2(self, stamp_ns: int, xyz_vehicle_m: Array64) -> tuple[Array64, float, Array64]:
        """Uncertainty of the vehicle's motion since its newest message, vehicle axes.

        The covariance (3, 3) that it adds to a position (3,) relative to the vehicle, the variance of the vehicle's
        yaw, and the derivative (3,) of the position by that yaw.
        """
        lever = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0])
        shift_m, yaw_rad = self.vehicle.extrapolation_sigma(stamp_ns) if self.is_fixed(stamp_ns) else (0.0, 0.0)
        return shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(lever, lever), yaw_rad**2, lever


def _turns(before: Pose3, after: Pose3) -> tuple[float, float]:
    """Change of the yaw, and the largest one of a vehicle over the displacement, the chord of an arc [rad]."""
    share = math.dist(before[1], after[1]) / (2.0 * TURNING_RADIUS_M)
    possible_rad = YAW_NOISE_RAD + 2.0 * math.asin(share) if share < 1.0 else math.pi
    return abs(heading_rad(before[0].T @ after[0])), possible_rad

"""Frame `map` by the vehicle's motion: whether it stands still, and the error of the vehicle's pose in it.

A possible jump of the vehicle's odometry starts a new frame (stages/geometry/trajectory.py). Extrapolation beyond the
newest pose: stages/geometry/extrapolation.py.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import VehicleMotion


class MapFrame:
    """The vehicle's trajectory in `map`."""

    def __init__(self, parked: bool) -> None:
        """`parked`: the vehicle is stationary, even without VehicleMotion."""
        self._parked = parked
        self.vehicle = VehicleTrajectory(joined=False)

    def add(self, motion: VehicleMotion) -> bool:
        """Add a vehicle pose; True: the map frame may be another one from now on."""
        return self.vehicle.add(motion)

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

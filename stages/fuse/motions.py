"""Motion of the vehicle and the drone, and whether it can be expressed in `map`.

A possible jump of the map frame starts a new one (stages/geometry/trajectory.py). Extrapolation beyond the newest pose:
stages/geometry/extrapolation.py.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from stages.fuse.propagated import MotionModel
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import VehicleMotion

WAIT_NS = 350_000_000  # longest wait for late odometry
SOON_NS, VEHICLE_SOON_NS = 60_000_000, 200_000_000  # without waiting, both are extrapolated so far


class Motions:
    """Trajectories of the vehicle and of the drone."""

    def __init__(self, errors: FuseErrors, parked: bool) -> None:
        """`parked`: the vehicle stands, without VehicleMotion."""
        self._parked = parked
        self.vehicle = VehicleTrajectory(joined=False)
        self.motion_model = MotionModel(errors)

    def add_vehicle_motion(self, motion: VehicleMotion) -> bool:
        """Add a vehicle pose; True: the map frame may be another one from now on."""
        return self.vehicle.add(motion)

    def vehicle_covariance_m2(self, stamp_ns: int, xyz_vehicle_m: Array64) -> tuple[Array64, float, Array64]:
        """Uncertainty of the vehicle's motion since its newest message, vehicle axes.

        The covariance (3, 3) that it adds to a position (3,) relative to the vehicle, the variance of the vehicle's
        yaw, and the derivative (3,) of the position by that yaw.
        """
        lever = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0])
        shift_m, yaw_rad = self.vehicle.extrapolation_sigma(stamp_ns) if self.map_is_fixed(stamp_ns) else (0.0, 0.0)
        return shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(lever, lever), yaw_rad**2, lever

    def map_is_fixed(self, stamp_ns: int) -> bool:
        """Whether the vehicle's motion is known, so that the map frame does not move."""
        return self._parked or self.vehicle.known_at(stamp_ns)

    def R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        """The autopilot's attitude; None: not known, or the map frame moves."""
        return self.motion_model.R_odom_drone(stamp_ns) if self.map_is_fixed(stamp_ns) else None

    def newest_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """Time up to which the drone's motion is measured; None: nothing was received lately."""
        return self.motion_model.newest_ns(now_ns, positions=self.map_is_fixed(stamp_ns))

    def must_wait(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether odometry of that time, of the drone or the vehicle, is still expected."""
        if now_ns - stamp_ns >= WAIT_NS:
            return False
        drone_ns = self.newest_ns(stamp_ns, now_ns)
        vehicle_ns = self.vehicle.newest_ns if self.map_is_fixed(stamp_ns) else None
        late = drone_ns is not None and drone_ns + SOON_NS < stamp_ns
        return late or (vehicle_ns is not None and vehicle_ns + VEHICLE_SOON_NS < stamp_ns)

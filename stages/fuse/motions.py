"""How the vehicle and the drone move, as far as anybody tells, and whether that can be told in the start frame.

The start frame is told as it is: where it may have jumped (trail.py), a new one begins. What is beyond the newest pose:
trail.py, vehicle_onward.py.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from stages.fuse.propagated import MotionModel
from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64
from stages.geometry.trajectory import VehicleTrajectory
from stages.messages import VehicleMotion

WAIT_NS = 350_000_000  # for an odometry that is late
SOON_NS, VEHICLE_SOON_NS = 60_000_000, 200_000_000  # so far the drone's and the vehicle's are extrapolated instead


class Motions:
    """The vehicle's trail and the drone's."""

    def __init__(self, errors: FuseErrors, parked: bool) -> None:
        """`parked`: the vehicle stands, whether it says so or not."""
        self._parked = parked
        self.vehicle = VehicleTrajectory(joined=False)
        self.motion_model = MotionModel(errors)

    def hear_vehicle(self, motion: VehicleMotion) -> bool:
        """Where the vehicle is; True: the start frame may be another one from now on."""
        return self.vehicle.add(motion)

    def vehicle_ahead_m2(self, stamp_ns: int, xyz_vehicle_m: Array64) -> tuple[Array64, float, Array64]:
        """What the vehicle may have moved since its newest word, in its own axes.

        The covariance (3, 3) by which a place (3,) beside it is less sure, the variance of its yaw, and how that place
        moves with the yaw (3,).
        """
        lever = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0])
        shift_m, yaw_rad = self.vehicle.extrapolation_sigma(stamp_ns) if self.still(stamp_ns) else (0.0, 0.0)
        return shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(lever, lever), yaw_rad**2, lever

    def still(self, stamp_ns: int) -> bool:
        """Whether it is known how the vehicle moves, so that the start frame stands still."""
        return self._parked or self.vehicle.known_at(stamp_ns)

    def R_odom_drone(self, stamp_ns: int) -> Array64 | None:
        """The autopilot's attitude, where a yaw between its frame and the start frame means something."""
        return self.motion_model.R_odom_drone(stamp_ns) if self.still(stamp_ns) else None

    def newest_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """Up to when the drone's motion has been told, to one who asks for a moment; None: nobody is heard."""
        return self.motion_model.newest_ns(now_ns, positions=self.still(stamp_ns))

    def must_wait(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether the drone's odometry of that moment, or the vehicle's, is still to come."""
        if now_ns - stamp_ns >= WAIT_NS:
            return False
        drone_ns = self.newest_ns(stamp_ns, now_ns)
        vehicle_ns = self.vehicle.newest_ns if self.still(stamp_ns) else None
        late = drone_ns is not None and drone_ns + SOON_NS < stamp_ns
        return late or (vehicle_ns is not None and vehicle_ns + VEHICLE_SOON_NS < stamp_ns)

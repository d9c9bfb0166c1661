"""How the vehicle and the drone move, as far as anybody tells, and whether that can be told in the start frame.

A pose of the vehicle's that is not where the ones before lead, or the first after a silence, is left out; when three in
a row lie on one smooth way, that is the way, in a start frame that may have jumped.
What is beyond the newest pose: trail.py, vehicle_onward.py.

Source: ours.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from stages.fuse.carried import Carrier
from stages.fuse.settings import FuseErrors
from stages.geometry import Array64
from stages.messages import VehicleMotion
from stages.rotation import log_rotation
from stages.trail import STILL_NS, VehicleTrail
from stages.vehicle_onward import HARD

WAIT_NS = 350_000_000  # for an odometry that is late
SOON_NS, VEHICLE_SOON_NS = 60_000_000, 200_000_000  # so far the drone's and the vehicle's are extrapolated instead
OFF_M, OFF_RAD = 0.25, 0.1  # a pose so far off is false, or the start frame has jumped
AGREE = 3


class Motions:
    """The vehicle's trail and the drone's."""

    def __init__(self, errors: FuseErrors, parked: bool) -> None:
        """`parked`: the vehicle stands, whether it says so or not."""
        self._parked = parked
        self._vehicle_ns: int | None = None
        self._odd: deque[VehicleMotion] = deque(maxlen=AGREE)  # left out since the newest believed
        self.vehicle = VehicleTrail()
        self.carrier = Carrier(errors)

    def hear_vehicle(self, motion: VehicleMotion) -> bool:
        """Where the vehicle is; True: the start frame may be another one from now on."""
        before_ns = self._vehicle_ns
        if before_ns is not None and motion.stamp_ns <= before_ns:
            return False
        if before_ns is None or (motion.stamp_ns - before_ns <= STILL_NS and self._leads_to(motion)):
            known = [motion]
        else:
            self._odd.append(motion)
            if not _go_on(tuple(self._odd)):
                return False
            known = list(self._odd)
        another = before_ns is None or len(known) > 1
        self._vehicle_ns = motion.stamp_ns
        self._odd.clear()
        if another:
            self.vehicle.begin_anew(known[0].stamp_ns)
        for pose in known:
            self.vehicle.add(pose)
        return another

    def _leads_to(self, motion: VehicleMotion) -> bool:
        """Whether a pose is where the ones before lead."""
        assert self._vehicle_ns is not None
        dt = (motion.stamp_ns - self._vehicle_ns) * 1e-9
        R, xyz_m = self.vehicle.straight_on(motion.stamp_ns)
        off_m = float(np.linalg.norm(motion.xyz_start_m - xyz_m))
        off_rad = float(np.linalg.norm(log_rotation(R.T @ motion.R_start_vehicle)))
        return off_m <= OFF_M + HARD.place_m(dt) and off_rad <= OFF_RAD + HARD.turn_rad(dt)

    def vehicle_ahead_m2(self, stamp_ns: int, xyz_vehicle_m: Array64) -> tuple[Array64, float, Array64]:
        """What the vehicle may have moved since its newest word, in its own axes.

        The covariance (3, 3) by which a place (3,) beside it is less sure, the variance of its yaw, and how that place
        moves with the yaw (3,).
        """
        lever = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0])
        shift_m, yaw_rad = self.vehicle.unsure(stamp_ns) if self.still(stamp_ns) else (0.0, 0.0)
        return shift_m**2 * np.eye(3) + yaw_rad**2 * np.outer(lever, lever), yaw_rad**2, lever

    def still(self, stamp_ns: int) -> bool:
        """Whether it is known how the vehicle moves, so that the start frame stands still."""
        return self._parked or (self._vehicle_ns is not None and stamp_ns - self._vehicle_ns < STILL_NS)

    def R_own_drone(self, stamp_ns: int) -> Array64 | None:
        """The autopilot's attitude, where a yaw between its frame and the start frame means something."""
        return self.carrier.R_own_drone(stamp_ns) if self.still(stamp_ns) else None

    def newest_ns(self, stamp_ns: int, now_ns: int) -> int | None:
        """Up to when the drone's motion has been told, to one who asks for a moment; None: nobody is heard."""
        return self.carrier.newest_ns(now_ns, positions=self.still(stamp_ns))

    def must_wait(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether the drone's odometry of that moment, or the vehicle's, is still to come."""
        if now_ns - stamp_ns >= WAIT_NS:
            return False
        drone_ns = self.newest_ns(stamp_ns, now_ns)
        vehicle_ns = self._vehicle_ns if self.still(stamp_ns) else None
        late = drone_ns is not None and drone_ns + SOON_NS < stamp_ns
        return late or (vehicle_ns is not None and vehicle_ns + VEHICLE_SOON_NS < stamp_ns)


def _go_on(poses: tuple[VehicleMotion, ...]) -> bool:
    """Whether three poses in a row are of one smooth way: the second step goes on as the first."""
    if len(poses) < AGREE:
        return False
    a, b, c = poses
    first_s, second_s = (b.stamp_ns - a.stamp_ns) * 1e-9, (c.stamp_ns - b.stamp_ns) * 1e-9
    if min(first_s, second_s) <= 0.0:
        return False
    share, longer_s = second_s / first_s, max(first_s, second_s)
    off_m = c.xyz_start_m - b.xyz_start_m - share * (b.xyz_start_m - a.xyz_start_m)
    turns = log_rotation(a.R_start_vehicle.T @ b.R_start_vehicle), log_rotation(b.R_start_vehicle.T @ c.R_start_vehicle)
    near = float(np.linalg.norm(off_m)) <= OFF_M + 2.0 * HARD.place_m(longer_s)
    return near and float(np.linalg.norm(turns[1] - share * turns[0])) <= OFF_RAD + 2.0 * HARD.turn_rad(longer_s)

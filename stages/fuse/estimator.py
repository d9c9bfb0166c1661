"""What is known of the drone's pose, and how each piece of news changes it.

    fixes alone          position and velocity (positions.py)
    a rotation is known  a chain of poses (chain.py), carried by the drone's own odometry, begins; it ends when the
                         rotation is doubted, the drone is lost, or another one is followed

Where fixes deny what is believed all begins anew at them, without the rotation, which may have been why.

Source: DESIGN, Fusion; ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.back_end import BackEnd
from stages.fuse.branch_check import Witness
from stages.fuse.chain import PERIOD_NS, Chain
from stages.fuse.motions import WAIT_NS, Motions
from stages.fuse.positions import GATE, Positions, Told
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.geometry.frames import Array64, heading_rad, rotation_z
from stages.geometry.se3 import mahalanobis2, position_covariance
from stages.heading.motion_yaw import DOUBT, Point
from stages.heading.odometry_yaw import North
from stages.heading.yaw_fit import apart_rad
from stages.messages import DroneAttitude, DroneFix, DroneLocalPosition, DroneOdometry, VehicleMotion, VisualMotion

LEAST_MPS = 0.5  # slower, a camera's direction of flight says nothing
BRANCH_RAD, BRANCHES = math.radians(30.0), 3  # so many rotations in a row so far off are another branch


class Estimator:
    """All that is remembered of the drone that is followed."""

    def __init__(self, back: BackEnd, errors: FuseErrors, limits: FuseLimits, parked: bool) -> None:
        self._tilt_rad2 = math.radians(errors.tilt_deg) ** 2
        self._yaw_sigma_rad = math.radians(limits.yaw_sigma_deg)
        self._lost_ns = round(limits.lost_after_s * 1e9)
        self.motions = Motions(errors, parked)
        self.positions = Positions(errors, self.motions)
        self.chain = Chain(back, errors, self.positions)
        self.north = North(errors, self._yaw_sigma_rad)
        self._witness = Witness(self.motions)
        self.resets, self.track_id = 0, 0
        self.on_trial = False  # what is followed may be something else than what was before
        self._was_still = False
        self.newest_fix_ns: int | None = None  # also of a drone that is lost
        self.unbacked_ns: int | None = None  # when the streets told a rotation that no motion has agreed with yet
        self.lose()

    def lose(self) -> None:
        """No position is known; the yaw of the autopilot's frame may be."""
        self.positions.lose()
        self.chain.lose()
        self.from_streets = False  # the chain's yaw is theirs alone
        self._off_branch = 0
        self.streets_ns: int | None = None  # of the newest rotation of theirs that was used

    # what is heard of motion

    def hear_vehicle(self, motion: VehicleMotion) -> None:
        """Where the vehicle is. When it is heard at last, or again, the start frame may be another one."""
        at_ns, vehicle = self.positions.free.stamp_ns, self.motions.vehicle
        before = None if at_ns is None else (*vehicle.at(at_ns), vehicle.velocity_mps(at_ns))
        if not self.motions.hear_vehicle(motion):
            return
        self.doubt()
        self.north.forget()
        self._witness.restart()
        if at_ns is not None and before is not None:
            R, t, velocity_mps = before
            R_after, t_after = vehicle.at_in_current_frame(at_ns)
            R_new_old = R_after @ R.T
            new_mps = vehicle.velocity_mps(motion.stamp_ns) - R_new_old @ velocity_mps
            self.positions.turn(R_new_old, t_after - R_new_old @ t, new_mps)

    def hear_autopilot(self, word: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """The drone's own estimate."""
        self.north.hear(self.motions.motion_model.autopilot, word)

    def hear_pictures(self, motion: VisualMotion) -> None:
        """The drone's odometry by its camera: its turn, and in which direction it flew if nothing better tells."""
        self.motions.motion_model.pictures.add(motion)
        self._witness.hear_pictures(motion)
        fix_ns, free = self.positions.fix_ns, self.positions.free
        fresh = fix_ns is not None and abs(motion.stamp_ns - fix_ns) < WAIT_NS
        if not (self.chain.running and fresh) or motion.direction_from is None or motion.direction_sigma_rad is None:
            return
        if not self.motions.still(motion.stamp_ns):  # it flew so over ground, not beside the vehicle
            return
        if np.linalg.norm(free.velocity_mps) > LEAST_MPS:
            R, _, P = self.chain.at(motion.from_ns)
            sigma = math.hypot(motion.direction_sigma_rad, math.sqrt(float(np.trace(P[:3, :3])) / 3))
            free.look_along(R @ motion.direction_from, sigma)

    # where the drone is

    def at(self, stamp_ns: int) -> tuple[Array64 | None, Array64, Array64]:
        """R_map_drone, position, covariance (6, 6) of a drone whose position is known.

        Without a chain R is None and of the covariance only the position's block counts, start axes.
        """
        if not self.chain.running:
            return None, *self.positions.at(stamp_ns)
        return self.chain.at(stamp_ns)

    def advance(self, now_ns: int) -> None:
        """Lengthen the chain up to now, as far as the drone's odometry has come; begin one if the yaw is known."""
        self.north.heading.pass_time(now_ns)
        still = self.motions.still(now_ns)
        if self._was_still and not still:  # from now on the start frame is wherever the vehicle is
            self.doubt()
            self.north.forget()
            self.positions.forget_velocity()
        self._was_still = still
        if self.north.heading.contradiction:
            self.doubt()
            self.north.yaw = None
        back = self.chain.back
        if self.chain.running and now_ns - back.stamp_ns > self._lost_ns:
            self.lose()  # nothing was heard of anything for so long: there is no way over it
        while self.chain.running and back.stamp_ns + PERIOD_NS <= now_ns:
            next_ns = back.stamp_ns + PERIOD_NS
            newest = self.motions.newest_ns(next_ns, now_ns)
            if newest is not None and newest < next_ns and now_ns - next_ns < WAIT_NS:
                break
            R_odom = self.motions.motion_model.R_odom_drone(next_ns)
            self.chain.extend(next_ns, R_odom)
            if R_odom is not None and self.motions.still(next_ns):
                self.north.remember(next_ns, back.R_map_drone @ R_odom.T, self.chain.yaw_sigma_rad**2)
        if not self.chain.running and self.positions.free.stamp_ns is not None:
            self._resume(self.positions.free.stamp_ns)
        elif self.chain.running and self.chain.yaw_sigma_rad > self._yaw_sigma_rad:
            self._resume(back.stamp_ns)

    # fixes

    def follow(self, fix: DroneFix) -> None:
        """The next fixes are of this one's track; another one's position is not known.

        What is found elsewhere than the pose was carried to may be something else: a yaw that is remembered turns it
        into a pose only when it has moved, or hung, as the drone says it did (`on_trial`).
        """
        if fix.track_id != self.track_id:
            self._witness.restart()
            self.north.by_motion.restart()
            self.on_trial = self.track_id != 0 and not self._expects(fix)
            if self.positions.known:
                self.lose()
                self.resets += 1
        self.track_id = fix.track_id

    def _expects(self, fix: DroneFix) -> bool:
        """Whether a pose is known that was carried to where this fix is."""
        if not self.chain.running:
            return False
        R_map_vehicle, t = self.motions.vehicle.at(fix.stamp_ns)
        R, expected_m, covariance = self.chain.at(fix.stamp_ns)
        told_m2 = R_map_vehicle @ fix.covariance_m2 @ R_map_vehicle.T
        off_m = R_map_vehicle @ fix.xyz_vehicle_m + t - expected_m
        return mahalanobis2(off_m, position_covariance(covariance, R) + told_m2) <= GATE

    def see_fix(self, fix: DroneFix) -> None:
        """A LiDAR position at its own time."""
        stamp_ns = fix.stamp_ns
        if not self.motions.vehicle.in_current_frame(stamp_ns):
            return
        self.newest_fix_ns = max(stamp_ns, self.newest_fix_ns or stamp_ns)
        R_map_vehicle, t = self.motions.vehicle.at(stamp_ns)
        z = R_map_vehicle @ fix.xyz_vehicle_m + t
        ahead_m2, _, _ = self.motions.vehicle_ahead_m2(stamp_ns, fix.xyz_vehicle_m)
        bias_covariance_m2 = fix.bias_covariance_m2
        told = Told(
            R_map_vehicle @ (fix.covariance_m2 + ahead_m2) @ R_map_vehicle.T,
            None if bias_covariance_m2 is None else R_map_vehicle @ bias_covariance_m2 @ R_map_vehicle.T,
        )
        if not self.positions.known:
            self.positions.find(fix, z, told)
            return
        R, expected_m, covariance = self.at(stamp_ns)
        expected_m2 = covariance[3:, 3:] if R is None else position_covariance(covariance, R)
        taken = self.positions.takes(stamp_ns, z - expected_m, expected_m2, told)
        if taken is None:
            return
        if not taken:
            self._find_anew(fix, z, told)
            return
        worth = self.positions.worth(stamp_ns)
        if R is not None:
            self.chain.add_position(stamp_ns, R, z, worth * self.positions.fix_covariance_m2)
        R_after = None if R is None else self.chain.at(stamp_ns)[0]  # what it explains now is no drift
        self.positions.follow(stamp_ns, z, worth, R_after)
        self._witness.see_fix(fix)
        self._watch_motion(stamp_ns, z, told.whole_m2)

    def _find_anew(self, fix: DroneFix, z: Array64, told: Told) -> None:
        """The fixes agree with each other and not with what is believed."""
        if self.chain.running and self.from_streets:
            self.north.heading.contradict("the LiDAR's positions deny the heading that the streets tell")
        self.lose()
        self.positions.find(fix, z, told)
        self.north.yaw = None
        self.north.by_motion.restart()
        self._witness.restart()
        self.resets += 1

    def _watch_motion(self, stamp_ns: int, z: Array64, told_m2: Array64) -> None:
        """A fix that fits, beside the autopilot's position: together they tell the heading."""
        place = self.motions.motion_model.autopilot.position(stamp_ns)
        if place is None or not self.motions.still(stamp_ns):
            return
        if not self.north.watch(Point(stamp_ns, z, 0.5 * float(told_m2[0, 0] + told_m2[1, 1]), *place)):
            self.doubt()
        elif self.north.by_motion_too(stamp_ns):
            self.from_streets = False

    # rotations

    def see_rotation(self, stamp_ns: int, R_vehicle_drone: Array64, covariance_rad2: Array64, switches: int) -> None:
        """A RESOLVED rotation at its own time."""
        if not self.motions.vehicle.in_current_frame(stamp_ns):
            return
        R, heading = self.motions.vehicle.at(stamp_ns)[0] @ R_vehicle_drone, self.north.heading
        R_odom = self.motions.R_odom_drone(stamp_ns)
        sigma = math.sqrt(float(np.linalg.eigvalsh(covariance_rad2)[-1]))
        yaw_rad = None if R_odom is None else heading_rad(R @ R_odom.T)
        if heading.switched(switches):
            self.unresolved()
        self._witness.hear_streets(stamp_ns, R)
        own = self.north.useful(stamp_ns)
        if own is not None and yaw_rad is not None and apart_rad(own.yaw_rad, yaw_rad) > BRANCH_RAD:
            self._off_branch += 1
            if self._off_branch >= BRANCHES:
                heading.contradict("the streets tell another heading than the one known so far", stamp_ns)
            return
        self._off_branch = 0
        fits = not self.chain.running or self.chain.fits(stamp_ns, R, covariance_rad2)
        if fits is None:
            return
        if not heading.hear_streets(stamp_ns, switches, yaw_rad, sigma) or not self.positions.known:
            return
        if not self.chain.running or not fits:
            self._begin_with_streets(stamp_ns, R, covariance_rad2, yaw_rad, sigma)
        else:
            self.chain.add_rotation(stamp_ns, R, covariance_rad2)
            self.streets_ns = stamp_ns

    def _begin_with_streets(
        self, stamp_ns: int, R: Array64, covariance_rad2: Array64, yaw_rad: float | None, sigma_rad: float
    ) -> None:
        """A chain by the streets' rotation, once the drone's motion has agreed with it as far as this stage sees it.

        `align` knows the branch by motion too. But once a pose is out the autopilot may take it for its own, and all
        that it says from then on agrees: so the pose given out first has to be right.
        """
        if self.chain.running and apart_rad(heading_rad(R @ self.chain.at(stamp_ns)[0].T), 0.0) < BRANCH_RAD:
            self.chain.start(stamp_ns, R, covariance_rad2)  # so many refused: what is believed has crept away
            self.resets += 1
            return
        by_way = yaw_rad is not None and self.north.backs(stamp_ns, yaw_rad, sigma_rad)
        if not (by_way or self._witness.agrees(DOUBT)):
            self.doubt()
            self.unbacked_ns = stamp_ns
            return
        self.resets += self.chain.running
        self.chain.start(stamp_ns, R, covariance_rad2)
        self.from_streets = True

    def unresolved(self) -> None:
        """The streets' branch is not known now, or another one: what came from them alone is doubted."""
        self._witness.restart()
        if self.chain.running and self.from_streets:
            self.doubt()
            self.north.yaw = None

    def doubt(self) -> None:
        """The rotation is not believed any more; the position is."""
        self.resets += self.chain.running
        self.chain.running, self.from_streets = False, False

    def _resume(self, stamp_ns: int) -> None:
        """Begin a chain with the yaw that is known of the autopilot's frame, if it is."""
        own, R_odom = self.north.known(stamp_ns), self.motions.R_odom_drone(stamp_ns)
        if own is not None and self.on_trial:
            self.on_trial = not self.north.by_motion.fits(own)
            if self.on_trial:
                return
        if own is not None and R_odom is not None:
            R = rotation_z(own.yaw_rad) @ R_odom
            variance = np.diag([self._tilt_rad2, self._tilt_rad2, own.sigma_at(stamp_ns) ** 2])
            self.chain.start(stamp_ns, R, R.T @ variance @ R)

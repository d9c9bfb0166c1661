"""Estimate of the drone's pose and its update by each measurement.

    fixes alone          position and velocity (positions.py)
    a rotation is known  a chain of poses (chain.py), propagated by the drone's odometry, starts; it ends when the
                         rotation is no longer accepted, the drone is lost, or another track is followed

Fixes that contradict the estimate consistently reset it, without the rotation, which may be the cause.

Source: DESIGN, Fusion; ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.branch_check import BranchCheck
from stages.fuse.chain import PERIOD_NS, Chain
from stages.fuse.motion_model import WAIT_NS, Motions
from stages.fuse.positions import GATE, MeasurementCovariance, Positions
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.fuse.smoother import BackEnd
from stages.geometry.frames import Array64, heading_rad, rotation_z
from stages.geometry.se3 import mahalanobis2, position_covariance
from stages.heading.motion_yaw import MAX_ALTERNATIVE_ODDS, Point
from stages.heading.odometry_yaw import OdometryYaw
from stages.heading.yaw_fit import Yaw, apart_rad
from stages.messages import (
    DroneAttitude,
    DroneFix,
    DroneLocalPosition,
    DroneOdometry,
    HeadingPrior,
    VehicleMotion,
    VisualMotion,
)

LEAST_MPS = 0.5  # minimum speed for a direction of flight by the camera
PRIOR_NS, PRIOR_FIXES = 150_000_000, 5  # largest age of a prior, and LiDAR positions in a row that agree with it
BRANCH_RAD, BRANCHES = math.radians(30.0), 3  # consecutive rotations this far off are another branch


class Estimator:
    """State of the drone that is followed."""

    def __init__(self, back: BackEnd, errors: FuseErrors, limits: FuseLimits, parked: bool) -> None:
        self._tilt_rad2 = math.radians(errors.tilt_deg) ** 2
        self._yaw_sigma_rad = math.radians(limits.yaw_sigma_deg)
        self._lost_ns = round(limits.lost_after_s * 1e9)
        self.motions = Motions(errors, parked)
        self.positions = Positions(errors, self.motions)
        self.chain = Chain(back, errors, self.positions)
        self.odometry_yaw = OdometryYaw(errors, self._yaw_sigma_rad)
        self._branch_check = BranchCheck(self.motions)
        self.resets, self.track_id = 0, 0
        self.unverified = False  # the new track may be of another object than the one before
        self._was_still = False
        self._prior: HeadingPrior | None = None  # of an earlier run, until a yaw was known in this one
        self._prior_done = False
        self._agreed = 0  # consecutive LiDAR positions at the position of the prior
        self.newest_fix_ns: int | None = None  # also when the drone is lost
        self.unconfirmed_ns: int | None = None  # newest rotation by vanishing points that no motion has confirmed
        self.lose()

    def lose(self) -> None:
        """Drop the position; the yaw of frame odom stays."""
        self.positions.lose()
        self.chain.lose()
        self.from_vanishing_points = False  # the chain's yaw comes from vanishing points alone
        self._off_branch = 0
        self.vp_rotation_ns: int | None = None  # newest rotation by vanishing points that was used

    # motion

    def add_vehicle_motion(self, motion: VehicleMotion) -> None:
        """Add a vehicle pose. The first one, or the first after a gap, may start another map frame."""
        at_ns, vehicle = self.positions.free.stamp_ns, self.motions.vehicle
        before = None if at_ns is None else (*vehicle.at(at_ns), vehicle.velocity_mps(at_ns))
        if not self.motions.add_vehicle_motion(motion):
            return
        self.drop_rotation()
        self.odometry_yaw.forget()
        self._branch_check.restart()
        if at_ns is not None and before is not None:
            R, t, velocity_mps = before
            R_after, t_after = vehicle.at_in_current_frame(at_ns)
            R_new_old = R_after @ R.T
            new_mps = vehicle.velocity_mps(motion.stamp_ns) - R_new_old @ velocity_mps
            self.positions.turn(R_new_old, t_after - R_new_old @ t, new_mps)

    def add_autopilot(self, telemetry: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """Add telemetry of the autopilot."""
        self.odometry_yaw.add(self.motions.motion_model.autopilot, telemetry)

    def add_prior(self, prior: HeadingPrior) -> None:
        """Add the yaw of frame odom that an earlier run of grd knew."""
        self._prior = prior

    def _use_prior(self, stamp_ns: int, z: Array64, noise: MeasurementCovariance) -> None:
        """Take it once, before any yaw is known, when PRIOR_FIXES LiDAR positions in a row agree with it."""
        prior = self._prior
        self._prior_done = self._prior_done or self.odometry_yaw.yaw is not None
        if self._prior_done or prior is None or abs(stamp_ns - prior.stamp_ns) > PRIOR_NS:
            self._agreed = 0
            return
        covariance_m2 = noise.whole_m2 + prior.position_sigma_m**2 * np.eye(3)
        self._agreed = self._agreed + 1 if mahalanobis2(z - prior.xyz_map_m, covariance_m2) <= GATE else 0
        if self._agreed >= PRIOR_FIXES:
            self.odometry_yaw.yaw = Yaw(stamp_ns, prior.yaw_map_odom_rad, prior.sigma_rad**2)

    def add_visual_motion(self, motion: VisualMotion) -> None:
        """Add visual odometry of the drone: its turn, and its direction of flight where nothing better measures it."""
        self.motions.motion_model.images.add(motion)
        self._branch_check.add_visual_motion(motion)
        fix_ns, free = self.positions.fix_ns, self.positions.free
        fresh = fix_ns is not None and abs(motion.stamp_ns - fix_ns) < WAIT_NS
        if not (self.chain.running and fresh) or motion.direction_from is None or motion.direction_sigma_rad is None:
            return
        if not self.motions.map_is_fixed(motion.stamp_ns):  # the direction is over ground, not relative to the vehicle
            return
        if np.linalg.norm(free.velocity_mps) > LEAST_MPS:
            R, _, P = self.chain.at(motion.from_ns)
            sigma = math.hypot(motion.direction_sigma_rad, math.sqrt(float(np.trace(P[:3, :3])) / 3))
            free.add_direction(R @ motion.direction_from, sigma)

    @property
    def raw_yaw(self) -> Yaw | None:
        """Yaw in `map` of the autopilot's frame as it reports it now; None: not known, or the drone may be another."""
        yaw, raw = self.odometry_yaw.yaw, self.motions.motion_model.autopilot.R_odom_raw
        if yaw is None or self.unverified or self.odometry_yaw.heading.contradiction:
            return None
        return Yaw(yaw.stamp_ns, yaw.yaw_rad + heading_rad(raw), yaw.variance_rad2)

    # prediction

    def at(self, stamp_ns: int) -> tuple[Array64 | None, Array64, Array64]:
        """R_map_drone, position and covariance (6, 6) of a drone whose position is known.

        Without a chain R is None and only the position block of the covariance is valid, map axes.
        """
        if not self.chain.running:
            return None, *self.positions.at(stamp_ns)
        return self.chain.at(stamp_ns)

    def advance(self, now_ns: int) -> None:
        """Extend the chain to `now_ns`, as far as odometry has arrived; start one when the yaw is known."""
        self.odometry_yaw.heading.pass_time(now_ns)
        still = self.motions.map_is_fixed(now_ns)
        if self._was_still and not still:  # from now on the map frame moves with the vehicle
            self.drop_rotation()
            self.odometry_yaw.forget()
            self.positions.forget_velocity()
        self._was_still = still
        if self.odometry_yaw.heading.contradiction:
            self.drop_rotation()
            self.odometry_yaw.yaw = None
        back = self.chain.back
        if self.chain.running and now_ns - back.stamp_ns > self._lost_ns:
            self.lose()  # a gap without any data is not propagated
        while self.chain.running and back.stamp_ns + PERIOD_NS <= now_ns:
            next_ns = back.stamp_ns + PERIOD_NS
            newest = self.motions.newest_ns(next_ns, now_ns)
            if newest is not None and newest < next_ns and now_ns - next_ns < WAIT_NS:
                break
            R_odom = self.motions.motion_model.R_odom_drone(next_ns)
            self.chain.extend(next_ns, R_odom)
            if R_odom is not None and self.motions.map_is_fixed(next_ns):
                self.odometry_yaw.remember(next_ns, back.R_map_drone @ R_odom.T, self.chain.yaw_sigma_rad**2)
        if not self.chain.running and self.positions.free.stamp_ns is not None:
            self._resume(self.positions.free.stamp_ns)
        elif self.chain.running and self.chain.yaw_sigma_rad > self._yaw_sigma_rad:
            self._resume(back.stamp_ns)

    # fixes

    def follow(self, fix: DroneFix) -> None:
        """Follow the track of a fix; a change of track drops the position.

        A track away from the propagated pose may be another object: a remembered yaw makes it a pose only when it has
        moved, or hovered, as the drone's odometry reports (`unverified`).
        """
        if fix.track_id != self.track_id:
            self._branch_check.restart()
            self.odometry_yaw.by_motion.restart()
            self.unverified = self.track_id != 0 and not self._expects(fix)
            if self.positions.known:
                self.lose()
                self.resets += 1
        self.track_id = fix.track_id

    def _expects(self, fix: DroneFix) -> bool:
        """Whether the fix is within the gate of the propagated pose."""
        if not self.chain.running:
            return False
        R_map_vehicle, t = self.motions.vehicle.at(fix.stamp_ns)
        R, expected_m, covariance = self.chain.at(fix.stamp_ns)
        fix_m2 = R_map_vehicle @ fix.covariance_m2 @ R_map_vehicle.T
        off_m = R_map_vehicle @ fix.xyz_vehicle_m + t - expected_m
        return mahalanobis2(off_m, position_covariance(covariance, R) + fix_m2) <= GATE

    def add_fix(self, fix: DroneFix) -> None:
        """Add a LiDAR position at its own time."""
        stamp_ns = fix.stamp_ns
        if not self.motions.vehicle.in_current_frame(stamp_ns):
            return
        self.newest_fix_ns = max(stamp_ns, self.newest_fix_ns or stamp_ns)
        R_map_vehicle, t = self.motions.vehicle.at(stamp_ns)
        z = R_map_vehicle @ fix.xyz_vehicle_m + t
        ahead_m2, _, _ = self.motions.vehicle_covariance_m2(stamp_ns, fix.xyz_vehicle_m)
        bias_covariance_m2 = fix.bias_covariance_m2
        noise = MeasurementCovariance(
            R_map_vehicle @ (fix.covariance_m2 + ahead_m2) @ R_map_vehicle.T,
            None if bias_covariance_m2 is None else R_map_vehicle @ bias_covariance_m2 @ R_map_vehicle.T,
        )
        if not self.positions.known:
            self.positions.find(fix, z, noise)
            return
        R, expected_m, covariance = self.at(stamp_ns)
        expected_m2 = covariance[3:, 3:] if R is None else position_covariance(covariance, R)
        taken = self.positions.accepts(stamp_ns, z - expected_m, expected_m2, noise)
        if taken is None:
            return
        if not taken:
            self._reinitialise(fix, z, noise)
            return
        factor = self.positions.worth(stamp_ns)
        if R is not None:
            self.chain.add_position(stamp_ns, R, z, factor * self.positions.fix_covariance_m2)
        R_after = None if R is None else self.chain.at(stamp_ns)[0]  # what the fix corrects in rotation is not drift
        self.positions.follow(stamp_ns, z, factor, R_after)
        self._branch_check.add_fix(fix)
        self._use_prior(stamp_ns, z, noise)
        self._add_motion_point(stamp_ns, z, noise.whole_m2)

    def _reinitialise(self, fix: DroneFix, z: Array64, noise: MeasurementCovariance) -> None:
        """Restart at fixes that agree with each other and contradict the estimate."""
        if self.chain.running and self.from_vanishing_points:
            self.odometry_yaw.heading.contradict("the LiDAR positions contradict the heading by vanishing points")
        self.lose()
        self.positions.find(fix, z, noise)
        self.odometry_yaw.yaw = None
        self.odometry_yaw.by_motion.restart()
        self._branch_check.restart()
        self.resets += 1

    def _add_motion_point(self, stamp_ns: int, z: Array64, fix_m2: Array64) -> None:
        """Add an accepted fix with the autopilot's position: together they measure the heading."""
        odometry = self.motions.motion_model.autopilot.position(stamp_ns)
        if odometry is None or not self.motions.map_is_fixed(stamp_ns):
            return
        if not self.odometry_yaw.add_point(Point(stamp_ns, z, 0.5 * float(fix_m2[0, 0] + fix_m2[1, 1]), *odometry)):
            self.drop_rotation()
        elif self.odometry_yaw.motion_agrees(stamp_ns):
            self.from_vanishing_points = False

    # rotations

    def add_rotation(self, stamp_ns: int, R_vehicle_drone: Array64, covariance_rad2: Array64, switches: int) -> None:
        """Add a RESOLVED rotation at its own time."""
        if not self.motions.vehicle.in_current_frame(stamp_ns):
            return
        R, heading = self.motions.vehicle.at(stamp_ns)[0] @ R_vehicle_drone, self.odometry_yaw.heading
        R_odom = self.motions.R_odom_drone(stamp_ns)
        sigma = math.sqrt(float(np.linalg.eigvalsh(covariance_rad2)[-1]))
        yaw_rad = None if R_odom is None else heading_rad(R @ R_odom.T)
        if heading.switched(switches):
            self.unresolved()
        self._branch_check.add_vp_rotation(stamp_ns, R)
        own = self.odometry_yaw.useful(stamp_ns)
        if own is not None and yaw_rad is not None and apart_rad(own.yaw_rad, yaw_rad) > BRANCH_RAD:
            self._off_branch += 1
            if self._off_branch >= BRANCHES:
                heading.contradict("the vanishing points give another heading than the one known so far", stamp_ns)
            return
        self._off_branch = 0
        fits = not self.chain.running or self.chain.fits(stamp_ns, R, covariance_rad2)
        if fits is None:
            return
        if not heading.add_vp_rotation(stamp_ns, switches, yaw_rad, sigma) or not self.positions.known:
            return
        if not self.chain.running or not fits:
            self._start_with_vp_rotation(stamp_ns, R, covariance_rad2, yaw_rad, sigma)
        else:
            self.chain.add_rotation(stamp_ns, R, covariance_rad2)
            self.vp_rotation_ns = stamp_ns

    def _start_with_vp_rotation(
        self, stamp_ns: int, R: Array64, covariance_rad2: Array64, yaw_rad: float | None, sigma_rad: float
    ) -> None:
        """Start a chain by a rotation from vanishing points, once the motion measured by this stage confirms it.

        `align` determines the branch by motion too. But once a pose is published the autopilot may fuse it, and from
        then on its odometry agrees with it, right or wrong: so the first published pose has to be on the right branch.
        """
        if self.chain.running and apart_rad(heading_rad(R @ self.chain.at(stamp_ns)[0].T), 0.0) < BRANCH_RAD:
            self.chain.start(stamp_ns, R, covariance_rad2)  # consistent rejections: the estimate has drifted
            self.resets += 1
            return
        confirmed = yaw_rad is not None and self.odometry_yaw.confirms(stamp_ns, yaw_rad, sigma_rad)
        if not (confirmed or self._branch_check.agrees(MAX_ALTERNATIVE_ODDS)):
            self.drop_rotation()
            self.unconfirmed_ns = stamp_ns
            return
        self.resets += self.chain.running
        self.chain.start(stamp_ns, R, covariance_rad2)
        self.from_vanishing_points = True

    def unresolved(self) -> None:
        """The branch by vanishing points is unknown or another one: drop what came from them alone."""
        self._branch_check.restart()
        if self.chain.running and self.from_vanishing_points:
            self.drop_rotation()
            self.odometry_yaw.yaw = None

    def drop_rotation(self) -> None:
        """Drop the rotation; the position stays."""
        self.resets += self.chain.running
        self.chain.running, self.from_vanishing_points = False, False

    def _resume(self, stamp_ns: int) -> None:
        """Start a chain with the known yaw of frame odom, if there is one."""
        own, R_odom = self.odometry_yaw.known(stamp_ns), self.motions.R_odom_drone(stamp_ns)
        if own is not None and self.unverified:
            self.unverified = not self.odometry_yaw.by_motion.fits(own)
            if self.unverified:
                return
        if own is not None and R_odom is not None:
            R = rotation_z(own.yaw_rad) @ R_odom
            variance = np.diag([self._tilt_rad2, self._tilt_rad2, own.sigma_at(stamp_ns) ** 2])
            self.chain.start(stamp_ns, R, R.T @ variance @ R)

"""What is known of the drone's pose, and how each piece of news changes it.

    fixes alone          position and velocity (Drift without odometry)
    a rotation is known  the back end's chain of poses, carried by the drone's own odometry, begins; it ends when the
                         rotation is doubted, the drone is lost, or another one is followed

A fix or rotation is gated by chi-square on its innovation with P + R, then weighed by Huber in the back end. Eight
refused in a row that agree with each other are right, and what is believed is wrong: all begins anew there, without the
rotation, which may have been why.

Source: DESIGN, Fusion; ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.back_end import BackEnd
from stages.fuse.carried import Carrier, Step
from stages.fuse.correlated import Worth, inflation
from stages.fuse.drift import Drift
from stages.fuse.heading import apart_rad
from stages.fuse.motion_yaw import Point
from stages.fuse.north import North, heading_rad
from stages.fuse.rejected import Rejected
from stages.fuse.rigid import carried_covariance, distance2, position_covariance
from stages.fuse.settings import FuseErrors, FuseLimits
from stages.geometry import Array64, rotation_z
from stages.messages import DroneAttitude, DroneFix, DroneLocalPosition, DroneMotion, DroneOdometry, VehicleMotion
from stages.rotation import log_rotation
from stages.trail import VehicleTrail

PERIOD_NS = 100_000_000  # of the chain's poses
WAIT_NS = 350_000_000  # for an odometry that is late
SOON_NS = 60_000_000  # so far it is extrapolated instead
STILL_NS = 400_000_000  # how the vehicle moves is known so long after its word
GATE = 16.27  # chi-square, 3 degrees of freedom, 99.9 %
HELD_MPS = 0.1  # noise of the autopilot's velocity beside its drift, and of its age
LEAST_MPS = 0.5  # slower, a camera's direction of flight says nothing
BRANCH_RAD, BRANCHES = math.radians(30.0), 3  # so many rotations in a row so far off are another branch


class Estimator:
    """All that is remembered of the drone that is followed."""

    def __init__(self, back: BackEnd, errors: FuseErrors, limits: FuseLimits, parked: bool) -> None:
        self.back = back
        self._errors, self._parked = errors, parked
        self._yaw_sigma_rad = math.radians(limits.yaw_sigma_deg)
        self.vehicle = VehicleTrail()
        self._vehicle_ns: int | None = None
        self.carrier = Carrier(errors)
        self.north = North(errors, self._yaw_sigma_rad)
        self.resets, self.track_id = 0, 0
        self.newest_fix_ns: int | None = None  # also of a drone that is lost
        self.lose()

    def lose(self) -> None:
        """No position is known; the yaw of the autopilot's frame may be."""
        self.free, self.left = Drift(self._errors, odometry=False), Drift(self._errors, odometry=True)
        self.running = False  # the chain
        self._from_streets = False  # its yaw is theirs alone
        self.fix_ns: int | None = None
        self.fix_covariance_m2 = np.zeros((3, 3))  # start axes, of the newest used
        self.rotation_covariance_rad2 = np.zeros((3, 3))
        self.nis = math.nan
        self._fixes_refused, self._rotations_refused = Rejected(), Rejected()
        self._off_branch = 0
        self._fix_worth = Worth(self._errors.fix_time_s)
        self._rotation_worth = Worth(self._errors.rotation_time_s)

    # what is heard of motion

    def hear_vehicle(self, motion: VehicleMotion) -> None:
        """Where the vehicle is. When it is heard at last, or again, the start frame may be another one."""
        if self._vehicle_ns is not None and motion.stamp_ns <= self._vehicle_ns:
            return
        silent = self._vehicle_ns is None or motion.stamp_ns - self._vehicle_ns > STILL_NS
        if silent and self.free.stamp_ns is not None:
            R, t = self.vehicle.at(self.free.stamp_ns)
            self.doubt()
            self.north.forget()
            self.left = Drift(self._errors, odometry=True)
            R_new_old = motion.R_start_vehicle @ R.T
            self.free.turn(R_new_old, motion.xyz_start_m - R_new_old @ t)
        self._vehicle_ns = motion.stamp_ns
        self.vehicle.add(motion)

    def hear_autopilot(self, word: DroneAttitude | DroneLocalPosition | DroneOdometry) -> None:
        """The drone's own estimate."""
        self.north.hear(self.carrier.autopilot, word)

    def hear_pictures(self, motion: DroneMotion) -> None:
        """The drone's odometry by its camera: its turn, and in which direction it flew if nothing better tells."""
        self.carrier.pictures.add(motion)
        fresh = self.fix_ns is not None and abs(motion.stamp_ns - self.fix_ns) < WAIT_NS
        if not (self.running and fresh) or motion.direction_from is None or motion.direction_sigma_rad is None:
            return
        _, R, _, P = self.at(motion.from_ns)
        if R is not None and np.linalg.norm(self.free.velocity_mps) > LEAST_MPS:
            sigma = math.hypot(motion.direction_sigma_rad, math.sqrt(float(np.trace(P[:3, :3])) / 3))
            self.free.look_along(R @ motion.direction_from, sigma)

    # where the drone is

    def still(self, stamp_ns: int) -> bool:
        """Whether it is known how the vehicle moves, so that the start frame stands still."""
        return self._parked or (self._vehicle_ns is not None and stamp_ns - self._vehicle_ns < STILL_NS)

    def must_wait(self, stamp_ns: int, now_ns: int) -> bool:
        """Whether the drone's odometry of that moment is still to come."""
        newest = self.carrier.newest_ns(now_ns, positions=self.still(stamp_ns))
        return newest is not None and newest + SOON_NS < stamp_ns and now_ns - stamp_ns < WAIT_NS

    def step(self, from_ns: int, to_ns: int, R_start_drone: Array64) -> Step:
        """The drone's way between two moments."""
        since_ns = self.fix_ns if self.fix_ns is not None else from_ns
        return self.carrier.step(from_ns, to_ns, R_start_drone, self.left, self.free, self.still(to_ns), since_ns)

    def at(self, stamp_ns: int) -> tuple[int, Array64 | None, Array64, Array64]:
        """(moment it is told from, R_start_drone, position, covariance (6, 6)) of a drone whose position is known.

        Without a chain R is None and of the covariance only the position's block counts, start axes.
        """
        if not self.running:
            return stamp_ns, None, *self._at_by_fixes(stamp_ns)
        key_ns, R, xyz_m = self.back.near(stamp_ns)
        step = self.step(key_ns, stamp_ns, R)
        covariance = carried_covariance(self.back.covariance, step.R, step.t_m, step.covariance)
        return key_ns, R @ step.R, xyz_m + R @ step.t_m, covariance

    def _at_by_fixes(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """Position and covariance by the fixes' velocity; how far the drone says it left that is not known better."""
        assert self.free.stamp_ns is not None
        xyz_m, covariance_m2 = self.free.ahead(stamp_ns)
        covariance = np.zeros((6, 6))
        covariance[3:, 3:] += covariance_m2
        bent_m = self.carrier.bent_m(self.free.stamp_ns, stamp_ns)
        if bent_m is not None:
            xyz_m = xyz_m + np.array([0.0, 0.0, bent_m[2]])
            aside_m2 = 0.5 * float(bent_m[:2] @ bent_m[:2])  # whichever way
            covariance[3:, 3:] += np.diag([aside_m2, aside_m2, 0.0])
        return xyz_m, covariance

    def velocity(self, stamp_ns: int, R: Array64 | None, covariance: Array64) -> tuple[Array64, Array64]:
        """Over ground (3,), start axes, and its covariance."""
        v_own, R_own = self.carrier.autopilot.velocity_own_mps(stamp_ns), self.carrier.R_own_drone(stamp_ns)
        age_s = 0.0 if self.fix_ns is None else max((stamp_ns - self.fix_ns) * 1e-9, 0.0)
        if R is None or v_own is None or R_own is None or self.left.stamp_ns is None or not self.still(stamp_ns):
            return self.free.velocity_mps, self.free.velocity_covariance + self.free.q * age_s * np.eye(3)
        told = R @ R_own.T @ v_own
        across = np.cross([0.0, 0.0, yaw_sigma_rad(R, covariance)], told)
        spread = self.left.velocity_covariance + (self.left.q * age_s + HELD_MPS**2) * np.eye(3)
        return told + self.left.velocity_mps, spread + np.outer(across, across)

    def advance(self, now_ns: int) -> None:
        """Lengthen the chain up to now, as far as the drone's odometry has come; begin one if the yaw is known."""
        self.north.heading.pass_time(now_ns)
        if self.north.heading.contradiction:
            self.doubt()
            self.north.yaw = None
        while self.running and self.back.stamp_ns + PERIOD_NS <= now_ns:
            next_ns = self.back.stamp_ns + PERIOD_NS
            newest = self.carrier.newest_ns(now_ns, positions=self.still(next_ns))
            if newest is not None and newest < next_ns and now_ns - next_ns < WAIT_NS:
                break
            R_own = self.carrier.R_own_drone(next_ns)
            tilt_rad2 = math.radians(self._errors.tilt_deg) ** 2 * inflation(1e-9 * PERIOD_NS, self._errors.tilt_time_s)
            step = self.step(self.back.stamp_ns, next_ns, self.back.R_start_drone)
            self.back.extend(next_ns, step, None if R_own is None else R_own[2], tilt_rad2)
            if R_own is not None and self.still(next_ns):
                variance = yaw_sigma_rad(self.back.R_start_drone, self.back.covariance) ** 2
                self.north.remember(next_ns, self.back.R_start_drone @ R_own.T, variance)
        if not self.running and self.free.stamp_ns is not None:
            self._resume(self.free.stamp_ns)
        elif self.running and yaw_sigma_rad(self.back.R_start_drone, self.back.covariance) > self._yaw_sigma_rad:
            self._resume(self.back.stamp_ns)

    # fixes

    def follow(self, track_id: int) -> None:
        """The next fixes are of this track; another one's position is not known."""
        if track_id != self.track_id and self.free.stamp_ns is not None:
            self.lose()
            self.north.by_motion.restart()
            self.resets += 1
        self.track_id = track_id

    def see_fix(self, fix: DroneFix) -> None:
        """A LiDAR position at its own time."""
        self.newest_fix_ns = max(fix.stamp_ns, self.newest_fix_ns or fix.stamp_ns)
        R_start_vehicle, t = self.vehicle.at(fix.stamp_ns)
        z = R_start_vehicle @ fix.xyz_vehicle_m + t
        told_m2 = R_start_vehicle @ fix.covariance_m2 @ R_start_vehicle.T
        if self.free.stamp_ns is None:
            self._find(fix, z, told_m2)
            return
        key_ns, R, expected_m, covariance = self.at(fix.stamp_ns)
        expected_m2 = covariance[3:, 3:] if R is None else position_covariance(covariance, R)
        nis = distance2(z - expected_m, expected_m2 + told_m2)
        if not nis <= GATE:
            if self._fixes_refused.add(fix.stamp_ns, z - expected_m, told_m2):
                if self.running and self._from_streets:
                    self.north.heading.contradict("the LiDAR's positions deny the heading that the streets tell")
                self.lose()
                self._find(fix, z, told_m2)
                self.north.yaw = None
                self.north.by_motion.restart()
                self.resets += 1
            return
        self._fixes_refused.clear()
        self.nis, self.fix_covariance_m2 = nis, self._errors.fix_variance * told_m2
        worth = (1.0 - self._errors.fix_lasting) * self._fix_worth.factor(fix.stamp_ns)
        if R is not None:
            key_ns, R_key, _ = self.back.near(fix.stamp_ns)
            step = self.step(key_ns, fix.stamp_ns, R_key)
            noise = worth * self.fix_covariance_m2 + position_covariance(step.covariance, R)
            self.back.add_position(key_ns, step, z, noise)
        self._follow_velocity(fix.stamp_ns, z, worth, R)
        self.fix_ns = max(fix.stamp_ns, self.fix_ns or fix.stamp_ns)
        self._watch_motion(fix.stamp_ns, z, told_m2)

    def _watch_motion(self, stamp_ns: int, z: Array64, told_m2: Array64) -> None:
        """A fix that fits, beside the autopilot's position: together they tell the heading."""
        place = self.carrier.autopilot.place(stamp_ns)
        if place is None or not self.still(stamp_ns):
            return
        if not self.north.watch(Point(stamp_ns, z, 0.5 * float(told_m2[0, 0] + told_m2[1, 1]), *place)):
            self.doubt()
        elif self.north.by_motion_too(stamp_ns):
            self._from_streets = False

    def _find(self, fix: DroneFix, z: Array64, told_m2: Array64) -> None:
        """The first fix, or the first that is believed again."""
        velocity = fix.velocity_vehicle_mps
        if velocity is not None:
            velocity = self.vehicle.to_local(fix.stamp_ns, fix.xyz_vehicle_m, velocity)[1]
        self.free.start(fix.stamp_ns, z, told_m2, velocity)
        self.fix_ns, self.fix_covariance_m2 = fix.stamp_ns, self._errors.fix_variance * told_m2

    def _follow_velocity(self, stamp_ns: int, z: Array64, worth: float, R: Array64 | None) -> None:
        """Velocity without odometry, and what odometry leaves over."""
        covariance_m2, trail = self.fix_covariance_m2, self.carrier.autopilot
        v0 = None if self.free.stamp_ns is None else trail.velocity_own_mps(self.free.stamp_ns)
        v1 = trail.velocity_own_mps(stamp_ns)
        turned_mps = 0.0 if v0 is None or v1 is None else float(np.linalg.norm(v1 - v0))
        self.free.see(stamp_ns, z, covariance_m2, None, turned_mps)
        R_own, last_ns = self.carrier.R_own_drone(stamp_ns), self.left.stamp_ns
        if R is None or R_own is None or not self.still(stamp_ns):
            return
        way = None if last_ns is None else self.carrier.way_own_m(last_ns, stamp_ns)
        if way is None:
            self.left.start(stamp_ns, z, worth * covariance_m2, None)
        else:
            self.left.see(stamp_ns, z, worth * covariance_m2, R @ R_own.T @ way[0], turned_mps)

    # rotations

    def see_rotation(self, stamp_ns: int, R_vehicle_drone: Array64, covariance_rad2: Array64, switches: int) -> None:
        """A RESOLVED rotation at its own time."""
        R, heading = self.vehicle.at(stamp_ns)[0] @ R_vehicle_drone, self.north.heading
        R_own = self.carrier.R_own_drone(stamp_ns) if self.still(stamp_ns) else None
        sigma = math.sqrt(float(np.linalg.eigvalsh(covariance_rad2)[-1]))
        yaw_rad = None if R_own is None else heading_rad(R @ R_own.T)
        if heading.switched(switches):
            self.unresolved()
        own = self.north.yaw
        if own is not None and yaw_rad is not None and apart_rad(own.yaw_rad, yaw_rad) > BRANCH_RAD:
            self._off_branch += 1
            if self._off_branch >= BRANCHES:
                heading.contradict("the streets tell another heading than the one known so far")
            return
        self._off_branch = 0
        fits = not self.running or self._fits(stamp_ns, R, covariance_rad2)
        if fits is None:
            return
        if not heading.hear_streets(stamp_ns, switches, yaw_rad, sigma) or self.free.stamp_ns is None:
            return
        if not self.running:
            if self.north.lets(stamp_ns, yaw_rad, sigma):
                self._start(stamp_ns, R, covariance_rad2)
                self._from_streets = True
        elif not fits:
            self._start(stamp_ns, R, covariance_rad2)
            self.resets += 1
        else:
            self.rotation_covariance_rad2 = covariance_rad2
            worth = (1.0 - self._errors.rotation_lasting) * self._rotation_worth.factor(stamp_ns)
            key_ns, R_key, _ = self.back.near(stamp_ns)
            step = self.step(key_ns, stamp_ns, R_key)
            self.back.add_rotation(key_ns, step, R, worth * covariance_rad2 + step.covariance[:3, :3])

    def _fits(self, stamp_ns: int, R: Array64, covariance_rad2: Array64) -> bool | None:
        """Whether a rotation is within the gate; None: it is not; False: nor were those before, and they agree."""
        _, R_expected, _, covariance = self.at(stamp_ns)
        assert R_expected is not None
        off = log_rotation(R_expected.T @ R)
        if distance2(off, covariance[:3, :3] + covariance_rad2) <= GATE:
            self._rotations_refused.clear()
            return True
        return False if self._rotations_refused.add(stamp_ns, off, covariance_rad2) else None

    def unresolved(self) -> None:
        """The streets' branch is not known now, or another one: what came from them alone is doubted."""
        if self.running and self._from_streets:
            self.doubt()
            self.north.yaw = None

    def doubt(self) -> None:
        """The rotation is not believed any more; the position is."""
        self.resets += self.running
        self.running, self._from_streets = False, False

    @property
    def why_rotation(self) -> str:
        """Who tells the rotation, in words."""
        if self._from_streets:
            return "rotation by both cameras"
        return f"rotation by the drone's motion; {self.north.by_motion.reason}"

    def _resume(self, stamp_ns: int) -> None:
        """Begin a chain with the yaw that is known of the autopilot's frame, if it is."""
        own, R_own = self.north.known(stamp_ns), self.carrier.R_own_drone(stamp_ns)
        if own is not None and R_own is not None and self.still(stamp_ns):
            R = rotation_z(own.yaw_rad) @ R_own
            tilt = math.radians(self._errors.tilt_deg) ** 2
            self._start(stamp_ns, R, R.T @ np.diag([tilt, tilt, own.sigma_at(stamp_ns) ** 2]) @ R)

    def _start(self, stamp_ns: int, R: Array64, covariance_rad2: Array64) -> None:
        """Begin a chain with a rotation told for some moment, at the newest fix; or where the chain before had come."""
        if self.running:
            at_ns, xyz_m = self.back.stamp_ns, self.back.xyz_start_m
            covariance_m2 = position_covariance(self.back.covariance, self.back.R_start_drone)
        else:
            assert self.free.stamp_ns is not None
            at_ns = self.free.stamp_ns
            xyz_m, covariance_m2 = self.free.ahead(at_ns)
            self.left = Drift(self._errors, odometry=True)
            self.left.start(at_ns, xyz_m, covariance_m2, None)
        turn = self.step(stamp_ns, at_ns, R)
        R_start_drone = R @ turn.R
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = turn.R.T @ covariance_rad2 @ turn.R + turn.covariance[:3, :3]
        covariance[3:, 3:] = R_start_drone.T @ covariance_m2 @ R_start_drone
        self.back.start(at_ns, R_start_drone, xyz_m, covariance)
        self.running = True
        self.rotation_covariance_rad2 = covariance_rad2
        self._rotation_worth = Worth(self._errors.rotation_time_s)


def yaw_sigma_rad(R: Array64, covariance: Array64) -> float:
    """Of a pose's rotation about the vertical."""
    return math.sqrt(max(float(R[2] @ covariance[:3, :3] @ R[2]), 0.0))

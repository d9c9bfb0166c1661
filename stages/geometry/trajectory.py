"""The vehicle's trajectory in frame map, interpolated and briefly extrapolated.

Frame map is the start frame of the vehicle's odometry (T_map_vehicle), without the jumps of that odometry. Without
VehicleMotion it equals the vehicle frame: correct for a parked vehicle; for a moving one static objects then seem to
move.

The start frame of the odometry may jump, as when the odometry restarts (extrapolation.py detects it). The new start
frame is then aligned with the trajectory, so that frame map continues and the jump does not become a velocity:

    T_map_vehicle = T_map_source T_source_vehicle,   T_map_source = T_map_vehicle(t) T_source_vehicle(t)^-1

Source: DESIGN, sweep "ego-motion compensated"; ours.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque

import numpy as np
from numpy.typing import NDArray

from stages.geometry.extrapolation import EXTRAPOLATION_S, LEAST_SPAN_NS, USUAL_MANEUVER, JumpGate, is_reachable
from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import log_rotation, nearest_rotation, nearly_rotation
from stages.kernels.geometry.trajectory import STEP_NS, moved, poses_at, to_map, to_vehicle
from stages.messages import MotionStatus, VehicleMotion

KEPT = 512  # poses
NEWEST = 8  # poses between which `at_each` interpolates in one compiled call
TOGETHER_NS = 10_000_000  # shortest interval that gives a speed
RECENT_NS = 700_000_000  # the motion counts as known this long after a pose; visual odometry delivers 5 poses a second
RESTART_NS = 2_000_000_000  # during a gap this long an odometry may restart unnoticed
FURTHEST_NS = round(1e9 * EXTRAPOLATION_S)  # extrapolation beyond the newest pose
ACCELERATION_NS, FEWEST = 600_000_000, 5  # an acceleration is measured over both, by poses TOGETHER_NS apart
SAME_VERTICAL = 1e-6  # change of roll and pitch [rad] below any measurement


def same_vertical(R_map_vehicle: Array64, R_before: Array64) -> bool:
    """Whether two rotations (3, 3) differ by a turn about one vertical alone, as where roll and pitch are not measured.

    With a tilted mount the vertical is constant in the vehicle's axes, with a tilted frame in those of the map.
    """
    difference = np.abs(R_map_vehicle - R_before)
    return bool(min(difference[2].max(), difference[:, 2].max()) < SAME_VERTICAL)


class VehicleTrajectory:
    """T_map_vehicle over time: linear between poses, constant velocity for EXTRAPOLATION_S beyond the newest."""

    def __init__(self, joined: bool = True) -> None:
        """`joined`: a new start frame is aligned with the trajectory; otherwise it begins a new frame map."""
        self._joined, self._gate = joined, JumpGate()
        self._T_map_source: tuple[Array64, Array64] | None = None  # R, t; None: identity
        self._poses: deque[tuple[int, Array64, Array64]] = deque(maxlen=KEPT)  # stamp, R_map_vehicle, t_map_vehicle
        self._rates: tuple[Array64, Array64] | None = None  # cache of `_newest_rates`
        self._newest: tuple[NDArray[np.int64], Array64, Array64] | None = None  # the NEWEST poses, for `at_each`
        self.frame_start_ns = 0
        """Stamp of the first pose in the current start frame; earlier ones lie in another."""
        self._cache: dict[int, tuple[Array64, Array64]] = {}  # results of `at` since the newest pose

    @property
    def known(self) -> bool:
        """Whether there is any pose."""
        return bool(self._poses)

    def known_at(self, stamp_ns: int) -> bool:
        """Whether the newest pose is recent enough (RECENT_NS) for the motion to be known."""
        return bool(self._poses) and stamp_ns - self._poses[-1][0] < RECENT_NS

    @property
    def measures_tilt(self) -> bool:
        """Whether roll and pitch have changed in the newest poses; those of wheels alone never do."""
        return bool(self._poses) and not same_vertical(
            self._poses[-1][1], self._poses[-min(FEWEST, len(self._poses))][1]
        )

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest pose; None before the first."""
        return self._poses[-1][0] if self._poses else None

    def add(self, motion: VehicleMotion) -> bool:
        """Add a pose. True: positions remembered in frame map may be wrong from now on.

        A pose that is not newer than the last is ignored. One that is not reachable from the poses before is rejected
        until AGREE of them are consistent: then the start frame has jumped. The new start frame is aligned with the
        trajectory. After a gap that alignment is a guess, because an odometry that restarts unnoticed may begin
        near the extrapolated pose. Where frames are not joined, a new frame begins, also after each gap. A DENIED
        pose withdraws the poses after it; the trajectory is extrapolated from it.
        """
        if motion.status is MotionStatus.DENIED:
            self._withdraw(motion.stamp_ns)
            return False
        if not self._poses:
            self._append(motion)
            return not self._joined
        if motion.stamp_ns <= self._poses[-1][0]:
            return False
        continuous = self._joined or self.known_at(motion.stamp_ns)
        poses = self._gate.add(motion, continuous and self._is_reachable(motion))
        new_frame = len(poses) > 1
        silent_ns = poses[0].stamp_ns - self._poses[-1][0] if poses else 0
        guessed = silent_ns >= RESTART_NS or (new_frame and silent_ns >= RECENT_NS)
        displaced = guessed if self._joined else new_frame
        if new_frame:
            self._start_frame(poses[0])
        for pose in poses:
            self._append(pose)
        return displaced

    def _withdraw(self, after_ns: int) -> None:
        """Remove the poses after a time, except the first."""
        while len(self._poses) > 1 and self._poses[-1][0] > after_ns:
            self._poses.pop()
        self._gate, self._rates, self._newest = JumpGate(), None, None
        self._cache.clear()

    def _is_reachable(self, motion: VehicleMotion) -> bool:
        """Whether a pose is reachable from the poses before it."""
        newest_ns, oldest_ns = self._poses[-1][0], max(self._poses[0][0], self.frame_start_ns)
        speed_known = newest_ns - oldest_ns >= TOGETHER_NS
        expected, seconds = self.constant_velocity(motion.stamp_ns), (motion.stamp_ns - newest_ns) * 1e-9
        speed_mps = self.newest_speed_mps if speed_known else None
        return is_reachable(expected, self._in_map(motion), seconds, speed_mps)

    def _in_map(self, motion: VehicleMotion) -> tuple[Array64, Array64]:
        """A pose of the source, in frame map."""
        if self._T_map_source is None:
            return motion.R_map_vehicle, motion.xyz_map_m
        R, t = self._T_map_source
        return R @ motion.R_map_vehicle, R @ motion.xyz_map_m + t

    def _append(self, motion: VehicleMotion) -> None:
        self._cache.clear()
        self._rates = self._newest = None
        R, t = self._in_map(motion)
        self._poses.append((motion.stamp_ns, np.ascontiguousarray(R), np.ascontiguousarray(t)))

    def _start_frame(self, first: VehicleMotion) -> None:
        """Begin a new start frame with this pose; earlier poses no longer contribute to the velocity."""
        if self._joined:
            R, t = self.at(first.stamp_ns)
            R_map_source = nearest_rotation(R @ first.R_map_vehicle.T)
            self._T_map_source = R_map_source, t - R_map_source @ first.xyz_map_m
        self.frame_start_ns = first.stamp_ns

    def at(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R_map_vehicle (3, 3) and t_map_vehicle (3,) [m]; identity without any pose, constant before the first."""
        poses = self._poses
        if stamp_ns in self._cache:
            return self._cache[stamp_ns]
        if not poses:
            return np.eye(3), np.zeros(3)
        if len(poses) == 1 or stamp_ns <= poses[0][0]:
            return poses[0][1], poses[0][2]
        if len(self._cache) >= KEPT:
            self._cache.clear()
        if stamp_ns > poses[-1][0]:
            self._cache[stamp_ns] = self._beyond(min(stamp_ns - poses[-1][0], FURTHEST_NS) * 1e-9)
            return self._cache[stamp_ns]
        after = len(poses) - 1
        if stamp_ns < poses[-2][0]:  # most queries fall between the two newest poses
            after = bisect_right(poses, stamp_ns, key=lambda pose: pose[0])
        (t0, R0, x0), (t1, R1, x1) = poses[after - 1], poses[after]
        share = (stamp_ns - t0) / (t1 - t0)
        # The poses differ by milliseconds: interpolate linearly and project back to a rotation.
        self._cache[stamp_ns] = nearly_rotation(R0 + share * (R1 - R0)), x0 + share * (x1 - x0)
        return self._cache[stamp_ns]

    def at_each(self, stamps_ns: NDArray[np.int64]) -> tuple[Array64, Array64]:
        """R_map_vehicle (n, 3, 3) and t_map_vehicle (n, 3) [m] at times (n,), each as `at` gives them."""
        if self._newest is None and len(self._poses) > 1:
            poses = [self._poses[k] for k in range(-min(NEWEST, len(self._poses)), 0)]
            ns, R, t = zip(*poses, strict=True)
            self._newest = np.array(ns, dtype=np.int64), np.array(R), np.array(t)
        if self._newest is not None and stamps_ns.size and stamps_ns.min() > self._newest[0][0]:
            return poses_at(*self._newest, *self._newest_rates(), FURTHEST_NS, stamps_ns)
        poses = [self.at(stamp_ns) for stamp_ns in stamps_ns.tolist()]
        return np.array([R for R, _ in poses]).reshape(-1, 3, 3), np.array([t for _, t in poses]).reshape(-1, 3)

    def _beyond(self, seconds: float) -> tuple[Array64, Array64]:
        """R and t some seconds after the newest pose, with constant rates."""
        _, R, t = self._poses[-1]
        return moved(R, t, *self._newest_rates(), seconds)

    def _newest_rates(self) -> tuple[Array64, Array64]:
        """Angular velocity (3,) [rad/s], vehicle axes, and velocity (3,) [m/s], map axes; zero if not observed."""
        if self._rates is None:
            newest_ns, R, t = self._poses[-1]
            span_ns, R_then, t_then = TOGETHER_NS, R, t
            for then_ns, R_before, t_before in reversed(self._poses):
                if then_ns < self.frame_start_ns:
                    break
                if newest_ns - then_ns >= TOGETHER_NS:
                    span_ns, R_then, t_then = newest_ns - then_ns, R_before, t_before
                if span_ns >= LEAST_SPAN_NS:
                    break
            self._rates = log_rotation(R_then.T @ R) / (span_ns * 1e-9), (t - t_then) / (span_ns * 1e-9)
        return self._rates

    def in_current_frame(self, stamp_ns: int) -> bool:
        """Whether the result of `at` for a time lies in the current frame map."""
        return self._joined or stamp_ns >= self.frame_start_ns

    def rate_radps(self, stamp_ns: int) -> Array64:
        """Angular velocity (3,) in vehicle axes; zero where no pose gives it."""
        before, after = self.at(stamp_ns - STEP_NS // 2)[0], self.at(stamp_ns + STEP_NS // 2)[0]
        return log_rotation(before.T @ after) / (STEP_NS * 1e-9)

    def velocity_mps(self, stamp_ns: int) -> Array64:
        """The vehicle's velocity (3,) in frame map."""
        return (self.at(stamp_ns + STEP_NS)[1] - self.at(stamp_ns)[1]) / (STEP_NS * 1e-9)

    @property
    def newest_speed_mps(self) -> float:
        """Speed at the newest pose, as extrapolation uses it. There has to be a pose."""
        return math.hypot(*self._newest_rates()[1].tolist())

    def newest_acceleration(self) -> tuple[Array64, Array64] | None:
        """Acceleration (3,) [m/s^2] and its variance (3,), vehicle axes, by a parabola through the newest poses.

        None: the current start frame has too few of them. There has to be a pose.
        """
        newest_ns, R, newest_m = self._poses[-1]
        ages_ns: list[int] = []
        places: list[Array64] = []
        for ns, _, t in reversed(self._poses):
            if ns < self.frame_start_ns or (newest_ns - ns > ACCELERATION_NS and len(ages_ns) >= FEWEST):
                break
            if not ages_ns or newest_ns - ns - ages_ns[-1] >= TOGETHER_NS:
                ages_ns.append(newest_ns - ns)
                places.append(t - newest_m)
        if len(ages_ns) < FEWEST:
            return None
        times = -1e-9 * np.array(ages_ns)
        A = np.vander(times, 3, increasing=True) * [1.0, 1.0, 0.5]
        inverse = np.linalg.inv(A.T @ A)
        fitted = inverse @ A.T @ np.array(places)
        noise_m2 = ((places - A @ fitted) ** 2).sum(axis=0) / (len(times) - 3)
        return R.T @ fitted[2], (R.T**2) @ noise_m2 * inverse[2, 2]

    def constant_velocity(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R and t extrapolated with the newest rates, without the horizon that `at` has."""
        return self._beyond((stamp_ns - self._poses[-1][0]) * 1e-9)

    def extrapolation_sigma(self, stamp_ns: int) -> tuple[float, float]:
        """One sigma of the position [m] and yaw [rad] that `at` returns, from extrapolation alone; 0 up to the newest.

        USUAL_MANEUVER gives the growth; beyond EXTRAPOLATION_S the whole assumed motion is added.
        """
        if not self._poses or stamp_ns <= self._poses[-1][0]:
            return 0.0, 0.0
        dt = (stamp_ns - self._poses[-1][0]) * 1e-9
        position_m, yaw_rad = USUAL_MANEUVER.displacement_m(dt), USUAL_MANEUVER.turn_rad(dt)
        beyond_s = dt - 1e-9 * FURTHEST_NS
        if beyond_s > 0.0:
            turn_radps, velocity_mps = self._newest_rates()
            position_m += beyond_s * float(np.linalg.norm(velocity_mps))
            yaw_rad += beyond_s * float(np.linalg.norm(turn_radps))
        return position_m, yaw_rad

    def extrapolation_covariance_m2(self, stamp_ns: int, xyz_vehicle_m: Array64) -> Array64:
        """Covariance (3, 3) [m^2], vehicle axes, of a position (3,) relative to the vehicle, by extrapolation alone."""
        sigma_m, yaw_rad = self.extrapolation_sigma(stamp_ns)
        by_yaw = np.array([-xyz_vehicle_m[1], xyz_vehicle_m[0], 0.0]) * yaw_rad
        return sigma_m**2 * np.eye(3) + np.outer(by_yaw, by_yaw)

    def to_vehicle(self, stamp_ns: int, xyz_m: Array64, velocity_mps: Array64) -> tuple[Array64, Array64]:
        """Position (3,) and velocity (3,) relative to the vehicle, in its axes, of map position and velocity.

        The velocity contains the vehicle's own translation and rotation.
        """
        return to_vehicle(*self.at(stamp_ns), *self.at(stamp_ns + STEP_NS), xyz_m, velocity_mps)

    def to_map(self, stamp_ns: int, xyz_m: Array64, velocity_mps: Array64) -> tuple[Array64, Array64]:
        """The inverse of `to_vehicle`."""
        return to_map(*self.at(stamp_ns), *self.at(stamp_ns + STEP_NS), xyz_m, velocity_mps)

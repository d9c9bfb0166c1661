"""The vehicle's trail: where it was at each moment, so that what stands still in the world stands still in memory.

Frame local: the vehicle's own odometry frame (T_map_vehicle) without its jumps. Without VehicleMotion it is the
vehicle's frame itself: right for a parked vehicle; then what stands still seems to move with a driving one.

The odometry's start frame may jump, as when it is started afresh (vehicle_onward.py says how that is told from a false
pose). The new one is then laid on where the trail had the vehicle: the local frame goes on, and no jump is a speed.

    T_map_vehicle = T_map_source T_source_vehicle,   T_map_source = T_map_vehicle(t) T_source_vehicle(t)^-1

Source: DESIGN, sweep "ego-motion compensated"; ours.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque

import numpy as np

from stages.geometry.extrapolation import EXTRAPOLATION_S, LEAST_SPAN_NS, USUAL_MANEUVER, JumpGate, is_reachable
from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation, nearest_rotation, nearly_rotation
from stages.kernels.geometry.trajectory import STEP_NS, to_map, to_vehicle
from stages.messages import VehicleMotion

KEPT = 512
TOGETHER_NS = 10_000_000  # poses that arrived so soon after one another are no speed
STILL_NS = 700_000_000  # how the vehicle moves is known so long after its word: by pictures it comes 5 times a second
AFRESH_NS = 2_000_000_000  # in so long a silence an odometry may have been started afresh, and nothing tells
FURTHEST_NS = round(1e9 * EXTRAPOLATION_S)  # beyond the newest pose


class VehicleTrajectory:
    """T_map_vehicle over time: linear between two poses; a little beyond the newest as it went in the last 0.1 s."""

    def __init__(self, joined: bool = True) -> None:
        """`joined`: a start frame that jumped is laid on the one before; else another local frame begins."""
        self._joined, self._watch = joined, JumpGate()
        self._local_start: tuple[Array64, Array64] | None = None  # R, t; None: the local frame is the start frame
        self._poses: deque[tuple[int, Array64, Array64]] = deque(maxlen=KEPT)
        self._onward: tuple[Array64, Array64] | None = None  # see `_went`, since the newest pose
        self._begun_ns = 0  # poses before lie in another frame
        self._known: dict[int, tuple[Array64, Array64]] = {}  # asked since the newest pose: the same moments are, often

    @property
    def known(self) -> bool:
        """Whether the vehicle told its motion at all."""
        return bool(self._poses)

    def known_at(self, stamp_ns: int) -> bool:
        """Whether its newest word is not so old that it may be anywhere by now."""
        return bool(self._poses) and stamp_ns - self._poses[-1][0] < STILL_NS

    @property
    def newest_ns(self) -> int | None:
        """Time of its newest word."""
        return self._poses[-1][0] if self._poses else None

    def add(self, motion: VehicleMotion) -> bool:
        """One more pose. True: what was remembered in the local frame may lie elsewhere from now on.

        One that is not newer than the last is ignored, one that is not where those before lead is left out, until three
        agree: then the start frame is another one. That is laid on the old one, which is no more than a guess after a
        silence: an odometry started afresh in it may begin anywhere near, and nothing tells. Where frames are not
        joined, another begins, and so it does after each silence.
        """
        if not self._poses:
            self._append(motion)
            return not self._joined
        if motion.stamp_ns <= self._poses[-1][0]:
            return False
        heard = self._joined or self.known_at(motion.stamp_ns)
        poses = self._watch.add(motion, heard and self._is_reachable(motion))
        another = len(poses) > 1
        silent_ns = poses[0].stamp_ns - self._poses[-1][0] if poses else 0
        guessed = silent_ns >= AFRESH_NS or (another and silent_ns >= STILL_NS)
        elsewhere = guessed if self._joined else another
        if another:
            self._begin_anew(poses[0])
        for pose in poses:
            self._append(pose)
        return elsewhere

    def _is_reachable(self, motion: VehicleMotion) -> bool:
        """Whether a pose is where the ones before lead."""
        newest_ns, oldest_ns = self._poses[-1][0], max(self._poses[0][0], self._begun_ns)
        speed_known = newest_ns - oldest_ns >= TOGETHER_NS
        constant_velocity, seconds = self.constant_velocity(motion.stamp_ns), (motion.stamp_ns - newest_ns) * 1e-9
        speed_mps = float(np.linalg.norm(self._went()[1])) if speed_known else None
        return is_reachable(constant_velocity, self._local(motion), seconds, speed_mps)

    def _local(self, motion: VehicleMotion) -> tuple[Array64, Array64]:
        """A pose in the local frame."""
        if self._local_start is None:
            return motion.R_map_vehicle, motion.xyz_map_m
        R, t = self._local_start
        return R @ motion.R_map_vehicle, R @ motion.xyz_map_m + t

    def _append(self, motion: VehicleMotion) -> None:
        self._known.clear()
        self._onward = None
        self._poses.append((motion.stamp_ns, *self._local(motion)))

    def _begin_anew(self, first: VehicleMotion) -> None:
        """From this pose on the start frame is another one: how it went before says nothing."""
        if self._joined:
            R, t = self.at(first.stamp_ns)
            R_map_source = nearest_rotation(R @ first.R_map_vehicle.T)
            self._local_start = R_map_source, t - R_map_source @ first.xyz_map_m
        self._begun_ns = first.stamp_ns

    def at(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R_map_vehicle (3, 3) and t_map_vehicle (3,) [m]."""
        poses = self._poses
        if stamp_ns in self._known:
            return self._known[stamp_ns]
        if not poses:
            return np.eye(3), np.zeros(3)
        if len(poses) == 1 or stamp_ns <= poses[0][0]:
            return poses[0][1], poses[0][2]
        if len(self._known) >= KEPT:
            self._known.clear()
        if stamp_ns > poses[-1][0]:
            self._known[stamp_ns] = self._beyond(min(stamp_ns - poses[-1][0], FURTHEST_NS) * 1e-9)
            return self._known[stamp_ns]
        after = len(poses) - 1
        if stamp_ns < poses[-2][0]:  # of the newest step, mostly
            after = bisect_right(poses, stamp_ns, key=lambda pose: pose[0])
        (t0, R0, x0), (t1, R1, x1) = poses[after - 1], poses[after]
        share = (stamp_ns - t0) / (t1 - t0)
        # poses are milliseconds apart: the mean of the two, made a rotation again
        self._known[stamp_ns] = nearly_rotation(R0 + share * (R1 - R0)), x0 + share * (x1 - x0)
        return self._known[stamp_ns]

    def _beyond(self, seconds: float) -> tuple[Array64, Array64]:
        """R and t so long after the newest pose."""
        _, R, t = self._poses[-1]
        turn_radps, velocity_mps = self._went()
        return R @ exp_rotation(seconds * turn_radps), t + seconds * velocity_mps

    def _went(self) -> tuple[Array64, Array64]:
        """Turn (3,) [rad/s], own axes, and velocity (3,) [m/s] up to the newest pose; it stood, if nothing tells."""
        if self._onward is None:
            newest_ns, R, t = self._poses[-1]
            span_ns, R_then, t_then = TOGETHER_NS, R, t
            for then_ns, R_before, t_before in reversed(self._poses):
                if then_ns < self._begun_ns:
                    break
                if newest_ns - then_ns >= TOGETHER_NS:
                    span_ns, R_then, t_then = newest_ns - then_ns, R_before, t_before
                if span_ns >= LEAST_SPAN_NS:
                    break
            self._onward = log_rotation(R_then.T @ R) / (span_ns * 1e-9), (t - t_then) / (span_ns * 1e-9)
        return self._onward

    def in_current_frame(self, stamp_ns: int) -> bool:
        """Whether what `at` tells of a moment is in the frame that is told now."""
        return self._joined or stamp_ns >= self._begun_ns

    def at_in_current_frame(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R and t in the frame that is told now; before that began: straight back, as it goes in it."""
        if self.in_current_frame(stamp_ns):
            return self.at(stamp_ns)
        first_ns, R, t = next(pose for pose in self._poses if pose[0] >= self._begun_ns)
        turn_radps, velocity_mps = self._went()
        back_s = (stamp_ns - first_ns) * 1e-9
        return R @ exp_rotation(back_s * turn_radps), t + back_s * velocity_mps

    def rate_radps(self, stamp_ns: int) -> Array64:
        """How the vehicle turns (3,), its own axes; zero where nothing tells."""
        before, after = self.at(stamp_ns - STEP_NS // 2)[0], self.at(stamp_ns + STEP_NS // 2)[0]
        return log_rotation(before.T @ after) / (STEP_NS * 1e-9)

    def velocity_mps(self, stamp_ns: int) -> Array64:
        """The vehicle's own velocity (3,) in the local frame."""
        return (self.at(stamp_ns + STEP_NS)[1] - self.at(stamp_ns)[1]) / (STEP_NS * 1e-9)

    def constant_velocity(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R and t where the newest pose's speed and turn lead, however long that is ago: they end only in `at`."""
        return self._beyond((stamp_ns - self._poses[-1][0]) * 1e-9)

    def extrapolation_sigma(self, stamp_ns: int) -> tuple[float, float]:
        """One sigma of the place [m] and of the yaw [rad] that `at` tells beyond the newest pose, by what is not told.

        The vehicle may have changed as USUAL_MANEUVER says, and all its way from where the trail ends.
        """
        if not self._poses or stamp_ns <= self._poses[-1][0]:
            return 0.0, 0.0
        dt = (stamp_ns - self._poses[-1][0]) * 1e-9
        place_m, yaw_rad = USUAL_MANEUVER.displacement_m(dt), USUAL_MANEUVER.turn_rad(dt)
        beyond_s = dt - 1e-9 * FURTHEST_NS
        if beyond_s > 0.0:
            turn_radps, velocity_mps = self._went()
            place_m += beyond_s * float(np.linalg.norm(velocity_mps))
            yaw_rad += beyond_s * float(np.linalg.norm(turn_radps))
        return place_m, yaw_rad

    def to_vehicle(self, stamp_ns: int, xyz_m: Array64, velocity_mps: Array64) -> tuple[Array64, Array64]:
        """Place (3,) and velocity (3,) as the vehicle sees them at a time, its own driving and turning in them."""
        return to_vehicle(*self.at(stamp_ns), *self.at(stamp_ns + STEP_NS), xyz_m, velocity_mps)

    def to_map(self, stamp_ns: int, xyz_m: Array64, velocity_mps: Array64) -> tuple[Array64, Array64]:
        """The inverse of `to_vehicle`."""
        return to_map(*self.at(stamp_ns), *self.at(stamp_ns + STEP_NS), xyz_m, velocity_mps)

"""The vehicle's trail: where it was at each moment, so that what stands still in the world stands still in memory.

Frame local: the vehicle's own odometry frame (T_local_vehicle = T_start_vehicle). Without VehicleMotion it is the
vehicle's frame itself: right for a parked vehicle; then what stands still seems to move with a driving one.

Source: DESIGN, sweep "ego-motion compensated"; ours.
"""

from __future__ import annotations

from bisect import bisect_right
from collections import deque

import numpy as np

from stages.compiled import compiled
from stages.geometry import Array64
from stages.messages import VehicleMotion
from stages.rotation import exp_rotation, log_rotation, nearly_rotation
from stages.vehicle_onward import LEAST_SPAN_NS, TRAIL_S, USUAL

KEPT = 512
STEP_NS = 50_000_000  # over which a velocity is taken
TOGETHER_NS = 10_000_000  # poses that arrived so soon after one another are no speed
STILL_NS = 700_000_000  # how the vehicle moves is known so long after its word: by pictures it comes 5 times a second
FURTHEST_NS = round(1e9 * TRAIL_S)  # beyond the newest pose


class VehicleTrail:
    """T_local_vehicle over time: linear between two poses; a little beyond the newest as it went in the last 0.1 s."""

    def __init__(self) -> None:
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

    def add(self, motion: VehicleMotion) -> None:
        """One more pose; one that is not newer than the last is ignored."""
        if not self._poses or motion.stamp_ns > self._poses[-1][0]:
            self._known.clear()
            self._onward = None
            self._poses.append((motion.stamp_ns, motion.R_start_vehicle, motion.xyz_start_m))

    def begin_anew(self, stamp_ns: int) -> None:
        """From this pose on the local frame is another one: how it went before says nothing."""
        self._begun_ns, self._onward = stamp_ns, None

    def at(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R_local_vehicle (3, 3) and t_local_vehicle (3,) [m]."""
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

    def rate_radps(self, stamp_ns: int) -> Array64:
        """How the vehicle turns (3,), its own axes; zero where nothing tells."""
        before, after = self.at(stamp_ns - STEP_NS // 2)[0], self.at(stamp_ns + STEP_NS // 2)[0]
        return log_rotation(before.T @ after) / (STEP_NS * 1e-9)

    def velocity_mps(self, stamp_ns: int) -> Array64:
        """The vehicle's own velocity (3,) in the local frame."""
        return (self.at(stamp_ns + STEP_NS)[1] - self.at(stamp_ns)[1]) / (STEP_NS * 1e-9)

    def straight_on(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """R and t where the newest pose's speed and turn lead, however long that is ago: they end only in `at`."""
        return self._beyond((stamp_ns - self._poses[-1][0]) * 1e-9)

    def unsure(self, stamp_ns: int) -> tuple[float, float]:
        """One sigma of the place [m] and of the yaw [rad] that `at` tells beyond the newest pose, by what is not told.

        The vehicle may have changed as USUAL says, and all its way from where the trail ends.
        """
        if not self._poses or stamp_ns <= self._poses[-1][0]:
            return 0.0, 0.0
        dt = (stamp_ns - self._poses[-1][0]) * 1e-9
        place_m, yaw_rad = USUAL.place_m(dt), USUAL.turn_rad(dt)
        beyond_s = dt - 1e-9 * FURTHEST_NS
        if beyond_s > 0.0:
            turn_radps, velocity_mps = self._went()
            place_m += beyond_s * float(np.linalg.norm(velocity_mps))
            yaw_rad += beyond_s * float(np.linalg.norm(turn_radps))
        return place_m, yaw_rad

    def to_vehicle(self, stamp_ns: int, xyz_m: Array64, velocity_mps: Array64) -> tuple[Array64, Array64]:
        """Place (3,) and velocity (3,) as the vehicle sees them at a time, its own driving and turning in them."""
        return _to_vehicle(*self.at(stamp_ns), *self.at(stamp_ns + STEP_NS), xyz_m, velocity_mps)

    def to_local(self, stamp_ns: int, xyz_m: Array64, velocity_mps: Array64) -> tuple[Array64, Array64]:
        """The inverse of `to_vehicle`."""
        return _to_local(*self.at(stamp_ns), *self.at(stamp_ns + STEP_NS), xyz_m, velocity_mps)


@compiled
def _to_vehicle(
    R: Array64, t: Array64, R_then: Array64, t_then: Array64, xyz_m: Array64, velocity_mps: Array64
) -> tuple[Array64, Array64]:
    now = R.T @ (xyz_m - t)
    then = R_then.T @ (xyz_m + STEP_NS * 1e-9 * velocity_mps - t_then)
    return now, (then - now) / (STEP_NS * 1e-9)


@compiled
def _to_local(
    R: Array64, t: Array64, R_then: Array64, t_then: Array64, xyz_m: Array64, velocity_mps: Array64
) -> tuple[Array64, Array64]:
    now = R @ xyz_m + t
    then = R_then @ (xyz_m + STEP_NS * 1e-9 * velocity_mps) + t_then
    return now, (then - now) / (STEP_NS * 1e-9)

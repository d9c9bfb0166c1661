"""State of the pose with its reason, and detection of jumps.

    LOST            no position, or its sigma or age is beyond the limit
    POSITION_ONLY   the LiDAR measures the drone, its yaw is not known
    AMBIGUOUS       as before; a rotation is known up to a multiple of 90 deg, or two sources contradict each other
    FULL            position and rotation
    COASTING        the same without a recent LiDAR position: odometry propagates the pose

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.estimator import Estimator
from stages.fuse.pose_message import MapEstimate
from stages.fuse.settings import FuseLimits
from stages.heading.fused_heading import VP_ROTATION_NS
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import PoseState

JUMP_MPS2, JUMP_RAD_PER_S = 10.0, 4.0  # what a drone can do between two outputs


def state_of(
    known: MapEstimate | None, estimator: Estimator, limits: FuseLimits, now_ns: int, tracker: str, ambiguity: str
) -> tuple[PoseState, str]:
    """The state and its reason. `tracker`: reason of the tracker; `ambiguity`: why a rotation is not used, or empty."""
    e = estimator
    fix_ns = e.positions.fix_ns
    if known is None or fix_ns is None:
        if e.newest_fix_ns is None:
            return PoseState.LOST, tracker
        return PoseState.LOST, f"no LiDAR position for {(now_ns - e.newest_fix_ns) * 1e-9:.1f} s; {tracker}"
    age_s = (now_ns - fix_ns) * 1e-9
    worst_m = math.sqrt(float(np.linalg.eigvalsh(known.covariance[3:, 3:])[-1]))
    if age_s > limits.lost_after_s:
        return PoseState.LOST, f"no LiDAR position for {age_s:.1f} s"
    if not worst_m <= limits.lost_sigma_m:
        return PoseState.LOST, f"position known to {worst_m:.1f} m only, {age_s:.1f} s after the last by LiDAR"
    unseen = f"; no LiDAR position for {age_s:.1f} s" if age_s > limits.coast_after_s else ""
    if known.R_map_drone is None:
        if e.odometry_yaw.heading.contradiction:
            return PoseState.AMBIGUOUS, e.odometry_yaw.heading.contradiction + unseen
        if ambiguity:
            return PoseState.AMBIGUOUS, ambiguity + unseen
        if e.unverified and e.odometry_yaw.known(now_ns) is not None:
            return PoseState.POSITION_ONLY, f"found at another position: its motion is compared with odometry{unseen}"
        return PoseState.POSITION_ONLY, f"heading not known: {e.odometry_yaw.by_motion.reason}{unseen}"
    if unseen:
        return PoseState.COASTING, f"propagated by odometry{unseen}"
    return PoseState.FULL, _why_rotation(e)


def _why_rotation(estimator: Estimator) -> str:
    """Which sources give the rotation."""
    if estimator.from_vanishing_points:
        return "rotation by both cameras"
    vp_rotation_ns, seen = estimator.vp_rotation_ns, estimator.odometry_yaw.by_motion.reason
    cameras = vp_rotation_ns is not None and estimator.chain.back.stamp_ns - vp_rotation_ns < VP_ROTATION_NS
    return f"rotation by {'both cameras and ' if cameras else ''}the drone's motion; {seen}"


def unconfirmed_reason(estimator: Estimator, stamp_ns: int) -> str:
    """Why a RESOLVED rotation by vanishing points is not used, and what helps."""
    if not estimator.motions.map_is_fixed(stamp_ns):
        return "the rotation by vanishing points is not used: without the vehicle's motion no motion can confirm it"
    seen = estimator.odometry_yaw.by_motion.reason
    return f"the rotation by vanishing points needs the drone's motion to confirm it: fly some metres; {seen}"


class Jumps:
    """Counts jumps: poses far from the previous pose, propagated. The autopilot receives the count as resets."""

    def __init__(self, limits: FuseLimits) -> None:
        self._limits = limits
        self._last: MapEstimate | None = None
        self._reported_resets = 0
        self.number = 0

    def lost(self) -> None:
        """The pose is lost; the next one counts as a jump."""
        self.number += self._last is not None
        self._last = None

    def see(self, known: MapEstimate, resets: int) -> None:
        """Add a pose. `resets`: count of the estimator; jumps by a reset are not counted again."""
        last, reported = self._last, self._reported_resets
        self._last, self._reported_resets = known, resets
        if last is None or resets > reported:
            return
        dt = (known.stamp_ns - last.stamp_ns) * 1e-9
        off_m = float(np.linalg.norm(known.xyz_map_m - last.xyz_map_m - dt * last.velocity_map_mps))
        jumped = off_m > self._limits.jump_m + JUMP_MPS2 * dt**2
        if known.R_map_drone is not None and last.R_map_drone is not None:
            turned = float(np.linalg.norm(log_rotation(last.R_map_drone.T @ known.R_map_drone)))
            jumped |= turned > math.radians(self._limits.jump_deg) + JUMP_RAD_PER_S * dt
        self.number += jumped

"""State of the fused pose with its reason.

    LOST            no position, or its sigma or age is beyond the limit
    POSITION_ONLY   the LiDAR measures the drone, its yaw is not known
    AMBIGUOUS       as before; vanishing points give the rotation up to a multiple of 90 deg
    FULL            position and rotation
    COASTING        the same without a recent LiDAR position: the IMU propagates the pose

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.estimator import Estimator
from stages.fuse.pose_message import MapEstimate
from stages.fuse.settings import FuseLimits
from stages.heading.inertial_heading import DECIDED
from stages.messages import PoseState

RECENT_ROTATION_NS = 1_000_000_000


def state_of(
    known: MapEstimate | None, estimator: Estimator, limits: FuseLimits, now_ns: int, tracker: str
) -> tuple[PoseState, str]:
    """The state and its reason. `tracker`: the tracker's reason."""
    e = estimator
    if known is None or e.fix_ns is None:
        if e.newest_fix_ns is None:
            return PoseState.LOST, tracker
        return PoseState.LOST, f"no LiDAR position for {(now_ns - e.newest_fix_ns) * 1e-9:.1f} s; {tracker}"
    if e.suspect:
        return PoseState.LOST, "the tracked object does not move as the drone's IMU measures: is it another drone?"
    age_s = (now_ns - e.fix_ns) * 1e-9
    worst_m = math.sqrt(float(np.linalg.eigvalsh(known.covariance[3:, 3:])[-1]))
    if age_s > limits.lost_after_s:
        return PoseState.LOST, f"no LiDAR position for {age_s:.1f} s"
    if not worst_m <= limits.lost_sigma_m:
        return PoseState.LOST, f"position sigma {worst_m:.1f} m, {age_s:.1f} s after the last LiDAR position"
    unseen = f"; no LiDAR position for {age_s:.1f} s" if age_s > limits.coast_after_s else ""
    rotations = e.rotation_ns is not None and now_ns - e.rotation_ns < RECENT_ROTATION_NS
    if known.R_map_drone is None:
        state = PoseState.AMBIGUOUS if rotations else PoseState.POSITION_ONLY
        return state, f"heading not known: {undecided_reason(e, now_ns)}{unseen}"
    if unseen:
        return PoseState.COASTING, f"propagated by the IMU{unseen}"
    imu = e.imu.is_current(now_ns)
    source = ("vanishing points and IMU" if imu else "vanishing points") if rotations else "IMU and LiDAR positions"
    return PoseState.FULL, f"heading by {source}"


def undecided_reason(estimator: Estimator, now_ns: int) -> str:
    """Why the heading is not known."""
    e = estimator
    if not e.imu.is_current(now_ns) and e.rotation_ns is None:
        return "no IMU data: request RAW_IMU at 10 Hz or more"
    if e.decided:
        return "its sigma exceeds yaw_sigma_deg: accelerate sideways"
    if e.heading.near_probability > DECIDED and not e.is_own:
        return "not certain that the tracked object moves as the drone's IMU measures: accelerate sideways"
    return f"P(right yaw) {e.heading.near_probability:.3f}, needs {DECIDED} for 0.8 s: accelerate sideways"

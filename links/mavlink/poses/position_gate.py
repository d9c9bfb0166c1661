"""Gate and covariance of positions without yaw.

An autopilot that keeps its own yaw takes a position in its own axes, x towards its north. grd knows them relative to
`map` from the time when the autopilot's telemetry was independent (`RelativePose.odom_yaw_rad`); afterwards the yaw is
not measured, and stays the same until the pose jumps (`SentFrame`).

An error of that yaw, e, turns every acceleration against the one that the autopilot measures. Its EKF forgets over
about a second, so its position is off by about e times the way that the drone is accelerated in that time (LEVER_M).
This and the variation of its compass are added to the covariance. The distance from the origin does not matter: the
axes are constant, and the autopilot takes its position from them alone. They are turned against the true north by e.

Source: ours; ArduPilot NavEKF3 and PX4 EKF2 with position noise of 0.2 m and accelerometer noise of 0.35 m/s^2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from links.mavlink.poses.gate import PoseLimits, RejectReason, age_reason, reject_reason, yaw_reason
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.profiles import YawOutput
from stages.messages import PoseEstimate, PoseState, RelativePose

LEVER_M = 2.0  # displacement by 4 m/s^2 within a second
COMPASS_RAD = math.radians(3.0)  # variation of an autopilot's compass error in flight, one sigma
SYMMETRIC = 1e-6  # relative


class SentPosition(NamedTuple):
    """A position in the frame that it is sent in."""

    xyz_m: NDArray[np.float64]  # (3,)
    covariance_m2: NDArray[np.float64]  # (3, 3), with the error of the yaw


def position_reason(pose: RelativePose, now_ns: int, limits: PoseLimits) -> RejectReason | None:
    """Why the position must not be sent now; None: it may be sent."""
    estimate = pose.estimate
    if pose.state is PoseState.LOST:
        return RejectReason.LOST
    if estimate is None:
        return RejectReason.INCOMPLETE
    covariance = _covariance_map_m2(pose)
    if not (np.isfinite(estimate.xyz_map_m).all() and np.isfinite(covariance).all()):
        return RejectReason.NOT_FINITE
    eigenvalues = np.linalg.eigvalsh(covariance)
    symmetric = np.abs(covariance - covariance.T).max() <= SYMMETRIC * np.abs(covariance).max()
    if not symmetric or eigenvalues[0] <= 0:
        return RejectReason.INVALID_COVARIANCE
    if math.sqrt(eigenvalues[-1]) > limits.position_sigma_m:
        return RejectReason.POSITION_SIGMA
    yaw_rad, sigma_rad = pose.odom_yaw_rad, pose.odom_yaw_sigma_rad
    if yaw_rad is None or sigma_rad is None:
        return RejectReason.ODOM_YAW
    if not (math.isfinite(yaw_rad) and math.isfinite(sigma_rad)):
        return RejectReason.NOT_FINITE
    if math.degrees(sigma_rad) > limits.rotation_sigma_deg:
        return RejectReason.ODOM_YAW_SIGMA
    return age_reason(pose.stamp_ns, now_ns, limits)


def gate_reason(pose: RelativePose, now_ns: int, limits: PoseLimits, yaw: YawOutput) -> RejectReason | None:
    """Why ODOMETRY of the pose must not be sent now, by what it contains; None: it may be sent."""
    if yaw == "none":
        return position_reason(pose, now_ns, limits)
    return reject_reason(pose, now_ns, limits) or yaw_reason(pose, limits)


def sent_position(pose: RelativePose, frame: SentFrame) -> SentPosition:
    """The position in a frame with the autopilot's axes. Raises ValueError for a pose that the gate must reject."""
    if pose.estimate is None or pose.odom_yaw_sigma_rad is None:
        raise ValueError("no position in the autopilot's axes: the gate must reject it")
    R = frame.R_sent_map
    level_m2 = (pose.odom_yaw_sigma_rad**2 + COMPASS_RAD**2) * LEVER_M**2
    covariance = R @ _covariance_map_m2(pose) @ R.T + np.diag([level_m2, level_m2, 0.0])
    return SentPosition(frame.position(pose.estimate.xyz_map_m), covariance)


def position_quality_percent(pose: RelativePose, limits: PoseLimits) -> int:
    """Quality, 1 (at the limit) to 100 (sigma 0), linear in the larger ratio of a sigma to its limit."""
    if pose.estimate is None or pose.odom_yaw_sigma_rad is None:
        return 1
    position_m = math.sqrt(max(float(np.linalg.eigvalsh(_covariance_map_m2(pose))[-1]), 0.0))
    yaw = math.degrees(pose.odom_yaw_sigma_rad) / limits.rotation_sigma_deg
    return max(1, min(100, round(100 * (1 - max(position_m / limits.position_sigma_m, yaw)))))


def _covariance_map_m2(pose: RelativePose) -> NDArray[np.float64]:
    """(3, 3) of the position in map axes."""
    estimate = pose.estimate
    assert estimate is not None
    if isinstance(estimate, PoseEstimate):
        R = estimate.R_map_drone
        return R @ estimate.map_covariance[3:, 3:] @ R.T
    return estimate.covariance_map_m2

"""Gate of poses to the autopilot: a pose that could cause a wrong flight is rejected with a reason.

This gate is of poses with rotation: LANDING_TARGET, which contains the vehicle's position in the drone's axes, and
poses with a measured yaw. Positions without yaw: `position_gate.py`. An autopilot arms with a pose that has a wrong
yaw branch (90 deg) and crashes, so an unresolved branch is rejected regardless of its covariance. The rotation sigma is
the largest about any axis: the autopilot takes roll and pitch from its own gyros, but an uncertain tilt indicates an
invalid rotation.

Source: ours; what ArduPilot and PX4 accept: `profiles.py`.
"""

from __future__ import annotations

import enum
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from flow.stage import StrictModel
from stages.messages import PoseEstimate, PoseState, RelativePose

MAX_AHEAD_NS = 50_000_000  # a pose further in the future has another clock
SENDABLE = (PoseState.FULL, PoseState.COASTING)
ROTATION_ERROR = 1e-6  # limit of |R^T R - 1|


class RejectReason(enum.Enum):
    """Why a pose is not sent; the value is the text in counters and STATUSTEXT."""

    LOST = "no position"
    POSITION_ONLY = "rotation unknown"
    AMBIGUOUS = "ambiguous rotation"
    INCOMPLETE = "pose without rotation or covariance"
    NOT_FINITE = "not finite"
    INVALID_ROTATION = "invalid rotation matrix"
    INVALID_COVARIANCE = "invalid covariance"
    POSITION_SIGMA = "position sigma too large"
    ROTATION_SIGMA = "rotation sigma too large"
    OLD = "pose too old"
    FUTURE = "pose from the future"
    NOT_NEWER = "not newer than the last sent pose"
    AUTOPILOT_SILENT = "autopilot silent"
    LINK_LATE = "link too slow"
    YAW_NOT_MEASURED = "yaw not measured"
    ODOM_YAW = "yaw of autopilot's axes unknown"
    ODOM_YAW_SIGMA = "yaw of autopilot's axes uncertain"
    ODOM_YAW_RESET = "autopilot reset its yaw"
    COMPASS = "autopilot's compass is wrong"
    REJECTED_BY_AUTOPILOT = "autopilot rejects the pose"
    NO_ATTITUDE = "no attitude from autopilot"


class PoseLimits(StrictModel):
    """Limits for sending a pose: one sigma of the worst axis, and age."""

    position_sigma_m: float = Field(default=0.35, gt=0, le=5)  # 95 % are within 2.8 sigma, 1 m
    rotation_sigma_deg: float = Field(default=5.0, gt=0, le=15)  # for positions without yaw: that of their axes
    rotation_age_s: float = Field(default=2.0, gt=0, le=10)  # of the measured rotation, for poses with yaw
    age_s: float = Field(default=0.15, gt=0, le=0.3)  # of the pose at the time of sending


def reject_reason(pose: RelativePose, now_ns: int, limits: PoseLimits) -> RejectReason | None:
    """Why the pose must not be sent now; None: it may be sent."""
    if pose.state not in SENDABLE:
        return RejectReason[pose.state.name]
    estimate = pose.estimate
    if not isinstance(estimate, PoseEstimate):
        return RejectReason.INCOMPLETE
    rotations = estimate.R_vehicle_drone, estimate.R_map_drone
    vectors = (estimate.xyz_vehicle_m, estimate.xyz_map_m, *rotations, estimate.covariance, estimate.map_covariance)
    if not np.isfinite(np.concatenate([vector.ravel() for vector in vectors])).all():
        return RejectReason.NOT_FINITE
    if not all([_is_rotation(R) for R in rotations]):
        return RejectReason.INVALID_ROTATION
    worst = worst_sigmas(estimate)
    if worst is None:
        return RejectReason.INVALID_COVARIANCE
    rotation_rad, position_m = worst
    if position_m > limits.position_sigma_m:
        return RejectReason.POSITION_SIGMA
    if math.degrees(rotation_rad) > limits.rotation_sigma_deg:
        return RejectReason.ROTATION_SIGMA
    return age_reason(pose.stamp_ns, now_ns, limits)


def yaw_reason(pose: RelativePose, limits: PoseLimits) -> RejectReason | None:
    """Why the yaw of a pose must not be sent; None: it was measured recently, without the autopilot."""
    measured_ns = pose.rotation_ns
    old = measured_ns is None or pose.stamp_ns - measured_ns > 1e9 * limits.rotation_age_s
    return RejectReason.YAW_NOT_MEASURED if old else None


def age_reason(stamp_ns: int, now_ns: int, limits: PoseLimits) -> RejectReason | None:
    """Why a pose of this time must not be sent now."""
    age_ns = now_ns - stamp_ns
    if age_ns > 1e9 * limits.age_s:
        return RejectReason.OLD
    return RejectReason.FUTURE if age_ns < -MAX_AHEAD_NS else None


@lru_cache(maxsize=1)  # used by the gate and for the message's quality
def worst_sigmas(pose: PoseEstimate) -> tuple[float, float] | None:
    """`pose_sigmas` of both covariances of a pose; None: one is invalid."""
    return pose_sigmas(pose.covariance, pose.map_covariance)


def pose_sigmas(*covariances: NDArray[np.float64]) -> tuple[float, float] | None:
    """(rotation [rad], position [m]): the largest sigma in any direction; None: an invalid covariance.

    A covariance with a zero variance is invalid: no estimate is exact, and an autopilot would trust it fully.
    """
    C = np.array(covariances)  # (n, 6, 6)
    if not _is_symmetric(C):
        return None
    eigenvalues = np.linalg.eigvalsh(C)
    if (eigenvalues[:, 0] < -1e-9 * eigenvalues[:, -1]).any() or (np.diagonal(C, axis1=1, axis2=2) <= 0).any():
        return None
    blocks = np.concatenate([C[:, :3, :3], C[:, 3:, 3:]])
    worst = np.linalg.eigvalsh(blocks)[:, -1].tolist()
    return math.sqrt(max(worst[: len(C)])), math.sqrt(max(worst[len(C) :]))


def _is_symmetric(covariances: NDArray[np.float64]) -> bool:
    """Whether matrices (..., n, n) are symmetric within 1e-6 relative."""
    turned = np.swapaxes(covariances, -1, -2)
    return bool((np.abs(covariances - turned) <= 1e-12 + 1e-6 * np.abs(turned)).all())


def _is_rotation(R: NDArray[np.float64]) -> bool:
    """Whether |R| <= 1, R^T R = 1 and det R > 0, by the rotation's columns x, y, z."""
    (x0, y0, z0), (x1, y1, z1), (x2, y2, z2) = R.tolist()
    if max(map(abs, (x0, y0, z0, x1, y1, z1, x2, y2, z2))) > 1.0 + ROTATION_ERROR:
        return False
    products = (
        x0 * x0 + x1 * x1 + x2 * x2 - 1.0,
        y0 * y0 + y1 * y1 + y2 * y2 - 1.0,
        z0 * z0 + z1 * z1 + z2 * z2 - 1.0,
        x0 * y0 + x1 * y1 + x2 * y2,
        x0 * z0 + x1 * z1 + x2 * z2,
        y0 * z0 + y1 * z1 + y2 * z2,
    )
    determinant = x0 * (y1 * z2 - z1 * y2) - y0 * (x1 * z2 - z1 * x2) + z0 * (x1 * y2 - y1 * x2)
    return max(map(abs, products)) < ROTATION_ERROR and determinant > 0

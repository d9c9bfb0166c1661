"""Whether a pose may go to the autopilot: everything that would make it fly wrong is a refusal with its reason.

All messages need the rotation, LANDING_TARGET too: it tells the vehicle's place in the drone's own axes. So nothing
goes out of a position alone. A pose that is a quarter turn wrong arms happily and crashes, so an unresolved branch is
refused whatever its covariance says. The rotation's sigma is the worst about any axis: the autopilot takes roll and
pitch from its own gyros, but a tilt that is not known is a sign that nothing is.

Source: ours; what ArduPilot and PX4 believe: `profiles.py`.
"""

from __future__ import annotations

import enum
import math
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from stages.messages import PoseEstimate, PoseState, RelativePose

AHEAD_NS = 50_000_000  # a pose predicted further ahead than this has another clock than ours
SENDABLE = (PoseState.FULL, PoseState.COASTING)
ROTATION_ERROR = 1e-6  # of R^T R - 1


class Refusal(enum.Enum):
    """Why a pose does not go out, for counters and people."""

    LOST = "no position"
    POSITION_ONLY = "rotation not known"
    AMBIGUOUS = "ambiguous rotation"
    INCOMPLETE = "pose without rotation or covariance"
    NOT_FINITE = "not finite"
    NO_ROTATION = "its rotation is none"
    COVARIANCE = "its covariance is none"
    POSITION_SIGMA = "position too uncertain"
    ROTATION_SIGMA = "rotation too uncertain"
    OLD = "too old"
    AHEAD = "from the future"
    NOT_NEWER = "not newer than the one before"
    NOT_HEARD = "autopilot not heard"
    LINE_LATE = "line too slow"


class Limits(BaseModel):
    """How good a pose must be to go out. One sigma, worst axis."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    position_sigma_m: float = Field(default=0.35, gt=0, le=5)  # 95 % are within 2.8 sigma, 1 m
    rotation_sigma_deg: float = Field(default=5.0, gt=0, le=15)
    velocity_sigma_mps: float = Field(default=0.5, gt=0, le=5)  # beyond it the pose goes out without velocity
    age_s: float = Field(default=0.15, gt=0, le=0.3)  # of the pose when it is to go out


def refusal(pose: RelativePose, now_ns: int, limits: Limits) -> Refusal | None:
    """Why the pose may not go out now; None: it may."""
    if pose.state not in SENDABLE:
        return Refusal[pose.state.name]
    estimate = pose.estimate
    if not isinstance(estimate, PoseEstimate):
        return Refusal.INCOMPLETE
    rotations = estimate.R_vehicle_drone, estimate.R_map_drone
    vectors = (estimate.xyz_vehicle_m, estimate.xyz_map_m, *rotations, estimate.covariance, estimate.map_covariance)
    if not np.isfinite(np.concatenate([vector.ravel() for vector in vectors])).all():
        return Refusal.NOT_FINITE
    if not all([_is_rotation(R) for R in rotations]):
        return Refusal.NO_ROTATION
    worst = worst_sigmas(estimate)
    if worst is None:
        return Refusal.COVARIANCE
    rotation_rad, position_m = worst
    if position_m > limits.position_sigma_m:
        return Refusal.POSITION_SIGMA
    if math.degrees(rotation_rad) > limits.rotation_sigma_deg:
        return Refusal.ROTATION_SIGMA
    age_ns = now_ns - pose.stamp_ns
    if age_ns > 1e9 * limits.age_s:
        return Refusal.OLD
    return Refusal.AHEAD if age_ns < -AHEAD_NS else None


@lru_cache(maxsize=1)  # the gate asks, and the message tells its quality
def worst_sigmas(pose: PoseEstimate) -> tuple[float, float] | None:
    """`pose_sigmas` of both covariances of a pose; None: one is not a covariance."""
    return pose_sigmas(pose.covariance, pose.map_covariance)


def pose_sigmas(*covariances: NDArray[np.float64]) -> tuple[float, float] | None:
    """(rotation [rad], position [m]): the worst sigma in any direction; None: one is no covariance.

    A covariance of zeros is none: nothing is known exactly, and an autopilot would believe it.
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


def velocity_to_send(pose: PoseEstimate, limits: Limits) -> NDArray[np.float64] | None:
    """The drone's velocity over ground, map axes, where it is known well enough; None: it goes out as not known."""
    velocity, covariance = pose.velocity_map_mps, pose.velocity_covariance
    if not (np.isfinite(velocity).all() and np.isfinite(covariance).all()):
        return None
    if min(np.diagonal(covariance).tolist()) <= 0 or not _is_symmetric(covariance):
        return None
    eigenvalues = np.linalg.eigvalsh(covariance)
    good = eigenvalues[0] >= 0 and math.sqrt(eigenvalues[-1]) <= limits.velocity_sigma_mps
    return velocity if good else None


def _is_symmetric(covariances: NDArray[np.float64]) -> bool:
    """Whether matrices (..., n, n) are, to a millionth."""
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

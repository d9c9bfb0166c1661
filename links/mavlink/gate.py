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

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from stages.messages import PoseState, RelativePose

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
    vectors = (pose.xyz_vehicle_m, pose.R_vehicle_drone, pose.xyz_start_m, pose.R_start_drone)
    covariances = (pose.covariance, pose.start_covariance)
    if any(v is None for v in (*vectors, *covariances)):
        return Refusal.INCOMPLETE
    if not all(np.isfinite(v).all() for v in (*vectors, *covariances) if v is not None):
        return Refusal.NOT_FINITE
    if not all(_is_rotation(R) for R in (pose.R_vehicle_drone, pose.R_start_drone) if R is not None):
        return Refusal.NO_ROTATION
    worst = np.zeros(2)
    for covariance in covariances:
        sigmas = pose_sigmas(covariance) if covariance is not None else None
        if sigmas is None:
            return Refusal.COVARIANCE
        worst = np.maximum(worst, sigmas)
    if worst[1] > limits.position_sigma_m:
        return Refusal.POSITION_SIGMA
    if math.degrees(worst[0]) > limits.rotation_sigma_deg:
        return Refusal.ROTATION_SIGMA
    age_ns = now_ns - pose.stamp_ns
    if age_ns > 1e9 * limits.age_s:
        return Refusal.OLD
    return Refusal.AHEAD if age_ns < -AHEAD_NS else None


def pose_sigmas(covariance: NDArray[np.float64]) -> tuple[float, float] | None:
    """(rotation [rad], position [m]): the worst sigma in any direction; None: it is no covariance.

    A covariance of zeros is none: nothing is known exactly, and an autopilot would believe it.
    """
    if not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12):
        return None
    eigenvalues = np.linalg.eigvalsh(covariance)
    if eigenvalues[0] < -1e-9 * eigenvalues[-1] or (np.diagonal(covariance) <= 0).any():
        return None
    rotation, position = (np.linalg.eigvalsh(block)[-1] for block in (covariance[:3, :3], covariance[3:, 3:]))
    return math.sqrt(rotation), math.sqrt(position)


def velocity_to_send(pose: RelativePose, limits: Limits) -> NDArray[np.float64] | None:
    """The drone's velocity over ground, start axes, where it is known well enough; None: it goes out as not known."""
    velocity, covariance = pose.velocity_start_mps, pose.velocity_covariance
    if velocity is None or covariance is None or not (np.isfinite(velocity).all() and np.isfinite(covariance).all()):
        return None
    if (np.diagonal(covariance) <= 0).any() or not np.allclose(covariance, covariance.T, rtol=1e-6, atol=1e-12):
        return None
    eigenvalues = np.linalg.eigvalsh(covariance)
    good = eigenvalues[0] >= 0 and math.sqrt(eigenvalues[-1]) <= limits.velocity_sigma_mps
    return velocity if good else None


def _is_rotation(R: NDArray[np.float64]) -> bool:
    if np.abs(R).max() > 1.0 + ROTATION_ERROR:
        return False
    return bool(np.abs(R.T @ R - np.eye(3)).max() < ROTATION_ERROR and np.linalg.det(R) > 0)

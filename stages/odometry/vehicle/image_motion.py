"""Motion steps of the vehicle's camera, and the pose and covariance that they accumulate.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Self

import numpy as np

from stages.geometry.frames import Array64, transform
from stages.geometry.se3 import adjoint, composed_covariance
from stages.odometry.vehicle.scale import Length

MANY = 12  # features


@dataclass(frozen=True, slots=True)
class Pose6:
    """Pose T_start_body of the camera or of the vehicle, with covariance as in stages/geometry/se3.py."""

    R: Array64
    p: Array64  # [m]
    covariance: Array64  # (6, 6) of phi in R exp(phi) and rho in p + R rho

    @classmethod
    def start(cls) -> Self:
        """The identity with zero covariance."""
        return cls(np.eye(3), np.zeros(3), np.zeros((6, 6)))


@dataclass(frozen=True, slots=True)
class Step:
    """Motion T_key_now of the camera since the keyframe: p_key = R p_now + t."""

    R: Array64
    t: Array64  # [m]
    turn_rad2: Array64  # (3, 3) of phi in R exp(phi)
    spread_m2: Array64  # (3, 3) of t, keyframe axes
    standing: bool


def after(at: Pose6, step: Step) -> Pose6:
    """The pose after a step, T T_step, and its covariance."""
    Q = np.zeros((6, 6))
    Q[:3, :3], Q[3:, 3:] = step.turn_rad2, step.R.T @ step.spread_m2 @ step.R
    return Pose6(at.R @ step.R, at.p + at.R @ step.t, composed_covariance(at.covariance, step.R, step.t, Q))


def is_plausible(found: Length, expected: Length) -> bool:
    """Whether a measured length is accepted: with MANY features always, with fewer if it matches the last speed."""
    return found.features >= MANY or abs(found.m - expected.m) < 3.0 * math.hypot(found.sigma_m, expected.sigma_m)


def vehicle_pose(at: Pose6, T_vehicle_camera: Array64) -> Pose6:
    """Vehicle pose M T M^-1 of a camera pose T, M = T_vehicle_camera, and its covariance Ad(M) P Ad(M)^T."""
    M = T_vehicle_camera
    T = M @ transform(at.R, at.p) @ np.linalg.inv(M)
    A = adjoint(M[:3, :3], M[:3, 3])
    return Pose6(T[:3, :3].copy(), T[:3, 3].copy(), A @ at.covariance @ A.T)

"""One step of the vehicle's camera and how its uncertainty adds up. Covariances: stages/geometry/se3.py.

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
    """T_start_body: of the camera, or of what carries it."""

    R: Array64
    p: Array64  # [m]
    covariance: Array64  # (6, 6) of phi in R exp(phi) and rho in p + R rho

    @classmethod
    def start(cls) -> Self:
        """Where it all began."""
        return cls(np.eye(3), np.zeros(3), np.zeros((6, 6)))


@dataclass(frozen=True, slots=True)
class Step:
    """T_key_now of the camera: p_key = R p_now + t."""

    R: Array64
    t: Array64  # [m]
    turn_rad2: Array64  # (3, 3) of phi in R exp(phi)
    spread_m2: Array64  # (3, 3) of t, the key's axes
    standing: bool


def after(at: Pose6, step: Step) -> Pose6:
    """T T_step and its covariance."""
    Q = np.zeros((6, 6))
    Q[:3, :3], Q[3:, 3:] = step.turn_rad2, step.R.T @ step.spread_m2 @ step.R
    return Pose6(at.R @ step.R, at.p + at.R @ step.t, composed_covariance(at.covariance, step.R, step.t, Q))


def believable(found: Length, expected: Length) -> bool:
    """A dozen features are; fewer only where the vehicle can have come by its last speed."""
    return found.features >= MANY or abs(found.m - expected.m) < 3.0 * math.hypot(found.sigma_m, expected.sigma_m)


def carrier_pose(at: Pose6, T_mount_camera: Array64) -> Pose6:
    """T_start_carrier = M T_map_camera M^-1 with M = T_mount_camera, and its covariance Ad(M) P Ad(M)^T."""
    M = T_mount_camera
    T = M @ transform(at.R, at.p) @ np.linalg.inv(M)
    A = adjoint(M[:3, :3], M[:3, 3])
    return Pose6(T[:3, :3].copy(), T[:3, 3].copy(), A @ at.covariance @ A.T)

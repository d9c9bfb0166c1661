"""Covariances of rigid transforms (R, t): rotation before translation, tangent at the body, T exp(xi).

Source: Sola, Deray, Atchuthan, A micro Lie theory (2018), III.C; ours.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import hat

CHI2_999_2, CHI2_999_3 = 13.82, 16.27  # 99.9 % quantiles of chi-square with 2 and 3 degrees of freedom


def adjoint(R: Array64, t: Array64) -> Array64:
    """Adjoint (6, 6) of the transform (R, t), rotation first: [[R, 0], [[t]x R, R]]."""
    A = np.zeros((6, 6))
    A[:3, :3], A[3:, 3:], A[3:, :3] = R, R, hat(np.ascontiguousarray(t)) @ R
    return A


def composed_covariance(P: Array64, R_step: Array64, t_step_m: Array64, Q: Array64) -> Array64:
    """Covariance (6, 6) of T D: Ad(D^-1) P Ad(D^-1)^T + Q, where T has covariance P and D = (R, t) has Q."""
    A = np.zeros((6, 6))
    A[:3, :3] = R_step.T
    A[3:, 3:] = R_step.T
    A[3:, :3] = -R_step.T @ hat(t_step_m)
    moved = A @ P @ A.T + Q
    return 0.5 * (moved + moved.T)


def mahalanobis2(e: Array64, S: Array64) -> float:
    """Squared Mahalanobis distance e^T S^-1 e: chi-square distributed where S is the covariance of e."""
    return float(e @ np.linalg.solve(S, e))


def is_covariance(P: Array64) -> bool:
    """Whether a matrix is finite, symmetric and positive definite."""
    if not np.isfinite(P).all() or np.abs(P - P.T).max() > 1e-6 * np.abs(P).max():
        return False
    return bool(np.linalg.eigvalsh(P)[0] > 0)

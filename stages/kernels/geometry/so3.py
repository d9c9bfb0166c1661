"""Compiled functions for rotations: exponential, logarithm and the nearest rotation to a matrix.

Source: Rodrigues' formula; Sola, Deray, Atchuthan, A micro Lie theory (2018), appendix B. In R exp(phi), phi is
in the child axes of R.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled, compiled_at_once

SMALL_RAD = 1e-7
NEARLY = 0.2  # largest deviation of M^T M from 1 from which Newton's iteration converges
NEWTON_STEPS = 6


@compiled
def hat(v: Array64) -> Array64:
    """[v]x (3, 3): hat(v) @ w = v x w."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


@compiled
def exp_rotation(phi_rad: Array64) -> Array64:
    """Rotation (3, 3) of a rotation vector phi (3,) [rad]: I + sin(a)/a [phi]x + (1 - cos(a))/a^2 [phi]x^2."""
    angle = math.sqrt(phi_rad[0] ** 2 + phi_rad[1] ** 2 + phi_rad[2] ** 2)
    K = hat(phi_rad)
    if angle < SMALL_RAD:
        return np.eye(3) + K
    return np.eye(3) + math.sin(angle) / angle * K + (1.0 - math.cos(angle)) / angle**2 * (K @ K)


@compiled
def log_rotation(R: Array64) -> Array64:
    """Rotation vector phi (3,) of R = exp(phi), length in [0, pi]; by the quaternion, stable at both ends."""
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    q = np.empty(4)
    if trace > 0.0:
        s = 2.0 * math.sqrt(1.0 + trace)
        q[3] = 0.25 * s
        q[0], q[1], q[2] = (R[2, 1] - R[1, 2]) / s, (R[0, 2] - R[2, 0]) / s, (R[1, 0] - R[0, 1]) / s
    else:
        i = 0
        for axis in range(1, 3):
            if R[axis, axis] > R[i, i]:
                i = axis
        j, k = (i + 1) % 3, (i + 2) % 3
        s = 2.0 * math.sqrt(max(1.0 + R[i, i] - R[j, j] - R[k, k], 0.0))
        q[i] = 0.25 * s
        q[j], q[k], q[3] = (R[j, i] + R[i, j]) / s, (R[k, i] + R[i, k]) / s, (R[k, j] - R[j, k]) / s
    across = math.sqrt(q[0] ** 2 + q[1] ** 2 + q[2] ** 2)
    if across < SMALL_RAD:
        return 2.0 * q[:3] * (1.0 if q[3] > 0.0 else -1.0)
    angle = 2.0 * math.atan2(across, abs(q[3]))
    return q[:3] * (angle / across * (1.0 if q[3] >= 0.0 else -1.0))


@compiled
def nearest_rotation(M: Array64) -> Array64:
    """The rotation (3, 3) nearest to a matrix in the sum of squares: U diag(1, 1, det) V^T."""
    u, _, vt = np.linalg.svd(M)
    if np.linalg.det(u) * np.linalg.det(vt) < 0.0:
        u[:, 2] = -u[:, 2]
    return u @ vt


@compiled_at_once("(float64[:, ::1],)")
def nearly_rotation(M: Array64) -> Array64:
    """`nearest_rotation` by Newton's iteration, 100 times faster, where M is nearly a rotation.

    Source: Higham, Functions of Matrices (2008), 8.3.
    """
    R, gram, step = M.copy(), np.empty((3, 3)), np.empty((3, 3))
    for k in range(NEWTON_STEPS):
        for i in range(3):
            for j in range(3):
                gram[i, j] = R[0, i] * R[0, j] + R[1, i] * R[1, j] + R[2, i] * R[2, j]
        if k == 0 and not np.abs(gram - np.eye(3)).max() < NEARLY:
            return nearest_rotation(M)
        for i in range(3):
            for j in range(3):
                step[i, j] = 1.5 * R[i, j] - 0.5 * (R[i, 0] * gram[0, j] + R[i, 1] * gram[1, j] + R[i, 2] * gram[2, j])
        R[:] = step
    return R

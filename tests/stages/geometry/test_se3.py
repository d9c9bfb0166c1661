"""Covariances of rigid motions: by formula, and against sampled poses."""

from __future__ import annotations

import numpy as np

from stages.geometry.se3 import adjoint, composed_covariance
from stages.kernels.geometry.so3 import exp_rotation, hat, log_rotation


def test_the_adjoint_is_as_printed():
    R, t = exp_rotation(np.array([0.3, 0.0, 0.1])), np.array([1.0, -2.0, 0.5])
    A = adjoint(R, t)
    np.testing.assert_allclose(A[3:, :3], hat(t) @ R)
    np.testing.assert_allclose(A @ adjoint(R.T, -R.T @ t), np.eye(6), atol=1e-12)


def test_a_composed_covariance_uses_the_adjoint_of_the_inverse():
    P, Q = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0]), 0.1 * np.eye(6)
    R, t = exp_rotation(np.array([0.3, 0.0, 0.1])), np.array([1.0, -2.0, 0.5])
    A = adjoint(R.T, -R.T @ t)
    np.testing.assert_allclose(composed_covariance(P, R, t, Q), A @ P @ A.T + Q, atol=1e-12)


def test_a_composed_covariance_is_that_of_sampled_poses():
    rng = np.random.default_rng(5)
    P, Q = np.diag([0.02, 0.01, 0.03, 0.1, 0.2, 0.05]) ** 2, np.diag([0.01] * 3 + [0.05] * 3) ** 2
    R_step, t_step = exp_rotation(np.array([0.1, -0.4, 0.8])), np.array([2.0, -1.0, 0.5])
    off = []
    for _ in range(4000):
        a, b = rng.multivariate_normal(np.zeros(6), P), rng.multivariate_normal(np.zeros(6), Q)
        R = exp_rotation(a[:3]) @ R_step
        x = a[3:] + exp_rotation(a[:3]) @ t_step
        off.append(np.concatenate([log_rotation(R_step.T @ R @ exp_rotation(b[:3])), R_step.T @ (x - t_step) + b[3:]]))
    assert np.allclose(np.cov(np.array(off).T), composed_covariance(P, R_step, t_step, Q), atol=2e-3)

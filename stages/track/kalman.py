"""Kalman filter of a drone's position and velocity in frame map, updated by the posterior of a scan pass.

    x = (p, v),  p' = p + dt v,  white acceleration of density q on each axis        [m, m/s, m^2/s^3]

A scan pass gives mean m and covariance S' of a projection y = H p. `condition` moves the state to them:
x + K (m - y), P - K (S - S') K^T with K = P H^T S^-1, where S is the covariance of y before.

Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.2; ours.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.track.scan_pass import forward_kernel


def predicted(x: Array64, P: Array64, dt_s: float, q: float) -> tuple[Array64, Array64]:
    """State (6,) and covariance (6, 6) after dt_s."""
    dt = abs(dt_s)
    return forward_kernel(x, P, dt_s, q * dt**3 / 3, q * dt**2 / 2, q * dt)


def condition(x: Array64, P: Array64, H: Array64, change: Array64, S_after: Array64) -> tuple[Array64, Array64]:
    """State and covariance after y = H p, H (k, 3), moved by `change` (k,) and got the covariance S_after (k, k)."""
    wide = np.zeros((H.shape[0], 6))
    wide[:, :3] = H
    S = wide @ P @ wide.T
    K = np.linalg.solve(S, wide @ P).T
    after = P - K @ (S - S_after) @ K.T
    return x + K @ change, 0.5 * (after + after.T)


def measured(x: Array64, P: Array64, h: Array64, residual: float, sigma: float) -> tuple[Array64, Array64]:
    """State and covariance after a scalar measurement of h . p with this residual and noise sigma."""
    wide = np.concatenate([h, np.zeros(3)])
    S = float(wide @ P @ wide) + sigma**2
    K = P @ wide / S
    left = np.eye(6) - np.outer(K, wide)
    return x + K * residual, left @ P @ left.T + sigma**2 * np.outer(K, K)

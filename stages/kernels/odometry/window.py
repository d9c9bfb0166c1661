"""Compiled functions that triangulate features and solve the windowed bundle adjustment.

Source: see `stages/odometry/vehicle/window.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.geometry.so3 import exp_rotation, hat

HELD = 2
ROUNDS = 8
CAUCHY = 2.385
CONVERGED = 1e-6
Indices = NDArray[np.int64]


@compiled
def triangulated(
    R: Array64,
    p: Array64,
    obs_key: Indices,
    obs_feature: Indices,
    obs_ray: Array64,
    anchor: Indices,
    anchor_ray: Array64,
) -> Array64:
    """Inverse depths (m,) along the first ray: least squares of x' x (R_j^T (R_a x + q (p_a - p_j))) = 0."""
    m = len(anchor)
    up, down = np.zeros(m), np.full(m, 1e-12)
    for i in range(len(obs_key)):
        f, j = obs_feature[i], obs_key[i]
        a = anchor[f]
        if j == a:
            continue
        y = R[j].T @ (R[a] @ anchor_ray[f])
        base = R[j].T @ (p[a] - p[j])
        c, d = np.cross(obs_ray[i], y), np.cross(obs_ray[i], base)
        up[f] -= c @ d
        down[f] += d @ d
    return np.maximum(up / down, 1e-4)


@compiled
def _add_observations(
    Rs: Array64,
    p: Array64,
    q: Array64,
    obs_key: Indices,
    obs_feature: Indices,
    obs_ray: Array64,
    frames: Array64,
    anchor: Indices,
    anchor_ray: Array64,
    sigma: float,
    H: Array64,
    g: Array64,
    cross: Array64,
    own: Array64,
    pull: Array64,
) -> None:
    """Add each observation to the normal equations of poses (H, g), depths (own, pull) and both (cross)."""
    free = len(g)
    for i in range(len(obs_key)):
        f, j = obs_feature[i], obs_key[i]
        a = anchor[f]
        if j == a:
            continue
        Rja = Rs[j].T @ Rs[a]
        base = Rs[j].T @ (p[a] - p[j])
        z = Rja @ anchor_ray[f] + q[f] * base
        length = math.sqrt(z @ z)
        u = z / length
        if u @ obs_ray[i] < 0.9:
            continue
        P = np.ascontiguousarray(frames[i].T) @ (np.eye(3) - np.outer(u, u)) / (length * sigma)
        r = np.ascontiguousarray(frames[i].T) @ u / sigma
        weight = 1.0 / (1.0 + (r @ r) / (CAUCHY * CAUCHY))
        Jq = P @ base
        own[f] += weight * (Jq @ Jq)
        pull[f] += weight * (Jq @ r)
        J = np.zeros((2, free))
        if j >= HELD:
            k = 6 * (j - HELD)
            J[:, k : k + 3] = P @ hat(z)
            J[:, k + 3 : k + 6] = -q[f] * P
        if a >= HELD:
            k = 6 * (a - HELD)
            J[:, k : k + 3] = -P @ Rja @ hat(anchor_ray[f])
            J[:, k + 3 : k + 6] = q[f] * P @ Rja
        for row in range(2):
            for c in range(free):
                if J[row, c] != 0.0:
                    g[c] += weight * J[row, c] * r[row]
                    cross[f, c] += weight * J[row, c] * Jq[row]
                    for d in range(free):
                        H[c, d] += weight * J[row, c] * J[row, d]


@compiled
def _eliminate_depths(
    q: Array64, lidar: Array64, H: Array64, g: Array64, cross: Array64, own: Array64, pull: Array64
) -> None:
    """Add the depths that the LiDAR measured, and reduce H and g to the poses (Schur complement)."""
    m, free = len(q), len(g)
    for f in range(m):
        if not math.isnan(lidar[f, 0]):
            off = (q[f] - lidar[f, 0]) / lidar[f, 1]
            weight = 1.0 / (1.0 + (off / CAUCHY) ** 2)
            own[f] += weight / lidar[f, 1] ** 2
            pull[f] += weight * off / lidar[f, 1]
        for c in range(free):
            if cross[f, c] != 0.0:
                g[c] -= cross[f, c] * pull[f] / own[f]
                for d in range(free):
                    H[c, d] -= cross[f, c] * cross[f, d] / own[f]


@compiled
def solve(
    R_start: Array64,
    p_start: Array64,
    q_start: Array64,
    obs_key: Indices,
    obs_feature: Indices,
    obs_ray: Array64,
    frames: Array64,
    anchor: Indices,
    anchor_ray: Array64,
    lidar: Array64,
    sigma: float,
) -> tuple[Array64, Array64]:
    """Poses (n, 3, 3), (n, 3) with the least errors of all observations, by Gauss-Newton; the first HELD are fixed."""
    Rs, p, q = R_start.copy(), p_start.copy(), q_start.copy()
    free = 6 * (len(Rs) - HELD)
    m = len(q)
    for _ in range(ROUNDS):
        H, g = np.zeros((free, free)), np.zeros(free)
        cross, own, pull = np.zeros((m, free)), np.full(m, 1e-9), np.zeros(m)
        _add_observations(
            Rs, p, q, obs_key, obs_feature, obs_ray, frames, anchor, anchor_ray, sigma, H, g, cross, own, pull
        )
        _eliminate_depths(q, lidar, H, g, cross, own, pull)
        damping = 1e-6 * (1.0 + np.trace(H) / free)
        step = np.asarray(np.linalg.solve(H + damping * np.eye(free), -g), dtype=np.float64)
        for f in range(m):
            q[f] = max(q[f] - (pull[f] + cross[f] @ step) / own[f], 1e-4)
        for j in range(HELD, len(Rs)):
            k = 6 * (j - HELD)
            p[j] = p[j] + Rs[j] @ step[k + 3 : k + 6]
            Rs[j] = Rs[j] @ exp_rotation(step[k : k + 3])
        if np.abs(step).max() < CONVERGED:
            break
    return Rs, p

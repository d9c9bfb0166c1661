"""Unit quaternions (x, y, z, w) and rotations, many at once.

Source: Bar-Itzhack 2000, "New method for extracting the quaternion from a rotation matrix".
"""

from __future__ import annotations

import numpy as np

from links.simulated.mesh import Array64


def quaternions_xyzw(rotations: Array64) -> Array64:
    """(n, 4), w >= 0, of rotations (n, 3, 3): the eigenvector of Bar-Itzhack's symmetric matrix."""
    R = rotations
    K = np.zeros((len(R), 4, 4))  # its lower half, which is what eigh reads
    K[:, 0, 0] = R[:, 0, 0] - R[:, 1, 1] - R[:, 2, 2]
    K[:, 1, 1] = R[:, 1, 1] - R[:, 0, 0] - R[:, 2, 2]
    K[:, 2, 2] = R[:, 2, 2] - R[:, 0, 0] - R[:, 1, 1]
    K[:, 3, 3] = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2]
    K[:, 1, 0], K[:, 2, 0], K[:, 2, 1] = (R[:, i, j] + R[:, j, i] for i, j in ((1, 0), (2, 0), (2, 1)))
    K[:, 3, 0], K[:, 3, 1], K[:, 3, 2] = (R[:, i, j] - R[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    q = np.linalg.eigh(K)[1][:, :, -1]
    return np.where(q[:, 3:] >= 0, q, -q)


def rotations_from_xyzw(quaternions: Array64) -> Array64:
    """Rotations (n, 3, 3) of quaternions (n, 4) of any length."""
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def rotations_from_vectors(vectors_rad: Array64) -> Array64:
    """Rotations (n, 3, 3) about vectors (n, 3) by their length [rad]."""
    half = 0.5 * np.linalg.norm(vectors_rad, axis=1, keepdims=True)
    return rotations_from_xyzw(np.hstack([0.5 * vectors_rad * np.sinc(half / np.pi), np.cos(half)]))

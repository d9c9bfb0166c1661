"""Rotations about many vectors at once.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from links.simulated.world.mesh import Array64
from stages.geometry import rotations_from_xyzw


def rotations_from_vectors(vectors_rad: Array64) -> Array64:
    """Rotations (n, 3, 3) about vectors (n, 3) by their length [rad]."""
    half = 0.5 * np.linalg.norm(vectors_rad, axis=1, keepdims=True)
    return rotations_from_xyzw(np.hstack([0.5 * vectors_rad * np.sinc(half / np.pi), np.cos(half)]))

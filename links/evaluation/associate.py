"""Puts an estimate and truth on one time: truth is interpolated to any moment, but never over a gap.

Source: ours; slerp after Shoemake (SIGGRAPH 1985).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64

Stamps = NDArray[np.int64]


def interpolate(
    at_ns: Stamps, stamps_ns: Stamps, xyz_m: Array64, quaternion_xyzw: Array64 | None, max_gap_ns: int
) -> tuple[NDArray[np.bool_], Array64, Array64 | None]:
    """Positions (linear) and orientations (slerp) at the moments `at_ns` (m,).

    -> known (m,): False before the first and after the last sample, and between samples more than `max_gap_ns` apart
    (a sample itself is always known); xyz (m, 3) and quaternion (m, 4) or None, whose unknown rows mean nothing.
    """
    if not len(stamps_ns):
        quaternions = None if quaternion_xyzw is None else np.zeros((len(at_ns), 4))
        return np.zeros(len(at_ns), dtype=np.bool_), np.zeros((len(at_ns), 3)), quaternions
    after = np.clip(np.searchsorted(stamps_ns, at_ns, side="left"), 0, len(stamps_ns) - 1)
    exact = stamps_ns[after] == at_ns
    before = np.where(exact, after, np.maximum(after - 1, 0))
    step_ns = stamps_ns[after] - stamps_ns[before]
    inside = (at_ns >= stamps_ns[0]) & (at_ns <= stamps_ns[-1])
    known = exact | (inside & (step_ns <= max_gap_ns))
    w = np.where(known & ~exact, (at_ns - stamps_ns[before]) / np.maximum(step_ns, 1), 0.0)
    xyz = (1 - w)[:, None] * xyz_m[before] + w[:, None] * xyz_m[after]
    if quaternion_xyzw is None:
        return known, xyz, None
    return known, xyz, slerp(quaternion_xyzw[before], quaternion_xyzw[after], w)


def slerp(q0: Array64, q1: Array64, w: Array64) -> Array64:
    """Unit quaternions (n, 4) the share w (n,) of the shorter way from q0 to q1."""
    dot = np.sum(q0 * q1, axis=1)
    q1 = np.where(dot[:, None] < 0, -q1, q1)
    angle = np.arccos(np.clip(np.abs(dot), -1, 1))
    straight = angle < 1e-6
    sine = np.where(straight, 1.0, np.sin(angle))
    a = np.where(straight, 1 - w, np.sin((1 - w) * angle) / sine)
    b = np.where(straight, w, np.sin(w * angle) / sine)
    q = a[:, None] * q0 + b[:, None] * q1
    return q / np.linalg.norm(q, axis=1, keepdims=True)


def newest(at_ns: Stamps, stamps_ns: Stamps) -> NDArray[np.int64]:
    """Index of the newest sample at or before each moment; -1 before the first."""
    return np.searchsorted(stamps_ns, at_ns, side="right") - 1

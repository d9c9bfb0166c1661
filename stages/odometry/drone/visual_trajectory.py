"""Rotation of the drone between two times by its visual odometry.

Source: ours.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from collections import deque
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation
from stages.messages import VisualMotion

KEPT = 1024  # images
AHEAD_NS = 250_000_000  # extrapolation beyond the newest image
GAP_S = 0.5  # a longer motion is not interpolated
UNKNOWN_RAD_PER_S = math.radians(40.0)  # turn rate after the newest image, one sigma


@dataclass(frozen=True)
class DroneRotation:
    """Rotation of the drone between two times."""

    R_from_to: Array64
    variance_rad2: float  # of each axis


class VisualTrajectory:
    """The drone's rotation by visual odometry: motions chained as long as each begins where an earlier one ended."""

    def __init__(self) -> None:
        self._nodes: deque[tuple[int, Array64, float, int]] = deque(maxlen=KEPT)  # stamp, R, variance so far, chain

    def add(self, motion: VisualMotion) -> None:
        """Add a motion; one that does not begin at the end of a known one begins a new chain."""
        if self._nodes and motion.stamp_ns <= self._nodes[-1][0]:
            return
        start = next((node for node in reversed(self._nodes) if node[0] == motion.from_ns), None)
        if start is None:
            chain = self._nodes[-1][3] + 1 if self._nodes else 0
            start = (motion.from_ns, np.eye(3), 0.0, chain)
            if not self._nodes or motion.from_ns > self._nodes[-1][0]:
                self._nodes.append(start)
        variance = start[2] + float(np.trace(motion.covariance_rad2)) / 3
        self._nodes.append((motion.stamp_ns, start[1] @ motion.R_from_to, variance, start[3]))

    @property
    def newest_ns(self) -> int | None:
        """Stamp of the newest image; None before the first."""
        return self._nodes[-1][0] if self._nodes else None

    def at(self, stamp_ns: int) -> tuple[Array64, float, int] | None:
        """R_chain_drone (3, 3), its accumulated variance [rad^2] and the chain's number; None: not known."""
        nodes = self._nodes
        if not nodes or not nodes[0][0] <= stamp_ns <= nodes[-1][0] + AHEAD_NS:
            return None
        at = bisect_right(nodes, stamp_ns, key=lambda node: node[0])
        chain = nodes[at - 1][3]
        if at == len(nodes) and stamp_ns > nodes[-1][0]:
            at -= 1  # extrapolate the last motion
        if at == len(nodes) or at == 0:
            return (*nodes[at - 1][1:3], chain) if at else None
        (t0, R0, v0, chain0), (t1, R1, v1, chain1) = nodes[at - 1], nodes[at]
        if chain0 != chain1 or (t0 < stamp_ns < t1 and t1 - t0 > GAP_S * 1e9):
            return None
        share = (stamp_ns - t0) / (t1 - t0)
        variance = v0 + share * (v1 - v0) if share <= 1 else v1 + ((stamp_ns - t1) * 1e-9 * UNKNOWN_RAD_PER_S) ** 2
        return R0 @ exp_rotation(share * log_rotation(R0.T @ R1)), variance, chain0

    def between(self, from_ns: int, to_ns: int) -> DroneRotation | None:
        """The drone's rotation between two times; None: not known."""
        a, b = self.at(from_ns), self.at(to_ns)
        if a is None or b is None or a[2] != b[2]:
            return None
        return DroneRotation(a[0].T @ b[0], abs(b[1] - a[1]))

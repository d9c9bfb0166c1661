"""Jumps of the published pose: poses far from the previous pose, propagated.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.pose_message import MapEstimate
from stages.fuse.settings import FuseLimits
from stages.kernels.geometry.so3 import log_rotation

JUMP_MPS2, JUMP_RAD_PER_S = 10.0, 4.0  # what a drone can do between two outputs


class Jumps:
    """Counts jumps. The autopilot receives the count as resets."""

    def __init__(self, limits: FuseLimits) -> None:
        self._limits = limits
        self._last: MapEstimate | None = None
        self._reported_resets = 0
        self.number = 0

    def lost(self) -> None:
        """The pose is lost; the next one counts as a jump."""
        self.number += self._last is not None
        self._last = None

    def add(self, known: MapEstimate, resets: int) -> None:
        """Add a pose. `resets`: count of the estimator; jumps by a reset are not counted again."""
        last, reported = self._last, self._reported_resets
        self._last, self._reported_resets = known, resets
        if last is None or resets > reported:
            return
        dt = (known.stamp_ns - last.stamp_ns) * 1e-9
        off_m = float(np.linalg.norm(known.xyz_map_m - last.xyz_map_m - dt * last.velocity_map_mps))
        jumped = off_m > self._limits.jump_m + JUMP_MPS2 * dt**2
        if known.R_map_drone is not None and last.R_map_drone is not None:
            turned = float(np.linalg.norm(log_rotation(last.R_map_drone.T @ known.R_map_drone)))
            jumped |= turned > math.radians(self._limits.jump_deg) + JUMP_RAD_PER_S * dt
        self.number += jumped

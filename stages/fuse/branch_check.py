"""Independent check of the yaw branch by the drone's camera, for an autopilot that reports no position.

Each window of flight gives its direction twice: by LiDAR, and by the drone's camera, turned by the rotation from
vanishing points. The windows update the probabilities of the four branches as in `align`, but without a prior and
without the probabilities of `align`; the check restarts when the rotation jumps. `align` uses nearly the same evidence,
so the result is a second condition and is never multiplied with the probability of `align`.

Source: ours; stages/heading; DESIGN, Yaw branch.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.motion_model import Motions
from stages.geometry.frames import Array64
from stages.heading.hypothesis_bank import BranchSettings, HypothesisBank
from stages.heading.windows import Windows
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import DroneFix, VisualMotion
from stages.odometry.drone.trajectory import rotation_between

BEARING_RAD = 0.05  # error by the lever arm of the drone's camera and by the vanishing points
JUMP_RAD = math.radians(30.0)  # a rotation farther from the propagated one is on another branch
LONG_NS = 5_000_000_000  # age of a rotation up to which directions of images are turned by it


class BranchCheck:
    """Check of the branch that the vanishing points currently have."""

    def __init__(self, motions: Motions) -> None:
        self._motions = motions
        self._bank = HypothesisBank(BranchSettings())
        self._windows = Windows(BranchSettings().baseline_m)
        self._rotation: tuple[int, Array64] | None = None  # newest R_map_drone by vanishing points

    @property
    def windows(self) -> int:
        """Number of windows used since the last restart."""
        return self._bank.windows

    def agrees(self, max_alternative_odds: float) -> bool:
        """Whether the other hypotheses together are less probable than `max_alternative_odds`."""
        return self._bank.resolved(0, 1.0 - max_alternative_odds)

    def restart(self) -> None:
        """Drop all evidence."""
        self._bank.reset()
        self._windows.restart()
        self._rotation = None

    def add_visual_motion(self, motion: VisualMotion) -> None:
        """Add a step of the drone's visual odometry."""
        self._windows.add_step(motion)

    def add_vp_rotation(self, stamp_ns: int, R_map_drone: Array64) -> None:
        """Add a RESOLVED rotation by vanishing points."""
        if self._rotation is not None:
            before = self._propagated(stamp_ns)
            if before is None or float(np.linalg.norm(log_rotation(before.T @ R_map_drone))) > JUMP_RAD:
                self.restart()
        self._rotation = stamp_ns, R_map_drone

    def add_fix(self, fix: DroneFix) -> None:
        """Add a LiDAR position."""
        motions = self._motions
        if not motions.map_is_fixed(fix.stamp_ns):
            self._windows.restart()
            return
        self._windows.add_fix(fix, *motions.vehicle.at(fix.stamp_ns), motions.motion_model.autopilot)
        if self._rotation is None or fix.stamp_ns - self._rotation[0] > LONG_NS:
            return
        at = {stamp_ns: self._propagated(stamp_ns) for stamp_ns in self._windows.steps_since_start()}
        moved = self._windows.close_bearing({ns: R for ns, R in at.items() if R is not None}, BEARING_RAD)
        if moved is not None:
            self._bank.see(moved)

    def _propagated(self, stamp_ns: int) -> Array64 | None:
        """The newest rotation, propagated by the drone's own turn; None: the turn is not measured."""
        assert self._rotation is not None
        from_ns, R = self._rotation
        turn = rotation_between(
            self._motions.motion_model.autopilot, self._motions.motion_model.images, from_ns, stamp_ns
        )
        return R @ turn.R_from_to if turn.measured else None

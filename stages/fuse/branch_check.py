"""Whether the drone's camera agrees with the branch that the streets tell, where its autopilot tells no way flown.

Each window of flight is a direction told twice: by the LiDAR, and by the drone's pictures as the streets' rotation
turns them. They weigh the four branches as `align` does, but from nothing: no prior, no probability is taken over from
there, and all is begun anew when the rotation told jumps. It is a second look at much the same evidence, so its odds
are a condition beside align's and never multiplied with them.

Source: ours; stages/heading; DESIGN, Yaw branch.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.motions import Motions
from stages.geometry.frames import Array64
from stages.heading.hypothesis_bank import BranchBank, BranchSettings
from stages.heading.windows import Windows
from stages.kernels.geometry.so3 import log_rotation
from stages.messages import DroneFix, VisualMotion
from stages.odometry.drone.trajectory import rotation_between

BEARING_RAD = 0.05  # of the lever between the drone's camera and its middle, and of the streets
JUMP_RAD = math.radians(30.0)  # a rotation so far from the one before, carried on, is of another branch
LONG_NS = 5_000_000_000  # without a rotation the pictures' directions are not known


class Witness:
    """Of the branch told now."""

    def __init__(self, motions: Motions) -> None:
        self._motions = motions
        self._bank = BranchBank(BranchSettings())
        self._windows = Windows(BranchSettings().baseline_m)
        self._told: tuple[int, Array64] | None = None  # the streets' R_map_drone at a time

    @property
    def windows(self) -> int:
        """Ways flown that were weighed."""
        return self._bank.windows

    def agrees(self, doubt: float) -> bool:
        """Whether all that is not the branch told is less likely than `doubt`."""
        return self._bank.resolved(0, 1.0 - doubt)

    def restart(self) -> None:
        """Nothing before now counts."""
        self._bank.reset()
        self._windows.restart()
        self._told = None

    def hear_pictures(self, motion: VisualMotion) -> None:
        """A step of the drone's odometry by its camera."""
        self._windows.add_step(motion)

    def hear_streets(self, stamp_ns: int, R_map_drone: Array64) -> None:
        """A rotation that is RESOLVED."""
        if self._told is not None:
            before = self._carried(stamp_ns)
            if before is None or float(np.linalg.norm(log_rotation(before.T @ R_map_drone))) > JUMP_RAD:
                self.restart()
        self._told = stamp_ns, R_map_drone

    def see_fix(self, fix: DroneFix) -> None:
        """Where the LiDAR saw the drone."""
        motions = self._motions
        if not motions.still(fix.stamp_ns):
            self._windows.restart()
            return
        self._windows.add_fix(fix, *motions.vehicle.at(fix.stamp_ns), motions.motion_model.autopilot)
        if self._told is None or fix.stamp_ns - self._told[0] > LONG_NS:
            return
        at = {stamp_ns: self._carried(stamp_ns) for stamp_ns in self._windows.steps_since_start()}
        moved = self._windows.close_bearing({ns: R for ns, R in at.items() if R is not None}, BEARING_RAD)
        if moved is not None:
            self._bank.see(moved)

    def _carried(self, stamp_ns: int) -> Array64 | None:
        """The streets' rotation, by the drone's own turn since; None: nobody told that."""
        assert self._told is not None
        from_ns, R = self._told
        turn = rotation_between(
            self._motions.motion_model.autopilot, self._motions.motion_model.pictures, from_ns, stamp_ns
        )
        return R @ turn.R_from_to if turn.sure else None

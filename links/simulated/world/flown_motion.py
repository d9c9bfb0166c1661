"""The motion of a drone that is flown while the simulation runs: states of the airframe, as far as it has flown.

It has the interface of `Flight`. Times before the start take the first state. Later times than the last state are an
error: a sensor must not look ahead of the airframe.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from links.simulated.kernels.motion import GRAVITY_MPS2, STEP_S
from links.simulated.world.motion import interpolate
from stages.geometry.frames import Array64, rotations_from_xyzw

AHEAD_STEPS = 1.001  # rounding of times to nanoseconds


class FlownMotion:
    """States (n, 17) of `links.simulated.kernels.airframe`, one per STEP_S from the start."""

    def __init__(self, first: Array64) -> None:
        self._rows = np.empty((4096, len(first)))
        self._rows[0] = first
        self._count = 1

    def append(self, rows: Array64) -> None:
        """Add the states that follow."""
        if self._count + len(rows) > len(self._rows):
            self._rows = np.vstack([self._rows, np.empty_like(self._rows)])
        self._rows[self._count : self._count + len(rows)] = rows
        self._count += len(rows)

    @property
    def states(self) -> Array64:
        """All states so far (n, 17)."""
        return self._rows[: self._count]

    @property
    def until_s(self) -> float:
        """Time of the newest state."""
        return (self._count - 1) * STEP_S

    def at(self, time_s: Array64) -> tuple[Array64, Array64, Array64, Array64]:
        """Position, velocity, acceleration (n, 3), world, and yaw (n,) [rad]."""
        rotations, position = self.flying_poses(time_s)
        velocity = self._interpolate(slice(3, 6), time_s)
        thrust = self._interpolate(slice(13, 14), time_s)
        acceleration = rotations[:, :, 2] * thrust - [0.0, 0.0, GRAVITY_MPS2]  # without drag
        return position, velocity, acceleration, np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0])

    def flying_poses(self, time_s: Array64) -> tuple[Array64, Array64]:
        """T_world_drone: rotations (n, 3, 3) and positions (n, 3) [m]."""
        return rotations_from_xyzw(self._interpolate(slice(6, 10), time_s)), self._interpolate(slice(0, 3), time_s)

    def _interpolate(self, columns: slice, time_s: Array64) -> Array64:
        latest = float(np.max(time_s, initial=0.0))
        if latest > self.until_s + AHEAD_STEPS * STEP_S:
            raise LookupError(f"the drone has flown {self.until_s:.4f} s, its pose at {latest:.4f} s is not known")
        rows = self._rows[: max(self._count, 2), columns]
        if self._count == 1:
            rows = np.repeat(self._rows[:1, columns], 2, axis=0)
        return interpolate(rows, STEP_S, time_s)

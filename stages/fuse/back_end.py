"""Interface of the estimator that keeps the pose: the fixed-lag smoother (smoother.py).

Source: ours.
"""

from __future__ import annotations

from typing import Protocol

from stages.fuse.propagated import Step
from stages.geometry.frames import Array64

HUBER = 1.345  # beyond so many sigmas a residual's weight falls: 95 % efficient where all is Gaussian


class BackEnd(Protocol):
    """T_map_drone at `stamp_ns`; covariance (6, 6): rotation before translation, tangent at the body."""

    stamp_ns: int
    R_map_drone: Array64
    xyz_map_m: Array64
    covariance: Array64
    recoveries: int  # how often it had to be begun anew after an error of its library

    def start(self, stamp_ns: int, R_map_drone: Array64, xyz_map_m: Array64, covariance: Array64) -> None:
        """Begin here, nothing before counts."""
        ...

    def extend(self, stamp_ns: int, step: Step, up_drone: Array64 | None, tilt_rad2: float) -> None:
        """Move on to a later moment; `up_drone`: the vertical (3,) in the drone's axes there, with its variance."""
        ...

    def near(self, stamp_ns: int) -> tuple[int, Array64, Array64]:
        """The known moment that a measurement is told from, and the pose there."""
        ...

    def add_position(self, key_ns: int, step: Step, xyz_m: Array64, covariance_m2: Array64) -> bool:
        """z = T(key) step: where the drone was at the end of a step from `key_ns`; False: it could not be used."""
        ...

    def add_rotation(self, key_ns: int, step: Step, R: Array64, covariance_rad2: Array64) -> bool:
        """R_map_drone at the end of a step; covariance in the drone's axes there."""
        ...

"""Interface of the estimator that keeps the pose: the fixed-lag smoother (smoother.py).

Source: ours.
"""

from __future__ import annotations

from typing import Protocol

from stages.fuse.propagated import Step
from stages.geometry.frames import Array64

HUBER = 1.345  # [sigma] residual from which its weight falls: 95 % efficient on Gaussian noise


class BackEnd(Protocol):
    """T_map_drone at `stamp_ns`; covariance (6, 6): rotation before translation, tangent at the body."""

    stamp_ns: int
    R_map_drone: Array64
    xyz_map_m: Array64
    covariance: Array64
    recoveries: int  # how often it had to be reset after an error of its library

    def start(self, stamp_ns: int, R_map_drone: Array64, xyz_map_m: Array64, covariance: Array64) -> None:
        """Start from one pose; earlier measurements are dropped."""
        ...

    def extend(self, stamp_ns: int, step: Step, up_drone: Array64 | None, tilt_rad2: float) -> None:
        """Add a later pose; `up_drone` is the vertical (3,) in drone axes there, `tilt_rad2` its variance."""
        ...

    def near(self, stamp_ns: int) -> tuple[int, Array64, Array64]:
        """Time and pose that a measurement at `stamp_ns` is referred to."""
        ...

    def add_position(self, key_ns: int, step: Step, xyz_m: Array64, covariance_m2: Array64) -> bool:
        """Position at the end of a step from `key_ns`, z = T(key) step. False: not usable."""
        ...

    def add_rotation(self, key_ns: int, step: Step, R: Array64, covariance_rad2: Array64) -> bool:
        """R_map_drone at the end of a step from `key_ns`; covariance in drone axes there. False: not usable."""
        ...

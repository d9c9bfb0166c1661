"""Compiled functions that convert positions and velocities between frames map and vehicle.

Source: see `stages/geometry/trajectory.py`.
"""

from __future__ import annotations

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.geometry.so3 import exp_rotation

STEP_NS = 50_000_000  # interval over which a velocity is computed


@compiled
def moved(
    R: Array64, t: Array64, turn_radps: Array64, velocity_mps: Array64, seconds: float
) -> tuple[Array64, Array64]:
    """R, t after some seconds of a constant angular velocity (3,), in the child axes of R, and a constant velocity."""
    return R @ exp_rotation(seconds * turn_radps), t + seconds * velocity_mps


@compiled
def to_vehicle(
    R: Array64, t: Array64, R_then: Array64, t_then: Array64, xyz_m: Array64, velocity_mps: Array64
) -> tuple[Array64, Array64]:
    """Position and velocity (3,) in frame vehicle of those in frame map.

    R (3, 3), t (3,): T_map_vehicle; R_then, t_then: the same STEP_NS later.
    """
    now = R.T @ (xyz_m - t)
    then = R_then.T @ (xyz_m + STEP_NS * 1e-9 * velocity_mps - t_then)
    return now, (then - now) / (STEP_NS * 1e-9)


@compiled
def to_map(
    R: Array64, t: Array64, R_then: Array64, t_then: Array64, xyz_m: Array64, velocity_mps: Array64
) -> tuple[Array64, Array64]:
    """Position and velocity (3,) in frame map of those in frame vehicle: the inverse of `to_vehicle`."""
    now = R @ xyz_m + t
    then = R_then @ (xyz_m + STEP_NS * 1e-9 * velocity_mps) + t_then
    return now, (then - now) / (STEP_NS * 1e-9)

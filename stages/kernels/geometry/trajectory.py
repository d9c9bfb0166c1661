"""Compiled functions of `stages/geometry/trajectory.py`.

Source: see there.
"""

from __future__ import annotations

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

STEP_NS = 50_000_000  # over which a velocity is taken


@compiled
def to_vehicle(
    R: Array64, t: Array64, R_then: Array64, t_then: Array64, xyz_m: Array64, velocity_mps: Array64
) -> tuple[Array64, Array64]:
    now = R.T @ (xyz_m - t)
    then = R_then.T @ (xyz_m + STEP_NS * 1e-9 * velocity_mps - t_then)
    return now, (then - now) / (STEP_NS * 1e-9)


@compiled
def to_map(
    R: Array64, t: Array64, R_then: Array64, t_then: Array64, xyz_m: Array64, velocity_mps: Array64
) -> tuple[Array64, Array64]:
    now = R @ xyz_m + t
    then = R_then @ (xyz_m + STEP_NS * 1e-9 * velocity_mps) + t_then
    return now, (then - now) / (STEP_NS * 1e-9)

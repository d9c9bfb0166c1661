"""Compiled functions that convert positions and velocities between frames map and vehicle.

Source: see `stages/geometry/trajectory.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.geometry.so3 import exp_rotation, log_rotation, nearly_rotation

STEP_NS = 50_000_000  # interval over which a velocity is computed


@compiled
def moved(
    R: Array64, t: Array64, turn_radps: Array64, velocity_mps: Array64, seconds: float
) -> tuple[Array64, Array64]:
    """R, t after some seconds of a constant angular velocity (3,), in the child axes of R, and a constant velocity."""
    return R @ exp_rotation(seconds * turn_radps), t + seconds * velocity_mps


@compiled
def poses_at(
    ns: NDArray[np.int64],
    R: Array64,
    t: Array64,
    turn_radps: Array64,
    velocity_mps: Array64,
    furthest_ns: int,
    stamps_ns: NDArray[np.int64],
) -> tuple[Array64, Array64]:
    """R (n, 3, 3), t (n, 3) at times (n,) after the first of some poses (k,), (k, 3, 3), (k, 3), k >= 2.

    The rates are those of the newest pose; beyond it they hold for furthest_ns.
    """
    R_at, t_at = np.empty((stamps_ns.size, 3, 3)), np.empty((stamps_ns.size, 3))
    newest = ns.size - 1
    for i in range(stamps_ns.size):
        stamp_ns = stamps_ns[i]
        if stamp_ns > ns[newest]:
            seconds = min(stamp_ns - ns[newest], furthest_ns) * 1e-9
            R_at[i], t_at[i] = moved(R[newest], t[newest], turn_radps, velocity_mps, seconds)
            continue
        after = newest
        while after > 1 and stamp_ns < ns[after - 1]:
            after -= 1
        share = (stamp_ns - ns[after - 1]) / (ns[after] - ns[after - 1])
        # The poses differ by milliseconds: interpolate linearly and project back to a rotation.
        R_at[i] = nearly_rotation(R[after - 1] + share * (R[after] - R[after - 1]))
        t_at[i] = t[after - 1] + share * (t[after] - t[after - 1])
    return R_at, t_at


@compiled
def apart(R: Array64, t: Array64, R_other: Array64, t_other: Array64) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses R (3, 3), t (3,)."""
    x, y, z = t_other[0] - t[0], t_other[1] - t[1], t_other[2] - t[2]
    turn = log_rotation(R.T @ R_other)
    return math.sqrt(x * x + y * y + z * z), math.sqrt(turn[0] ** 2 + turn[1] ** 2 + turn[2] ** 2)


@compiled
def positions_in_vehicle(R: Array64, t: Array64, xyz_m: Array64) -> Array64:
    """Positions (n, 3) in frame vehicle of those in frame map, each with its T_map_vehicle (n, 3, 3), (n, 3)."""
    inside_m = np.empty((len(xyz_m), 3))
    for i in range(len(xyz_m)):
        inside_m[i] = R[i].T @ (xyz_m[i] - t[i])
    return inside_m


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

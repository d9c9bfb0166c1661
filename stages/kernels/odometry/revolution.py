"""The points of one rotor revolution in frame map, as columns of one azimuth.

The lasers of a unit may fire at different azimuths: column c has the pulse of firing c - shift of each laser.

Source: ours.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


class Poses(NamedTuple):
    """T_map_vehicle of s slices at their first and last pulse, and the LiDAR in them."""

    R_first: Array64  # (s, 3, 3)
    t_first_m: Array64  # (s, 3)
    R_last: Array64
    t_last_m: Array64
    lidar_vehicle_m: Array64  # (s, 3)


class Revolution(NamedTuple):
    """One revolution, columns c in order of firing, lasers k by elevation. Frame map, by the reported motion."""

    stamp_ns: NDArray[np.int64]  # (c, k)
    xyz_m: Array64  # (c, k, 3)
    range_m: Array64  # (c, k) 0: no return
    origin_m: Array64  # (c, 3)
    radial: Array64  # (c, 3) direction of a beam of elevation 0
    axis: Array64  # (c, 3) spin axis, towards higher elevations
    step_rad: float  # turn of the rotor per column


@compiled
def _place_firings(
    stamp_ns: NDArray[np.int64], begin: NDArray[np.int64], poses: Poses, R_map: Array64, origin_m: Array64
) -> None:
    """Rotation R_map_vehicle (f, 3, 3) and origin (f, 3) of each firing, between the poses of its slice."""
    for s in range(len(begin) - 1):
        first_ns = stamp_ns[begin[s], 0]
        duration_ns = max(stamp_ns[begin[s + 1] - 1, -1] - first_ns, 1)
        for f in range(begin[s], begin[s + 1]):
            share = (stamp_ns[f, 0] - first_ns) / duration_ns
            for i in range(3):
                origin_m[f, i] = poses.t_first_m[s, i] + share * (poses.t_last_m[s, i] - poses.t_first_m[s, i])
                for j in range(3):
                    R = poses.R_first[s, i, j] + share * (poses.R_last[s, i, j] - poses.R_first[s, i, j])
                    R_map[f, i, j] = R
                    origin_m[f, i] += R * poses.lidar_vehicle_m[s, j]


@compiled
def _unit(v: Array64) -> None:
    """Scale v (3,) to length 1."""
    v /= np.sqrt(v[0] ** 2 + v[1] ** 2 + v[2] ** 2)


@compiled
def revolution_in_map(
    direction_vehicle: NDArray[np.float32],
    range_m: NDArray[np.float32],
    stamp_ns: NDArray[np.int64],
    begin: NDArray[np.int64],
    poses: Poses,
    used: NDArray[np.int64],
    shift: NDArray[np.int64],
    weights: Array64,
    step_rad: float,
) -> Revolution:
    """The revolution by f firings of all lasers: directions (f, l, 3), ranges and times (f, l).

    `begin` (s + 1,) are the slices' first firings and f. `used` (k,) are the lasers, `shift` (k,) their firings after
    the column's, `weights` (2, k) give the radial direction and the axis from the directions of a column, `step_rad` is
    the rotor's turn per column.
    """
    firings, k = len(range_m), len(used)
    R_map, origin_m = np.empty((firings, 3, 3)), np.empty((firings, 3))
    _place_firings(stamp_ns, begin, poses, R_map, origin_m)
    first, end = shift.max(), firings + shift.min()
    count = max(end - first, 0)
    stamps, points, ranges = np.empty((count, k), np.int64), np.empty((count, k, 3)), np.empty((count, k))
    radial, axis = np.zeros((count, 3)), np.zeros((count, 3))
    for c in range(count):
        for n in range(k):
            f, laser = first + c - shift[n], used[n]
            stamps[c, n], ranges[c, n] = stamp_ns[f, laser], range_m[f, laser]
            for i in range(3):
                d = 0.0
                for j in range(3):
                    d += R_map[f, i, j] * direction_vehicle[f, laser, j]
                points[c, n, i] = origin_m[f, i] + d * range_m[f, laser]
                radial[c, i] += weights[0, n] * d
                axis[c, i] += weights[1, n] * d
        _unit(radial[c])
        _unit(axis[c])
    return Revolution(stamps, points, ranges, origin_m[first : first + count], radial, axis, step_rad)

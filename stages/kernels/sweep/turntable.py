"""Compiled functions that interpolate the turntable angle and place returns and pulses by it.

Source: see `stages/sweep/turntable.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled


@compiled
def angle_at(t_ns: int, state_ns: NDArray[np.int64], state_rad: Array64, max_gap_ns: int) -> float:
    """Angle at a time, interpolated between the neighbouring states; NaN outside them or in a gap."""
    n = state_ns.size
    if n == 0 or t_ns < state_ns[0] or t_ns > state_ns[n - 1]:
        return math.nan
    after = np.searchsorted(state_ns, t_ns)  # state_ns[after - 1] < t_ns <= state_ns[after]
    if state_ns[after] == t_ns:
        return state_rad[after]
    gap_ns = state_ns[after] - state_ns[after - 1]
    if gap_ns > max_gap_ns:
        return math.nan
    share = (t_ns - state_ns[after - 1]) / gap_ns
    return state_rad[after - 1] + share * (state_rad[after] - state_rad[after - 1])


@compiled
def turns_at(
    pulse_ns: NDArray[np.int64], state_ns: NDArray[np.int64], state_rad: Array64, max_gap_ns: int, turn: Array64
) -> None:
    """Fill turn (n, 3) with angle, cosine and sine at each pulse; NaN where the angle is not known."""
    for i in range(pulse_ns.size):
        angle = angle_at(pulse_ns[i], state_ns, state_rad, max_gap_ns)
        turn[i, 0], turn[i, 1], turn[i, 2] = angle, math.cos(angle), math.sin(angle)


@compiled
def place_returns(
    range_m: NDArray[np.float32],
    xyz_lidar_m: NDArray[np.float32],
    turn: Array64,
    min_range_m: float,
    T_vehicle_turntable: Array64,
    T_turntable_lidar: Array64,
    pulse: NDArray[np.int64],
    xyz_vehicle_m: NDArray[np.float32],
    turntable_rad: NDArray[np.float32],
) -> tuple[int, int]:
    """Fill the last three arrays with the returns of a packet, in order: pulse index, point, angle.

    Returns (number filled, number without an angle). Pulses nearer than min_range_m or without return are skipped.
    """
    A, B = T_vehicle_turntable, T_turntable_lidar
    placed = unplaced = 0
    for i in range(range_m.size):
        if range_m[i] <= 0.0 or range_m[i] < min_range_m:
            continue
        angle, c, s = turn[i, 0], turn[i, 1], turn[i, 2]
        if math.isnan(angle):
            unplaced += 1
            continue
        px, py, pz = xyz_lidar_m[i, 0], xyz_lidar_m[i, 1], xyz_lidar_m[i, 2]
        x = B[0, 0] * px + B[0, 1] * py + B[0, 2] * pz + B[0, 3]
        y = B[1, 0] * px + B[1, 1] * py + B[1, 2] * pz + B[1, 3]
        z = B[2, 0] * px + B[2, 1] * py + B[2, 2] * pz + B[2, 3]
        x, y = c * x - s * y, s * x + c * y
        for axis in range(3):
            xyz_vehicle_m[placed, axis] = A[axis, 0] * x + A[axis, 1] * y + A[axis, 2] * z + A[axis, 3]
        pulse[placed] = i
        turntable_rad[placed] = angle
        placed += 1
    return placed, unplaced


@compiled
def place_pulses(
    return_kind: NDArray[np.uint8],
    laser: NDArray[np.uint8],
    azimuth_rad: NDArray[np.float32],
    range_m: NDArray[np.float32],
    xyz_lidar_m: NDArray[np.float32],
    elevation_rad: Array64,
    turn: Array64,
    T_vehicle_turntable: Array64,
    T_turntable_lidar: Array64,
    origin_vehicle_m: Array64,
    row: NDArray[np.int64],
    direction_vehicle: NDArray[np.float32],
    distance_m: NDArray[np.float32],
) -> int:
    """Fill the last three arrays with every pulse of a packet: its row, unit direction, distance of its nearest return.

    Both are relative to origin_vehicle_m (3,). Returns the number of pulses, 0 if an angle is not known. A pulse
    without a return has the direction (cos w sin a, cos w cos a, sin w) of the lidar frame.
    """
    A, B = T_vehicle_turntable, T_turntable_lidar
    n = 0
    cos_w, sin_w = np.cos(elevation_rad), np.sin(elevation_rad)
    for i in range(range_m.size):
        if return_kind[i] != 0:  # the last return of the previous pulse
            if n > 0 and range_m[i] > 0.0 and (distance_m[n - 1] == 0.0 or range_m[i] < distance_m[n - 1]):
                n -= 1  # nearer: replaces it
            else:
                continue
        angle, c, s = turn[i, 0], turn[i, 1], turn[i, 2]
        if math.isnan(angle):
            return 0
        seen = range_m[i] > 0.0
        if seen:
            px, py, pz = float(xyz_lidar_m[i, 0]), float(xyz_lidar_m[i, 1]), float(xyz_lidar_m[i, 2])
        else:
            level, up = cos_w[laser[i]], sin_w[laser[i]]
            px, py, pz = level * math.sin(azimuth_rad[i]), level * math.cos(azimuth_rad[i]), up
        x = B[0, 0] * px + B[0, 1] * py + B[0, 2] * pz
        y = B[1, 0] * px + B[1, 1] * py + B[1, 2] * pz
        z = B[2, 0] * px + B[2, 1] * py + B[2, 2] * pz
        if seen:
            x, y, z = x + B[0, 3], y + B[1, 3], z + B[2, 3]
        x, y = c * x - s * y, s * x + c * y
        vx = A[0, 0] * x + A[0, 1] * y + A[0, 2] * z
        vy = A[1, 0] * x + A[1, 1] * y + A[1, 2] * z
        vz = A[2, 0] * x + A[2, 1] * y + A[2, 2] * z
        if seen:
            vx += A[0, 3] - origin_vehicle_m[0]
            vy += A[1, 3] - origin_vehicle_m[1]
            vz += A[2, 3] - origin_vehicle_m[2]
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        row[n] = i
        direction_vehicle[n, 0] = vx / length
        direction_vehicle[n, 1] = vy / length
        direction_vehicle[n, 2] = vz / length
        distance_m[n] = length if seen else 0.0
        n += 1
    return n

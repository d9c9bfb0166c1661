"""Compiled functions that interpolate the turntable angle and place returns and pulses by it.

Source: see `stages/sweep/turntable.py`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled
from stages.kernels.lidar.packets import Firings


class Returns(NamedTuple):
    """Returns in the vehicle frame."""

    stamp_ns: NDArray[np.int64]
    xyz_m: NDArray[np.float32]  # (n, 3)
    laser: NDArray[np.uint8]
    reflectivity: NDArray[np.uint8]
    turntable_rad: NDArray[np.float32]


class Pulses(NamedTuple):
    """Pulses in the vehicle frame."""

    stamp_ns: NDArray[np.int64]
    direction: NDArray[np.float32]  # (n, 3)
    range_m: NDArray[np.float32]
    laser: NDArray[np.uint8]
    reflectivity: NDArray[np.uint8]


@compiled
def angle_at(
    t_ns: int, state_ns: NDArray[np.int64], state_rad: Array64, max_gap_ns: int, after: int
) -> tuple[float, int]:
    """Angle at a time, interpolated between the neighbouring states, and the index of the first not before that time.

    NaN outside the states or in a gap. `after`: that index for a time shortly before; any is right.
    """
    n = state_ns.size
    if n == 0 or t_ns < state_ns[0] or t_ns > state_ns[n - 1]:
        return math.nan, after
    if not (0 < after < n and state_ns[after - 1] < t_ns <= state_ns[after]):
        after = int(np.searchsorted(state_ns, t_ns))
    if state_ns[after] == t_ns:
        return state_rad[after], after
    gap_ns = state_ns[after] - state_ns[after - 1]
    if gap_ns > max_gap_ns:
        return math.nan, after
    share = (t_ns - state_ns[after - 1]) / gap_ns
    return state_rad[after - 1] + share * (state_rad[after] - state_rad[after - 1]), after


@compiled
def turns_at(
    pulse_ns: NDArray[np.int64], state_ns: NDArray[np.int64], state_rad: Array64, max_gap_ns: int, turn: Array64
) -> None:
    """Fill turn (n, 3) with angle, cosine and sine at each pulse; NaN where the angle is not known."""
    after = 0
    for i in range(pulse_ns.size):
        angle, after = angle_at(pulse_ns[i], state_ns, state_rad, max_gap_ns, after)
        turn[i, 0], turn[i, 1], turn[i, 2] = angle, math.cos(angle), math.sin(angle)


@compiled
def origin_at(angle_rad: float, T_vehicle_turntable: Array64, T_turntable_lidar: Array64) -> tuple[float, float, float]:
    """Origin of the beams [m], vehicle frame, for a turntable angle; NaN counts as 0."""
    angle_rad = 0.0 if math.isnan(angle_rad) else angle_rad
    A, B = T_vehicle_turntable, T_turntable_lidar
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    x, y, z = c * B[0, 3] - s * B[1, 3], s * B[0, 3] + c * B[1, 3], B[2, 3]
    return (
        A[0, 0] * x + A[0, 1] * y + A[0, 2] * z + A[0, 3],
        A[1, 0] * x + A[1, 1] * y + A[1, 2] * z + A[1, 3],
        A[2, 0] * x + A[2, 1] * y + A[2, 2] * z + A[2, 3],
    )


@compiled
def place_slice(
    firings: Firings,
    elevation_rad: Array64,
    turn: Array64,
    min_range_m: float,
    T_vehicle_turntable: Array64,
    T_turntable_lidar: Array64,
    returns: Returns,
    pulses: Pulses,
) -> tuple[int, int, int, int, tuple[float, float, float]]:
    """Fill `returns` and `pulses` with those of a slice in the vehicle frame, in order.

    Returns the numbers of returns, of returns without an angle, of pulses, of fired pulses, and the beams' origin at
    the middle pulse, which the pulses' directions and distances are relative to. A return is skipped nearer than
    min_range_m. A pulse has the distance of its nearest return, 0: none, and then the direction (cos w sin a,
    cos w cos a, sin w) of the lidar frame. There are no pulses where an angle is not known.
    """
    A, B = T_vehicle_turntable, T_turntable_lidar
    n_returns = unplaced = n = fired = 0
    known = True
    cos_w, sin_w = np.cos(elevation_rad), np.sin(elevation_rad)
    origin = origin_at(turn[turn.shape[0] // 2, 0], A, B)
    for i in range(firings.range_m.size):
        r = firings.range_m[i]
        seen = r > 0.0
        fired += firings.return_kind[i] == 0
        angle, c, s = turn[i, 0], turn[i, 1], turn[i, 2]
        if math.isnan(angle):
            known = False
            unplaced += seen and r >= min_range_m
            continue
        if seen:
            px, py, pz = firings.xyz_lidar_m[i, 0], firings.xyz_lidar_m[i, 1], firings.xyz_lidar_m[i, 2]
        else:
            level, up = cos_w[firings.laser[i]], sin_w[firings.laser[i]]
            px, py, pz = level * math.sin(firings.azimuth_rad[i]), level * math.cos(firings.azimuth_rad[i]), up
        x = B[0, 0] * px + B[0, 1] * py + B[0, 2] * pz
        y = B[1, 0] * px + B[1, 1] * py + B[1, 2] * pz
        z = B[2, 0] * px + B[2, 1] * py + B[2, 2] * pz
        if seen:
            x, y, z = x + B[0, 3], y + B[1, 3], z + B[2, 3]
        x, y = c * x - s * y, s * x + c * y
        vx = A[0, 0] * x + A[0, 1] * y + A[0, 2] * z
        vy = A[1, 0] * x + A[1, 1] * y + A[1, 2] * z
        vz = A[2, 0] * x + A[2, 1] * y + A[2, 2] * z
        if seen and r >= min_range_m:
            returns.stamp_ns[n_returns] = firings.pulse_stamp_ns[i]
            returns.laser[n_returns], returns.reflectivity[n_returns] = firings.laser[i], firings.reflectivity[i]
            returns.turntable_rad[n_returns] = angle
            returns.xyz_m[n_returns, 0] = vx + A[0, 3]
            returns.xyz_m[n_returns, 1] = vy + A[1, 3]
            returns.xyz_m[n_returns, 2] = vz + A[2, 3]
            n_returns += 1
        if firings.return_kind[i] != 0:  # the last return of the previous pulse
            if not (n > 0 and seen and (pulses.range_m[n - 1] == 0.0 or r < pulses.range_m[n - 1])):
                continue
            n -= 1  # nearer: replaces it
        if seen:
            vx, vy, vz = vx + (A[0, 3] - origin[0]), vy + (A[1, 3] - origin[1]), vz + (A[2, 3] - origin[2])
        length = math.sqrt(vx * vx + vy * vy + vz * vz)
        pulses.stamp_ns[n] = firings.pulse_stamp_ns[i]
        pulses.laser[n], pulses.reflectivity[n] = firings.laser[i], firings.reflectivity[i]
        pulses.direction[n, 0], pulses.direction[n, 1], pulses.direction[n, 2] = vx / length, vy / length, vz / length
        pulses.range_m[n] = length if seen else 0.0
        n += 1
    return n_returns, unplaced, n if known else 0, fired, origin

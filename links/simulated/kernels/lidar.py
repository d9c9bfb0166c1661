"""LiDAR pulses: poses of the sensor, sub-rays of a footprint, edges, and the echoes of a pulse.

Source: VLP-16 user manual 63-9243; aperture: VLS-128 user manual 63-9483, table F-1, the same family's optics.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from links.simulated.kernels.ray_casting import Array32
from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

APERTURE_M = (12.7e-3, 9.5e-3)  # size of the beam where it leaves the sensor
PULSE_LENGTH_M = 1.0  # two surfaces closer than this in range give one blended return


@compiled
def lidar_poses(
    R_world_vehicle: Array64,
    t_world_vehicle_m: Array64,
    T_vehicle_turntable: Array64,
    output_rad: Array64,
    T_turntable_lidar: Array64,
) -> tuple[Array64, Array64]:
    """T_world_lidar = T_world_vehicle T_vehicle_turntable Rz(angle) T_turntable_lidar: (n, 3, 3) and (n, 3)."""
    count = len(output_rad)
    rotations, positions = np.empty((count, 3, 3)), np.empty((count, 3))
    turned, mounted = np.empty((3, 4)), np.empty((3, 4))
    for n in range(count):
        c, s = np.cos(output_rad[n]), np.sin(output_rad[n])
        for j in range(4):
            x, y, z = T_turntable_lidar[0, j], T_turntable_lidar[1, j], T_turntable_lidar[2, j]
            turned[0, j], turned[1, j], turned[2, j] = c * x - s * y, s * x + c * y, z
        for i in range(3):
            for j in range(4):
                mounted[i, j] = T_vehicle_turntable[i, 3] if j == 3 else 0.0
                for k in range(3):
                    mounted[i, j] += T_vehicle_turntable[i, k] * turned[k, j]
        for i in range(3):
            for j in range(3):
                rotations[n, i, j] = 0.0
                for k in range(3):
                    rotations[n, i, j] += R_world_vehicle[n, i, k] * mounted[k, j]
            positions[n, i] = t_world_vehicle_m[n, i]
            for k in range(3):
                positions[n, i] += R_world_vehicle[n, i, k] * mounted[k, 3]
    return rotations, positions


@compiled
def sub_rays(
    azimuth_rad: Array64,
    elevation_rad: Array64,
    vertical_offset_m: Array64,
    origin_m: Array64,
    R_world_lidar: Array64,
    t_world_lidar_m: Array64,
    offsets: Array64,
    footprint_rad: tuple[float, float],
) -> tuple[Array32, Array32]:
    """Origins and unit directions (n, k, 3), world frame, of the sub-rays of pulses (n,).

    The axis of a pulse in the lidar frame is (cos w sin a, cos w cos a, sin w), from (x, y, vertical offset of the
    laser) with origin_m (n, 2). `offsets` (k, 2) are in half footprints, along and across the scan.
    """
    count, rays = len(azimuth_rad), len(offsets)
    origins = np.empty((count, rays, 3), dtype=np.float32)
    directions = np.empty((count, rays, 3), dtype=np.float32)
    ray, start = np.empty(3), np.empty(3)
    for i in range(count):
        ca, sa = np.cos(azimuth_rad[i]), np.sin(azimuth_rad[i])
        cw, sw = np.cos(elevation_rad[i]), np.sin(elevation_rad[i])
        R = R_world_lidar[i]
        for k in range(rays):
            u, v = offsets[k]
            turn, lift = u * footprint_rad[0] / 2, v * footprint_rad[1] / 2
            across, up = u * APERTURE_M[0] / 2, v * APERTURE_M[1] / 2
            # axis + turn * e_across + lift * e_up, with e_across = (ca, -sa, 0) and e_up = (-sw sa, -sw ca, cw)
            ray[0] = cw * sa + turn * ca - lift * sw * sa
            ray[1] = cw * ca - turn * sa - lift * sw * ca
            ray[2] = sw + lift * cw
            ray /= np.sqrt(ray[0] ** 2 + ray[1] ** 2 + ray[2] ** 2)
            start[0] = origin_m[i, 0] + (across * ca - up * sw * sa)
            start[1] = origin_m[i, 1] + (-across * sa - up * sw * ca)
            start[2] = vertical_offset_m[i] + up * cw
            for j in range(3):
                directions[i, k, j] = R[j, 0] * ray[0] + R[j, 1] * ray[1] + R[j, 2] * ray[2]
                origins[i, k, j] = t_world_lidar_m[i, j] + R[j, 0] * start[0] + R[j, 1] * start[1] + R[j, 2] * start[2]
    return origins, directions


@compiled
def sees_edge(ranges_m: Array32, spread_m: float) -> NDArray[np.bool_]:
    """Pulses (n,) whose sub-rays (n, k) differ in range by more than the spread, or of which only some hit."""
    found = np.zeros(len(ranges_m), dtype=np.bool_)
    for i in range(len(ranges_m)):
        lowest = highest = ranges_m[i, 0]
        for r in ranges_m[i]:
            lowest, highest = min(lowest, r), max(highest, r)
        found[i] = np.isfinite(lowest) and highest > lowest + np.float32(spread_m)
    return found


@compiled
def echoes(
    ranges_m: Array32,
    fractions: Array32,
    drone: NDArray[np.uint8],
    shares: Array64,
    threshold: Array64,
    min_range_m: float,
    return_mode: str,
) -> tuple[Array64, Array64, Array64, NDArray[np.uint8]]:
    """Returns of pulses (n,) with k sub-rays: range, power, power from a drone, and number of that drone.

    Each is (1, n), in dual mode (2, n). Drone 0 means none; of two drones in one echo it is the farther.

    Sub-rays, sorted by range, join one echo while the next is within the pulse length of the one before. The range of
    an echo is the mean weighted by power = share * fraction / range^2. Echoes below the threshold (n,) of the pulse and
    below the minimum range are not detected. Dual mode returns the strongest echo, then the last; when the strongest is
    the last, the second strongest, then the last; a single echo is returned twice (user manual, section 9.3).
    """
    count, rays = ranges_m.shape
    rows = 2 if return_mode == "dual" else 1
    result = np.zeros((rows, count))
    power = np.zeros((rows, count))
    from_drone = np.zeros((rows, count))
    which = np.zeros((rows, count), dtype=np.uint8)
    order = np.empty(rays, dtype=np.int64)
    echo_range, echo_power, echo_drone = np.empty(rays), np.empty(rays), np.empty(rays)
    echo_which = np.empty(rays, dtype=np.uint8)
    for i in range(count):
        for k in range(rays):  # insertion sort: short and nearly sorted
            j = k
            while j > 0 and ranges_m[i, order[j - 1]] > ranges_m[i, k]:
                order[j] = order[j - 1]
                j -= 1
            order[j] = k
        found, previous = -1, -np.inf
        for k in order:
            r = float(ranges_m[i, k])
            if not np.isfinite(r):
                break
            if r - previous > PULSE_LENGTH_M:
                if found < 0 or echo_power[found] >= threshold[i]:  # a weaker echo is overwritten
                    found += 1
                echo_range[found], echo_power[found], echo_drone[found], echo_which[found] = 0.0, 0.0, 0.0, 0
            previous = r
            if r >= min_range_m:
                p = shares[k] * fractions[i, k] / (r * r)
                echo_range[found] += p * r
                echo_power[found] += p
                if drone[i, k]:
                    echo_drone[found] += p
                    echo_which[found] = drone[i, k]
        if found >= 0 and echo_power[found] < threshold[i]:
            found -= 1
        if found < 0:
            continue
        last, strongest = found, np.argmax(echo_power[: found + 1])
        if return_mode == "dual" and strongest == last and last > 0:
            strongest = np.argmax(echo_power[:last])
        first = last if return_mode == "last" else strongest
        for row in range(rows):
            e = first if row == 0 else last
            result[row, i] = echo_range[e] / echo_power[e]
            power[row, i] = echo_power[e]
            from_drone[row, i] = echo_drone[e]
            which[row, i] = echo_which[e]
    return result, power, from_drone, which

"""Compiled functions that find minima of a score image and count the pixels around them.

Source: see `stages/detect/paper/kernel_candidates.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

INFINITY_BITS = 0x7F80_0000  # of a float32; those of finite numbers from 0 up are lower, those of NaN are not


@compiled
def lowest_indices(bits: NDArray[np.uint32], few: int) -> NDArray[np.int64]:
    """Indices of the `few` lowest scores, and all others with the same upper 16 bits. NaN is no score.

    A histogram instead of a partition: its time does not depend on the scores.
    """
    counts = np.zeros(INFINITY_BITS >> 16, dtype=np.int64)
    for value in bits:
        if value < INFINITY_BITS:
            counts[value >> 16] += 1
    total, limit = 0, 0
    for upper in range(counts.size):
        total += counts[upper]
        limit = upper
        if total >= few:
            break
    pixels = np.empty(total, dtype=np.int64)
    n = 0
    for i in range(bits.size):
        if bits[i] < INFINITY_BITS and bits[i] >> 16 <= limit:
            pixels[n] = i
            n += 1
    return pixels


@compiled
def minima(
    order: NDArray[np.int64],
    depth_m: NDArray[np.float32],
    radius_px: int,
    same_m: float,
    at_most: int,
) -> NDArray[np.int64]:
    """(row, column) (n, 2) of the local minima among the pixels in `order`, lowest score first, at most `at_most`.

    A minimum suppresses the pixels within radius_px whose depth differs by at most same_m.
    """
    height, width = depth_m.shape
    suppressed = np.zeros((height, width), dtype=np.bool_)
    found = np.empty((at_most, 2), dtype=np.int64)
    n = 0
    for i in range(order.size):
        if n == at_most:
            break
        row, column = order[i] // width, order[i] % width
        if suppressed[row, column]:
            continue
        found[n, 0], found[n, 1] = row, column
        n += 1
        for v in range(max(0, row - radius_px), min(height, row + radius_px + 1)):
            for u in range(max(0, column - radius_px), min(width, column + radius_px + 1)):
                if abs(depth_m[v, u] - depth_m[row, column]) <= same_m:
                    suppressed[v, u] = True
    return found[:n]


@compiled
def distance_m(depth_m: NDArray[np.float32], focal_px: float, centre_m: Array64, v: int, u: int) -> float:
    """Distance from centre_m (3,), counted from the image's origin, to the point of a filled pixel."""
    height, width = depth_m.shape
    d = depth_m[v, u]
    x = (u + 0.5 - 0.5 * width) / focal_px * d - centre_m[0]
    y = (v + 0.5 - 0.5 * height) / focal_px * d - centre_m[1]
    return math.sqrt(x * x + y * y + (d - centre_m[2]) ** 2)


@compiled
def box_px(shape: tuple[int, int], focal_px: float, centre_m: Array64, far_m: float) -> tuple[int, int, int]:
    """(row, column, reach): points within far_m of centre_m project within `reach` pixels of it.

    |x / d - x_c / d_c| <= far (1 + |x_c| / d_c) / d. Points nearer than half the centre's depth are ignored.
    """
    height, width = shape
    x, y, depth = centre_m
    column = math.floor(focal_px * x / depth + 0.5 * width)
    row = math.floor(focal_px * y / depth + 0.5 * height)
    slant = max(abs(x), abs(y)) / depth
    return row, column, 1 + math.ceil(focal_px * far_m * (1.0 + slant) / max(depth - far_m, 0.5 * depth))


@compiled
def own_pixels(depth_m: NDArray[np.float32], focal_px: float, centre_m: Array64, near_m: float) -> NDArray[np.int64]:
    """(row, column) (n, 2) of the filled pixels whose points lie within near_m of centre_m."""
    height, width = depth_m.shape
    row, column, reach = box_px(depth_m.shape, focal_px, centre_m, near_m)
    top, bottom = max(0, row - reach), min(height, row + reach + 1)
    left, right = max(0, column - reach), min(width, column + reach + 1)
    pixels = np.empty(((bottom - top) * (right - left), 2), dtype=np.int64)
    n = 0
    for v in range(top, bottom):
        for u in range(left, right):
            if depth_m[v, u] > 0.0 and distance_m(depth_m, focal_px, centre_m, v, u) <= near_m:
                pixels[n, 0], pixels[n, 1] = v, u
                n += 1
    return pixels[:n]


@compiled
def middle_m(depth_m: NDArray[np.float32], focal_px: float, pixels: NDArray[np.int64]) -> Array64:
    """Mean (3,) of the points of pixels (n, 2), n > 0, counted from the image's origin."""
    height, width = depth_m.shape
    total = np.zeros(3)
    for v, u in pixels:
        d = depth_m[v, u]
        total[0] += (u + 0.5 - 0.5 * width) / focal_px * d
        total[1] += (v + 0.5 - 0.5 * height) / focal_px * d
        total[2] += d
    return total / len(pixels)


@compiled
def neighbour_pixels(
    depth_m: NDArray[np.float32], focal_px: float, centre_m: Array64, near_m: float, far_m: float, enough: int
) -> int:
    """Filled pixels whose points lie between near_m and far_m from centre_m; counting ends at `enough`."""
    height, width = depth_m.shape
    row, column, reach = box_px(depth_m.shape, focal_px, centre_m, far_m)
    count = 0
    for ring in range(reach + 1):  # outwards: a wall reaches `enough` in the first rings
        for v in range(max(0, row - ring), min(height, row + ring + 1)):
            step = 1 if abs(v - row) == ring else 2 * ring
            for u in range(column - ring, column + ring + 1, step):
                if 0 <= u < width and depth_m[v, u] > 0.0:
                    if near_m < distance_m(depth_m, focal_px, centre_m, v, u) <= far_m:
                        count += 1
                    if count >= enough:
                        return count
    return count

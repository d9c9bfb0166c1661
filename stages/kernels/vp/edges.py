"""Compiled functions that find the edge threshold of an image and follow edge ridges into chains.

Source: see `stages/vp/edges.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.kernels.compiled import compiled

Grey = NDArray[np.uint8]
Slopes = NDArray[np.int16]
LEVELS = 16  # number of bins of the grey levels
QUIET_QUANTILE = 0.3  # of |slope|: mostly noise, even in an image with many edges
QUIET_SIGMAS = 0.385  # the same quantile of the absolute value of a standard normal
NOISE_SIGMAS = 5.0
SOBEL_GAIN = 4.6  # slope of a step of one grey level after the blur, in both Sobel columns
STRIDE = 2  # every second pixel of a chain is returned: the one between adds no information
LOW_SHARE = 0.5  # a chain continues down to this share of its start threshold


@compiled
def thresholds(
    grey: Grey, dx: Slopes, dy: Slopes, usable: NDArray[np.uint8], min_contrast: float
) -> NDArray[np.float32]:
    """Squared slope (LEVELS,) threshold of an edge per grey level: NOISE_SIGMAS of the noise there."""
    counts = np.zeros((LEVELS, 64), dtype=np.int64)
    for y in range(2, grey.shape[0] - 2, 4):
        for x in range(2, grey.shape[1] - 2, 4):
            if usable[y, x]:
                level = grey[y, x] * LEVELS // 256
                counts[level, min(abs(dx[y, x]), 63)] += 1
                counts[level, min(abs(dy[y, x]), 63)] += 1
    out = np.empty(LEVELS, dtype=np.float32)
    for level in range(LEVELS):
        wanted = QUIET_QUANTILE * counts[level].sum()
        below, k = 0.0, 0
        while k < 63 and below + counts[level, k] < wanted:
            below += counts[level, k]
            k += 1
        share = (wanted - below) / counts[level, k] if counts[level, k] else 0.0
        quantile = max(k - 0.5 + share, 0.0)  # slopes are whole numbers
        noise = min(quantile / QUIET_SIGMAS, 4.0 * SOBEL_GAIN)
        out[level] = max(min_contrast * SOBEL_GAIN, NOISE_SIGMAS * noise) ** 2
    return out


@compiled
def follow(
    grey: Grey,
    dx: Slopes,
    dy: Slopes,
    free: NDArray[np.uint8],
    threshold: NDArray[np.float32],
    min_points: int,
    points: NDArray[np.float32],
    start: NDArray[np.int64],
    back: NDArray[np.float32],
) -> tuple[int, int]:
    """Follow chains from seeds on a lattice that no straight 8-connected run of five pixels misses.

    Returns the number of points and of chains. `free` is used up; it is 0 in a border of two pixels.
    """
    height, width = grey.shape
    flat_x, flat_y, flat_free = dx.ravel(), dy.ravel(), free.ravel()
    most, lowest = len(back), threshold.min()  # decides most pixels alone
    chains, count = 0, 0
    for y in range(2, height - 2):
        for x in range(2 + (2 * y) % 5, width - 2, 5):
            gx, gy = np.int32(dx[y, x]), np.int32(dy[y, x])
            square = gx * gx + gy * gy
            if square < lowest or square < threshold[grey[y, x] * LEVELS // 256] or not free[y, x]:
                continue
            at = y * width + x
            across = 1 if abs(gx) > abs(gy) else width  # is it the ridge?
            ahead = gx * flat_x[at + across] + gy * flat_y[at + across]
            behind = gx * flat_x[at - across] + gy * flat_y[at - across]
            if ahead > square or behind > square or count + 2 * most > len(points) or chains + 2 > len(start):
                continue
            low = int(LOW_SHARE * LOW_SHARE * threshold[grey[y, x] * LEVELS // 256])
            backward = _follow(flat_x, flat_y, flat_free, width, at, -1, low, back)
            for k in range(backward):
                points[count + k] = back[backward - 1 - k]
            forward = _follow(flat_x, flat_y, flat_free, width, at, 1, low, back)  # begins with the seed again
            for k in range(1, forward):
                points[count + backward + k - 1] = back[k]
            total = backward + forward - 1
            if total >= min_points:
                count += total
                chains += 1
                start[chains] = count
    return count, chains


@compiled
def _follow(
    dx: Slopes, dy: Slopes, free: NDArray[np.uint8], width: int, at: int, way: int, low: int, out: NDArray[np.float32]
) -> int:
    """Follow the ridge with the brighter side on the left (way 1) or right (-1); returns the number of points.

    Images are flattened: pixel `at` is column at % width of row at // width.
    """
    count = 0
    row, column = at // width, at % width
    gx, gy = np.int64(dx[at]), np.int64(dy[at])
    steps = 0
    while count < len(out):
        square = gx * gx + gy * gy
        steep_x = abs(gx) > abs(gy)
        across = 1 if steep_x else width
        if steps % STRIDE == 0:
            one, other = np.uint64(at + across), np.uint64(at - across)
            ahead = gx * dx[one] + gy * dy[one]
            behind = gx * dx[other] + gy * dy[other]
            curve = 2 * square - ahead - behind
            shift = 0.5 * (ahead - behind) / curve if curve > 0 else 0.0
            shift = min(max(shift, -0.6), 0.6)
            out[count, 0] = column + (shift if steep_x else 0.0)
            out[count, 1] = row + (0.0 if steep_x else shift)
            count += 1
        steps += 1
        free[np.uint64(at)], free[np.uint64(at + across)], free[np.uint64(at - across)] = 0, 0, 0
        # the edge runs across the gradient: one step along its main axis, to the steepest of three pixels
        step = (way if gx > 0 else -way) if steep_x else (-way if gy > 0 else way)
        ahead_at = at + (step * width if steep_x else step)
        best, best_side = np.int64(low), 2
        next_x, next_y = gx, gy
        for side in range(-1, 2):
            to = np.uint64(ahead_at + side * across)  # as this is never negative, no index is wound around
            if free[to]:
                hx, hy = np.int64(dx[to]), np.int64(dy[to])
                steep, dot = hx * hx + hy * hy, gx * hx + gy * hy
                if steep > best and dot > 0 and 2 * dot * dot > square * steep:  # turned by less than 45 deg
                    best, best_side, next_x, next_y = steep, side, hx, hy
        if best_side == 2:
            break
        at = ahead_at + best_side * across
        row += step if steep_x else best_side
        column += best_side if steep_x else step
        gx, gy = next_x, next_y
    return count

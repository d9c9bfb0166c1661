"""Compiled functions that compute the gradient of an image, find its edge threshold and follow ridges into chains.

Source: see `stages/vp/edges.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.kernels.compiled import compiled

Grey = NDArray[np.uint8]
Row = NDArray[np.int16]
Slopes = NDArray[np.int32]  # bit 0: the pixel is free; bits 1 to 15: slope along the row; 16 to 31: along the column
FREE = 1
REACH = 2  # of the gradient: it has 5 x 5 pixels
LATTICE = 7  # a seed in each LATTICE columns of a row, shifted by 2 from row to row
LEVELS = 16  # number of bins of the grey levels
NOISE_ROWS = 6  # the noise is that of the seeds in every NOISE_ROWS-th row
BINS, BIN_SLOPE = 64, 8  # of the histogram of |slope|
QUIET_QUANTILE = 0.3  # of |slope|: mostly noise, even in an image with many edges
QUIET_SIGMAS = 0.385  # the same quantile of the absolute value of a standard normal
NOISE_SIGMAS = 5.0
SLOPE = 74.0  # required for one grey level of contrast; a sharp step of one level has 48
STRIDE = 2  # every second pixel of a chain is returned: the one between adds no information
LOW_SHARE = 0.5  # a chain continues down to this share of its start threshold


@compiled
def slopes_and_seeds(
    grey: Grey,
    usable: NDArray[np.uint8],
    span: NDArray[np.int64],
    least: float,
    slopes: Slopes,
    smooth: Row,
    steep: Row,
    seeds: NDArray[np.int64],
) -> tuple[int, NDArray[np.int64]]:
    """Write the gradient inside `span` (h, 2) of each row, and the seeds: ridge pixels of a lattice.

    No straight 8-connected run of five pixels misses the lattice. Returns the number of seeds with a squared slope of
    at least `least`, and the histogram (LEVELS, BINS) of |slope| by grey level.
    """
    height, width = grey.shape
    counts = np.zeros((LEVELS, BINS), dtype=np.int64)
    flat, count = slopes.ravel(), 0
    for y in range(REACH, height - REACH):
        first, last = span[y, 0], span[y, 1]
        if last > first:
            left, right = first - REACH, last + REACH
            rows = (grey[y - 2, left:right], grey[y - 1, left:right], grey[y, left:right])
            more = (grey[y + 1, left:right], grey[y + 2, left:right])
            _across_rows(rows[0], rows[1], rows[2], more[0], more[1], smooth[: right - left], steep[: right - left])
            _along_row(smooth[: right - left], steep[: right - left], usable[y, first:last], slopes[y, first:last])
        y_seed = y - 1  # its neighbours are known by now
        first, last = span[y_seed, 0], span[y_seed, 1]
        if y_seed % NOISE_ROWS == 0:
            _count(grey[y_seed], slopes[y_seed], first, last, counts)
        for x in range(first + (2 * y_seed - first) % LATTICE, last, LATTICE):
            at = y_seed * width + x
            slope = flat[np.uint64(at)]
            gx, gy = _both(slope)
            square = gx * gx + gy * gy
            if square < least or not slope & FREE:
                continue
            across = 1 if abs(gx) > abs(gy) else width  # is it the ridge?
            ax, ay = _both(flat[np.uint64(at + across)])
            bx, by = _both(flat[np.uint64(at - across)])
            if gx * ax + gy * ay <= square and gx * bx + gy * by <= square:
                seeds[count] = at
                count += 1
    return count, counts


@compiled
def _across_rows(a: Grey, b: Grey, c: Grey, d: Grey, e: Grey, smooth: Row, steep: Row) -> None:
    """(1 4 6 4 1) and (-1 -2 0 2 1) over five rows; in two loops, which compile to 16 bit arithmetic."""
    for i in range(len(smooth)):
        smooth[i] = np.int16(a[i]) + np.int16(e[i]) + 4 * (np.int16(b[i]) + np.int16(d[i])) + 6 * np.int16(c[i])
    for i in range(len(steep)):
        steep[i] = np.int16(e[i]) - np.int16(a[i]) + 2 * (np.int16(d[i]) - np.int16(b[i]))


@compiled
def _along_row(smooth: Row, steep: Row, usable: NDArray[np.uint8], out: Slopes) -> None:
    """(-1 -2 0 2 1) of smooth and (1 4 6 4 1) of steep along the row, and whether each pixel is usable."""
    n = len(out)
    a, b, d, e = smooth[:n], smooth[1 : n + 1], smooth[3 : n + 3], smooth[4 : n + 4]
    p, q, r, s, t = steep[:n], steep[1 : n + 1], steep[2 : n + 2], steep[3 : n + 3], steep[4 : n + 4]
    for i in range(n):
        gx = np.int16(e[i] - a[i] + 2 * (d[i] - b[i]))
        gy = np.int16(p[i] + t[i] + 4 * (q[i] + s[i]) + 6 * r[i])
        out[i] = np.int32(gy) * 65536 + np.int32(np.uint16(gx) & 0xFFFE) + np.int32(usable[i])


@compiled
def _both(slope: np.int32) -> tuple[int, int]:
    """Slopes along the row and along the column."""
    return np.int32(np.int16(slope & ~FREE)), np.int32(slope >> 16)  # pyright: ignore[reportReturnType]


@compiled
def _count(
    grey: NDArray[np.uint8],
    slopes: NDArray[np.int32],
    first: int,
    last: int,
    counts: NDArray[np.int64],
) -> None:
    for x in range(first, last, LATTICE):
        slope = slopes[np.uint64(x)]
        if slope & FREE:
            gx, gy = _both(slope)
            level = grey[np.uint64(x)] * LEVELS // 256
            counts[level, min(abs(gx) // BIN_SLOPE, BINS - 1)] += 1
            counts[level, min(abs(gy) // BIN_SLOPE, BINS - 1)] += 1


@compiled
def thresholds(counts: NDArray[np.int64], min_contrast: float) -> NDArray[np.float32]:
    """Squared slope (LEVELS,) threshold of an edge per grey level: NOISE_SIGMAS of the noise there."""
    out = np.empty(LEVELS, dtype=np.float32)
    for level in range(LEVELS):
        wanted = QUIET_QUANTILE * counts[level].sum()
        below, k = 0.0, 0
        while k < BINS - 1 and below + counts[level, k] < wanted:
            below += counts[level, k]
            k += 1
        share = (wanted - below) / counts[level, k] if counts[level, k] else 0.0
        noise = min(BIN_SLOPE * (k + share) / QUIET_SIGMAS, 4.0 * SLOPE)
        out[level] = max(min_contrast * SLOPE, NOISE_SIGMAS * noise) ** 2
    return out


@compiled
def follow(
    grey: Grey,
    slopes: Slopes,
    seeds: NDArray[np.int64],
    threshold: NDArray[np.float32],
    min_points: int,
    points: NDArray[np.float32],
    start: NDArray[np.int64],
    back: NDArray[np.float32],
) -> tuple[int, int]:
    """Follow chains from the seeds; returns the number of points and of chains.

    Pixels next to a chain are free no more; none is free in a border of REACH + 1 pixels.
    """
    width = grey.shape[1]
    flat, levels = slopes.ravel(), grey.ravel()
    most = len(back)
    chains, count = 0, 0
    for at in seeds:
        slope = flat[np.uint64(at)]
        gx, gy = _both(slope)
        limit = threshold[levels[np.uint64(at)] * LEVELS // 256]
        if gx * gx + gy * gy < limit or not slope & FREE:
            continue
        if count + 2 * most > len(points) or chains + 2 > len(start):
            break
        low = int(LOW_SHARE * LOW_SHARE * limit)
        backward = _follow(flat, width, at, -1, low, back)
        for k in range(backward):
            points[count + k] = back[backward - 1 - k]
        forward = _follow(flat, width, at, 1, low, back)  # begins with the seed again
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
    slopes: NDArray[np.int32],
    width: int,
    at: int,
    way: int,
    low: int,
    out: NDArray[np.float32],
) -> int:
    """Follow the ridge with the brighter side on the left (way 1) or right (-1); returns the number of points.

    Images are flattened: pixel `at` is column at % width of row at // width.
    """
    count = 0
    row, column = at // width, at % width
    gx, gy = _both(slopes[np.uint64(at)])
    steps = 0
    while count < len(out):
        square = np.int64(gx * gx + gy * gy)
        steep_x = abs(gx) > abs(gy)
        across = 1 if steep_x else width
        if steps % STRIDE == 0:
            ax, ay = _both(slopes[np.uint64(at + across)])
            bx, by = _both(slopes[np.uint64(at - across)])
            ahead, behind = gx * ax + gy * ay, gx * bx + gy * by
            curve = 2 * square - ahead - behind
            shift = 0.5 * (ahead - behind) / curve if curve > 0 else 0.0
            shift = min(max(shift, -0.6), 0.6)
            out[count, 0] = column + (shift if steep_x else 0.0)
            out[count, 1] = row + (0.0 if steep_x else shift)
            count += 1
        steps += 1
        slopes[np.uint64(at)] &= ~FREE
        slopes[np.uint64(at + across)] &= ~FREE
        slopes[np.uint64(at - across)] &= ~FREE
        # the edge runs across the gradient: one step along its main axis, to the steepest of three pixels
        step = (way if gx > 0 else -way) if steep_x else (-way if gy > 0 else way)
        ahead_at = at + (step * width if steep_x else step)
        best, best_side, next_x, next_y = np.int64(low), 2, gx, gy
        for side in range(-1, 2):
            to = np.uint64(ahead_at + side * across)  # as this is never negative, no index is wound around
            slope = slopes[to]
            if slope & FREE:
                hx, hy = _both(slope)
                more, dot = np.int64(hx * hx + hy * hy), np.int64(gx * hx + gy * hy)
                if more > best and dot > 0 and 2 * dot * dot > square * more:  # turned by less than 45 deg
                    best, best_side, next_x, next_y = more, side, hx, hy
        if best_side == 2:
            break
        at = ahead_at + best_side * across
        row += step if steep_x else best_side
        column += best_side if steep_x else step
        gx, gy = next_x, next_y
    return count

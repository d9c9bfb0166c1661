"""Compiled functions that compute the paper's detector score, Equations (2) to (5), per pixel.

Source: see `stages/detect/paper/kernel_candidates.py`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.kernels.compiled import compiled

RUN_PX = 128  # at most so many pixels of a row go through the boxes side by side


@compiled
def closeness(difference_1_m: np.float32, difference_2_m: np.float32, eps_m: np.float32) -> np.float32:
    """Equation (5) of two pixels: 1 / eps up to eps, 1 / |d| beyond. One division: 1/p + 1/q = (p + q) / (p q)."""
    p, q = abs(difference_1_m), abs(difference_2_m)
    p, q = p if p > eps_m else eps_m, q if q > eps_m else eps_m
    return np.true_divide(p + q, p * q)  # without Python's check for zero, which eps rules out, the loop becomes SIMD


@compiled
def score_kernel(
    depth_m: NDArray[np.float32],
    padded: NDArray[np.float32],
    far: NDArray[np.float32],
    pad: int,
    span_px_m: np.float32,
    half_outer: int,
    eps_m: np.float32,
    nearest_m: float,
    score: NDArray[np.float32],
) -> None:
    """Add the boxes up offset by offset; `half` is each pixel's inner half side, so a ring `<= half` is inner.

    Plain IEEE sums in one order: any machine gives the same bits.
    """
    height, width = depth_m.shape
    zero = np.float32(0.0)
    total = np.empty(RUN_PX, dtype=np.float32)
    half = np.empty(RUN_PX, dtype=np.float32)
    for v in range(height):
        left = 0
        while left < width:
            if depth_m[v, left] < nearest_m:  # a run starts at a candidate ...
                left += 1
                continue
            n = min(RUN_PX, width - left)
            while depth_m[v, left + n - 1] < nearest_m:  # ... and ends at one
                n -= 1
            own = depth_m[v, left : left + n]
            least, most = pad + 1, -1
            for i in range(n):
                total[i] = zero
                half[i] = zero
                if own[i] >= nearest_m:
                    k = int(span_px_m / own[i] * np.float32(0.5))
                    half[i] = k
                    least, most = min(least, k), max(most, k)
            reach = max(half_outer, most)
            column = pad + left
            for dv in range(reach + 1):
                for du in range(1, reach + 1):
                    # an offset and its rotations by multiples of 90 deg: all but (0, 0) come once, four in one pass
                    ring = max(dv, du)
                    edge = np.float32(ring)
                    if ring > least and ring <= half_outer:  # outer box, Equations (4) and (5)
                        a = far[pad + v + dv, column + du : column + du + n]
                        b = far[pad + v + du, column - dv : column - dv + n]
                        c = far[pad + v - dv, column - du : column - du + n]
                        d = far[pad + v - du, column + dv : column + dv + n]
                        for i in range(n):
                            d_c = own[i]
                            terms = closeness(a[i] - d_c, c[i] - d_c, eps_m) + closeness(b[i] - d_c, d[i] - d_c, eps_m)
                            total[i] += terms if half[i] < edge else zero
                    if ring <= most:  # inner box, Equation (2)
                        a = padded[pad + v + dv, column + du : column + du + n]
                        b = padded[pad + v + du, column - dv : column - dv + n]
                        c = padded[pad + v - dv, column - du : column - du + n]
                        d = padded[pad + v - du, column + dv : column + dv + n]
                        for i in range(n):
                            d_c = own[i]
                            terms = abs(a[i] - d_c) + abs(b[i] - d_c) + abs(c[i] - d_c) + abs(d[i] - d_c)
                            total[i] += terms if half[i] >= edge else zero
            for i in range(n):
                if own[i] >= nearest_m:
                    score[v, left + i] = total[i]
            left += n


@compiled
def kernel_terms(
    depth_m: NDArray[np.float32], row: int, column: int, half_inner: int, half_outer: int, eps_m: float
) -> tuple[float, float]:
    """(e_i, e_o) of one pixel: Equations (2), (4), (5) as printed, one loop over each box, in float64."""
    height, width = depth_m.shape
    d_c = float(depth_m[row, column])
    e_inner = e_outer = 0.0
    reach = max(half_inner, half_outer)
    for v in range(row - reach, row + reach + 1):
        for u in range(column - reach, column + reach + 1):
            d = float(depth_m[v, u]) if 0 <= v < height and 0 <= u < width else 0.0
            ring = max(abs(v - row), abs(u - column))
            if ring <= half_inner:
                e_inner += abs(d - d_c)
            elif ring <= half_outer and d > 0.0:
                e_outer += 1.0 / max(abs(d - d_c), eps_m)
    return e_inner, e_outer

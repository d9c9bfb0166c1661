"""Compiled functions that track image patches to some hundredths of a pixel, without drift.

A template keeps its first appearance and is warped by A (2, 2), the effect of rotation and lens on its pixels since:
Lucas-Kanade without a warp takes rotation for translation, and accumulates that error from image to image.

    r(d) = gain (I(p + A d) - mean I) - (T(d) - mean T),   step = (sum g g^T)^-1 sum g r,   p <- p - A step

with g the template's gradient: it never changes, so its Hessian is made once (inverse compositional).

Source: Baker and Matthews, Lucas-Kanade 20 years on (2004), section 3.2; ours: the warp.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

Array32 = NDArray[np.float32]
Grey = NDArray[np.uint8]

RADIUS_PX = 6
SIDE_PX = 2 * RADIUS_PX + 1
STEPS = 10
STEP_PX = 0.01
FARTHEST_PX = 3.0  # from the predicted position
ROUNDNESS = 0.14  # least det / trace^2 of the Hessian: a patch on an edge would slide along it
FLAT = 1.0  # grey levels, one sigma: least contrast of a patch


@compiled
def take(grey: Grey, pixel: Array64) -> Array32:
    """Templates (n, SIDE, SIDE) about pixels (n, 2), column and row. NaN beyond the image."""
    n = len(pixel)
    out = np.empty((n, SIDE_PX, SIDE_PX), dtype=np.float32)
    for i in range(n):
        for v in range(SIDE_PX):
            for u in range(SIDE_PX):
                out[i, v, u] = at(grey, pixel[i, 0] + u - RADIUS_PX, pixel[i, 1] + v - RADIUS_PX)
    return out


@compiled
def at(grey: Grey, column: float, row: float) -> float:
    """Bilinear interpolation of the grey level; NaN outside the image."""
    height, width = grey.shape
    if not (0.0 <= column < width - 1 and 0.0 <= row < height - 1):
        return math.nan
    i, j = int(row), int(column)
    a, b = row - i, column - j
    top = (1.0 - b) * grey[i, j] + b * grey[i, j + 1]
    low = (1.0 - b) * grey[i + 1, j] + b * grey[i + 1, j + 1]
    return (1.0 - a) * top + a * low


@compiled
def sample(grey: Grey, column: float, row: float, A: Array64, seen: Array64) -> bool:
    """Sample the image on a template's grid warped by A (2, 2), into `seen` (SIDE * SIDE). False: beyond the image.

    Rounding is monotonic, so that all samples lie between the corners and only these are checked.
    """
    height, width = grey.shape
    for dv in (-RADIUS_PX, RADIUS_PX):
        for du in (-RADIUS_PX, RADIUS_PX):
            x, y = column + A[0, 0] * du + A[0, 1] * dv, row + A[1, 0] * du + A[1, 1] * dv
            if not (0.0 <= y < height - 1 and 0.0 <= x < width - 1):  # NaN, too
                return False
    for v in range(SIDE_PX):
        dv = v - RADIUS_PX
        for u in range(SIDE_PX):
            du = u - RADIUS_PX
            x, y = column + A[0, 0] * du + A[0, 1] * dv, row + A[1, 0] * du + A[1, 1] * dv
            i, j = np.uint32(y), np.uint32(x)
            a, b = y - i, x - j
            top = (1.0 - b) * grey[i, j] + b * grey[i, j + 1]
            low = (1.0 - b) * grey[i + 1, j] + b * grey[i + 1, j + 1]
            seen[v * SIDE_PX + u] = (1.0 - a) * top + a * low
    return True


@compiled
def find(grey: Grey, templates: Array32, warp: Array64, guess: Array64) -> tuple[Array64, Array64]:
    """Pixels (n, 2) and correlation (n,), in [-1, 1]; -1 where it is not found.

    `warp` (n, 2, 2): the templates' warps A; `guess` (n, 2): initial positions.
    """
    n = len(guess)
    place = guess.copy()
    correlation = np.full(n, -1.0)
    size = SIDE_PX * SIDE_PX
    known, gx, gy, seen = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    for i in range(n):
        patch, A = templates[i], warp[i]
        mean = 0.0
        for v in range(SIDE_PX):
            for u in range(SIDE_PX):
                k = v * SIDE_PX + u
                left, right, up, down = max(u - 1, 0), min(u + 1, SIDE_PX - 1), max(v - 1, 0), min(v + 1, SIDE_PX - 1)
                known[k] = patch[v, u]
                gx[k] = (patch[v, right] - patch[v, left]) / (right - left)
                gy[k] = (patch[down, u] - patch[up, u]) / (down - up)
                mean += known[k]
        mean /= size
        gx -= gx.mean()
        gy -= gy.mean()
        energy = a = b = c = x_known = y_known = 0.0
        for k in range(size):
            known[k] -= mean
            energy += known[k] * known[k]
            a += gx[k] * gx[k]
            b += gx[k] * gy[k]
            c += gy[k] * gy[k]
            x_known += gx[k] * known[k]
            y_known += gy[k] * known[k]
        det = a * c - b * b
        if not (energy > size * FLAT * FLAT and det > ROUNDNESS * (a + c) ** 2):  # NaN too
            continue
        for _ in range(STEPS):
            if not sample(grey, place[i, 0], place[i, 1], A, seen):
                correlation[i] = -1.0
                break
            mean = 0.0
            for k in range(size):
                mean += seen[k]
            mean /= size
            power = product = x_seen = y_seen = 0.0
            for k in range(size):
                value = seen[k] - mean
                power += value * value
                product += value * known[k]
                x_seen += gx[k] * value
                y_seen += gy[k] * value
            if not power > size * FLAT * FLAT:
                correlation[i] = -1.0
                break
            gain = product / power
            correlation[i] = gain * math.sqrt(power / energy)
            r0, r1 = gain * x_seen - x_known, gain * y_seen - y_known
            s0, s1 = (c * r0 - b * r1) / det, (a * r1 - b * r0) / det
            length = math.hypot(s0, s1)
            if length > 1.0:
                s0, s1 = s0 / length, s1 / length
            place[i, 0] -= A[0, 0] * s0 + A[0, 1] * s1
            place[i, 1] -= A[1, 0] * s0 + A[1, 1] * s1
            if length < STEP_PX:
                break
        if math.hypot(place[i, 0] - guess[i, 0], place[i, 1] - guess[i, 1]) > FARTHEST_PX:
            correlation[i] = -1.0
    return place, correlation

"""Compiled functions that split edge chains into great-circle arcs and fit them.

Source: see `stages/vp/arcs.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.compiled import compiled

STEP_PX = 4  # of the table of rays

TRIMMED = 1  # points omitted at each end of a piece, bent by a corner
CORRELATED = 2.0  # number of neighbouring points with correlated errors
DEEPEST = 64  # depth of the stack of splits
WIDEST_RAD = 2.9  # an arc of half a turn has no plane
NORMAL, FIRST, LAST, SIGMA, EXTENT, MOMENTS = 0, 3, 6, 9, 10, 11  # columns of the table
COLUMNS = MOMENTS + 7  # six moments of the rays and their number
Vector = tuple[float, float, float]  # a tuple stays in registers in compiled code
Moments = tuple[float, float, float, float, float, float, float]


@compiled
def split_all(
    points: NDArray[np.float32],
    start: NDArray[np.int64],
    table: NDArray[np.float32],
    tolerance: float,
    min_extent: float,
    least_sigma: float,
    turn_rad_per_row: Array64,
    middle_row: float,
) -> Array64:
    rolls = bool(np.any(turn_rad_per_row != 0.0))
    most = 0
    for c in range(len(start) - 1):
        most = max(most, start[c + 1] - start[c])
    rays, away = np.empty((3, most)), np.empty(most)
    stack = np.empty((DEEPEST, 2), dtype=np.int64)
    rows = np.empty((len(points) // (2 * TRIMMED + 3) + 1, COLUMNS))
    count = 0
    for c in range(len(start) - 1):
        size = start[c + 1] - start[c]
        _rays(table, points[start[c] : start[c + 1]], rays)
        if rolls:
            for k in range(size):
                _turn(rays, k, points[start[c] + k, 1] - middle_row, turn_rad_per_row)
        stack[0, 0], stack[0, 1] = 0, size - 1
        waiting = 1
        while waiting > 0:
            waiting -= 1
            i, j = stack[waiting, 0], stack[waiting, 1]
            if j - i < 2 * TRIMMED + 2 or waiting + 2 > DEEPEST:
                continue
            split = _worst(rays, away, i, j, tolerance)
            if split >= 0:
                stack[waiting, 0], stack[waiting, 1] = split, j
                stack[waiting + 1, 0], stack[waiting + 1, 1] = i, split
                waiting += 2
            elif _fit_piece(rays, i + TRIMMED, j - TRIMMED, min_extent, least_sigma, rows[count]):
                count += 1
    return rows[:count].copy()


@compiled
def _rays(table: NDArray[np.float32], points: NDArray[np.float32], out: Array64) -> None:
    """Rays (3, ...) between pixels, bilinearly interpolated in the table: error at most 3e-5 rad."""
    x, y, z = out[0], out[1], out[2]
    for i in range(len(points)):
        at_x, at_y = points[i, 0] / STEP_PX, points[i, 1] / STEP_PX
        left, above = np.int32(at_x), np.int32(at_y)
        u, v = at_x - left, at_y - above
        column, row = np.uint64(left), np.uint64(above)  # unsigned: avoids the check for negative indices
        right, below = column + np.uint64(1), row + np.uint64(1)
        a, b, c, d = (1.0 - u) * (1.0 - v), u * (1.0 - v), (1.0 - u) * v, u * v
        one, two, three, four = table[row, column], table[row, right], table[below, column], table[below, right]
        x[i] = a * one[0] + b * two[0] + c * three[0] + d * four[0]
        y[i] = a * one[1] + b * two[1] + c * three[1] + d * four[1]
        z[i] = a * one[2] + b * two[2] + c * three[2] + d * four[2]
    for i in range(len(points)):
        scale = 1.0 / math.sqrt(x[i] * x[i] + y[i] * y[i] + z[i] * z[i])
        x[i] *= scale
        y[i] *= scale
        z[i] *= scale


@compiled
def _turn(rays: Array64, k: int, rows: float, turn_rad: Array64) -> None:
    """Rotate ray k by `rows` times the angle (3,), some degrees at most, to third order (Cayley's formula)."""
    a, b, c = 0.5 * rows * turn_rad[0], 0.5 * rows * turn_rad[1], 0.5 * rows * turn_rad[2]
    x, y, z = rays[0, k], rays[1, k], rays[2, k]
    u, v, w = x + b * z - c * y, y + c * x - a * z, z + a * y - b * x  # the ray and h x ray
    scale = 2.0 / (1.0 + a * a + b * b + c * c)
    rays[0, k] = x + scale * (b * w - c * v)
    rays[1, k] = y + scale * (c * u - a * w)
    rays[2, k] = z + scale * (a * v - b * u)


@compiled
def _worst(rays: Array64, away: Array64, i: int, j: int, tolerance: float) -> int:
    """The ray between i and j farthest from the circle through both, -1 when all are within the tolerance."""
    nx = rays[1, i] * rays[2, j] - rays[2, i] * rays[1, j]
    ny = rays[2, i] * rays[0, j] - rays[0, i] * rays[2, j]
    nz = rays[0, i] * rays[1, j] - rays[1, i] * rays[0, j]
    length = np.sqrt(nx * nx + ny * ny + nz * nz)
    if length < 1e-9:
        return (i + j) // 2
    x, y, z, off = rays[0, i + 1 : j], rays[1, i + 1 : j], rays[2, i + 1 : j], away[i + 1 : j]
    for k in range(len(off)):  # without a branch, so that several are done at once
        off[k] = abs(nx * x[k] + ny * y[k] + nz * z[k])
    worst, at = tolerance * length, -1
    for k in range(len(off)):
        if off[k] > worst:
            worst, at = off[k], i + 1 + k
    return at


@compiled
def _fit_piece(rays: Array64, i: int, j: int, min_extent: float, least_sigma: float, row: Array64) -> bool:
    """Fill a row of the table; False when the piece is too short."""
    xx, xy, xz, yy, yz, zz = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    for k in range(i, j + 1):
        x, y, z = rays[0, k], rays[1, k], rays[2, k]
        xx += x * x
        xy += x * y
        xz += x * z
        yy += y * y
        yz += y * z
        zz += z * z
    moments = (xx, xy, xz, yy, yz, zz, float(j - i + 1))
    first, last = (rays[0, i], rays[1, i], rays[2, i]), (rays[0, j], rays[1, j], rays[2, j])
    return fit_moments(moments, first, last, min_extent, least_sigma, row)


@compiled
def fit_moments(
    moments: Moments, first: Vector, last: Vector, min_extent: float, least_sigma: float, row: Array64
) -> bool:
    """Fit the circle to rays of these moments, from about `first` to about `last`. False: shorter than min_extent."""
    n = cross(first, last)
    extent = math.atan2(_length(n), dot(first, last))
    if not min_extent <= extent < WIDEST_RAD:
        return False
    n = _unit(n)
    m = _unit((first[0] + last[0], first[1] + last[1], first[2] + last[2]))
    t = cross(n, m)
    tt, tm, mm = _form(moments, t, t), _form(moments, t, m), _form(moments, m, m)
    tn, mn = _form(moments, t, n), _form(moments, m, n)
    det = tt * mm - tm * tm
    if det <= 1e-15:
        return False
    a, b = (tm * mn - mm * tn) / det, (tm * tn - tt * mn) / det
    n = _unit((n[0] + (a * t[0] + b * m[0]), n[1] + (a * t[1] + b * m[1]), n[2] + (a * t[2] + b * m[2])))
    count = moments[6]
    variance = max(max(_form(moments, n, n), 0.0) / max(count - 2.0, 1.0), least_sigma * least_sigma)
    row[SIGMA] = math.sqrt(variance * min(CORRELATED, 0.5 * count) * mm / det)
    row[EXTENT] = extent
    first, last = _onto(first, n), _onto(last, n)
    for k in range(3):
        row[NORMAL + k], row[FIRST + k], row[LAST + k] = n[k], first[k], last[k]
    for k in range(7):
        row[MOMENTS + k] = moments[k]
    return True


@compiled
def dot(a: Vector, b: Vector) -> float:
    """a . b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def cross(a: Vector, b: Vector) -> Vector:
    """a x b."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]


@compiled
def _length(a: Vector) -> float:
    return math.sqrt(dot(a, a))


@compiled
def _unit(a: Vector) -> Vector:
    length = _length(a)
    return a[0] / length, a[1] / length, a[2] / length


@compiled
def _onto(ray: Vector, n: Vector) -> Vector:
    """The ray projected onto the great circle with normal n."""
    off = dot(n, ray)
    return _unit((ray[0] - n[0] * off, ray[1] - n[1] * off, ray[2] - n[2] * off))


@compiled
def _form(moments: Moments, a: Vector, b: Vector) -> float:
    """a^T M b of the symmetric matrix in `moments`."""
    return (
        moments[0] * a[0] * b[0]
        + moments[1] * (a[0] * b[1] + a[1] * b[0])
        + moments[2] * (a[0] * b[2] + a[2] * b[0])
        + moments[3] * a[1] * b[1]
        + moments[4] * (a[1] * b[2] + a[2] * b[1])
        + moments[5] * a[2] * b[2]
    )

"""Compiled functions that merge arcs of the same great circle into lines.

Source: see `stages/vp/clustering.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.lens import Array64
from stages.kernels.compiled import compiled
from stages.kernels.vp.arcs import (
    COLUMNS,
    EXTENT,
    FIRST,
    MOMENTS,
    NORMAL,
    SIGMA,
    WIDEST_RAD,
    Moments,
    Vector,
    cross,
    dot,
    fit_moments,
)

TOGETHER_SIGMAS = 2.0  # additional tolerance, in sigmas of the circle's normal
GAP_RAD = 0.2  # largest gap between the ends of an arc and of the line


@compiled
def gather(arcs: Array64, near: float, least_sigma: float) -> Array64:
    """Merge arcs (n, COLUMNS) into lines: each arc, in order, takes the later ones that lie on its great circle."""
    count = len(arcs)
    ends = arcs[:, FIRST : FIRST + 6].copy()
    left = np.arange(count)  # indices not yet taken, in order
    waiting = count
    rows = np.empty((count, COLUMNS))
    made = 0
    while waiting > 0:
        i = left[0]
        n = (arcs[i, NORMAL], arcs[i, NORMAL + 1], arcs[i, NORMAL + 2])
        x = _ray(ends, i, 0)
        y = cross(n, x)  # angles along the circle are counted from its first end
        low, high = 0.0, float(arcs[i, EXTENT])
        xx, xy, xz, yy, yz, zz, rays = _moments(arcs, i)
        slack = min(TOGETHER_SIGMAS * arcs[i, SIGMA], 2.0 * near)
        kept = 0
        for k in range(1, waiting):
            j = left[k]
            left[kept] = j
            kept += 1
            one, other = _ray(ends, j, 0), _ray(ends, j, 1)
            if abs(dot(n, one)) > near + slack or abs(dot(n, other)) > near + slack:
                continue
            middle = 0.5 * (low + high)  # angles are wound about the middle of what is there
            first, last = _wound(one, x, y, middle), _wound(other, x, y, middle)
            if first > last:
                first, last = last, first
            wide = max(high, last) - min(low, first)
            if first > high + GAP_RAD or last < low - GAP_RAD or wide > WIDEST_RAD:
                continue
            low, high = min(low, first), max(high, last)
            more = _moments(arcs, j)
            xx, xy, xz = xx + more[0], xy + more[1], xz + more[2]
            yy, yz, zz, rays = yy + more[3], yz + more[4], zz + more[5], rays + more[6]
            kept -= 1
        waiting = kept
        total = (xx, xy, xz, yy, yz, zz, rays)
        if fit_moments(total, _at(low, x, y), _at(high, x, y), 0.0, least_sigma, rows[made]):
            made += 1
    return rows[:made].copy()


@compiled
def _ray(ends: Array64, i: int, which: int) -> Vector:
    return ends[i, 3 * which], ends[i, 3 * which + 1], ends[i, 3 * which + 2]


@compiled
def _moments(arcs: Array64, i: int) -> Moments:
    m = arcs[i, MOMENTS:]
    return m[0], m[1], m[2], m[3], m[4], m[5], m[6]


@compiled
def _at(angle: float, x: Vector, y: Vector) -> Vector:
    c, s = math.cos(angle), math.sin(angle)
    return c * x[0] + s * y[0], c * x[1] + s * y[1], c * x[2] + s * y[2]


@compiled
def _wound(ray: Vector, x: Vector, y: Vector, middle: float) -> float:
    angle = math.atan2(dot(ray, y), dot(ray, x))
    return angle + 2.0 * math.pi * round((middle - angle) / (2.0 * math.pi))

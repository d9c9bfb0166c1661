"""Lines: arcs that lie on one great circle, near each other, are one line, cut by trees, windows or the tracing.

What a facade repeats (sills, cornices, kerbs) is one observation, not ten: counting it ten times is how a covariance
becomes a lie.

Source: ours. DESIGN, Vision: cluster lines.
"""

from __future__ import annotations

import math

import numpy as np

from stages.compiled import compiled
from stages.lens import Array64
from stages.vp.arcs import COLUMNS, LEAST_SIGMA_PX, WIDEST_RAD, Arcs, arcs_of, cross, dot, fit_moments
from stages.vp.eye import Eye

TOGETHER_PX = 0.8  # how far an arc's ends may lie from a line's circle
TOGETHER_SIGMAS = 2.0  # of the circle's own turn, if that is more
GAP_RAD = 0.2  # between an arc's end and the line's


def cluster(arcs: Arcs, eye: Eye, most: int) -> Arcs:
    """The `most` widest lines, the widest first."""
    if len(arcs) == 0:
        return arcs
    order = np.argsort(-arcs.extent_rad, kind="stable")
    rows = _gather(
        arcs.normal[order],
        arcs.ends[order],
        arcs.sigma_rad[order],
        arcs.extent_rad[order],
        arcs.moments[order],
        TOGETHER_PX * eye.pixel_rad,
        LEAST_SIGMA_PX * eye.pixel_rad,
    )
    lines = arcs_of(rows)
    keep = np.argsort(-lines.extent_rad, kind="stable")[:most]
    return Arcs(
        lines.normal[keep], lines.ends[keep], lines.sigma_rad[keep], lines.extent_rad[keep], lines.moments[keep]
    )


@compiled
def _gather(
    normal: Array64, ends: Array64, sigma: Array64, extent: Array64, moments: Array64, near: float, least_sigma: float
) -> Array64:
    """Take arcs in their order; each draws in the ones after it that lie on its circle."""
    count = len(normal)
    left = np.arange(count)  # indices not yet taken, in order
    waiting = count
    rows = np.empty((count, COLUMNS))
    made = 0
    y = np.empty(3)
    while waiting > 0:
        i = left[0]
        n, x = normal[i], ends[i, 0]
        cross(n, x, y)  # angles along the circle are counted from its first end
        low, high = 0.0, float(extent[i])
        total = moments[i].copy()
        slack = min(TOGETHER_SIGMAS * sigma[i], 2.0 * near)
        kept = 0
        for k in range(1, waiting):
            j = left[k]
            left[kept] = j
            kept += 1
            if abs(dot(n, ends[j, 0])) > near + slack or abs(dot(n, ends[j, 1])) > near + slack:
                continue
            middle = 0.5 * (low + high)  # angles are wound about the middle of what is there
            first, last = _wound(ends[j, 0], x, y, middle), _wound(ends[j, 1], x, y, middle)
            if first > last:
                first, last = last, first
            wide = max(high, last) - min(low, first)
            if first > high + GAP_RAD or last < low - GAP_RAD or wide > WIDEST_RAD:
                continue
            low, high = min(low, first), max(high, last)
            total += moments[j]
            kept -= 1
        waiting = kept
        first_ray = math.cos(low) * x + math.sin(low) * y
        last_ray = math.cos(high) * x + math.sin(high) * y
        if fit_moments(total, first_ray, last_ray, 0.0, least_sigma, rows[made]):
            made += 1
    return rows[:made].copy()


@compiled
def _wound(ray: Array64, x: Array64, y: Array64, middle: float) -> float:
    angle = math.atan2(dot(ray, y), dot(ray, x))
    return angle + 2.0 * math.pi * round((middle - angle) / (2.0 * math.pi))

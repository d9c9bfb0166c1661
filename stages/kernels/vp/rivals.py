"""Compiled functions that compare how well two structures agree with parts of the lines.

Source: see `stages/vp/rivals.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.compiled import compiled_at_once
from stages.kernels.vp.directions import GATE, NONE, PARTS, all_directions, assign_kernel


@compiled_at_once("(float64[:, ::1], float64[:, ::1], float64[::1], float64[:, ::1])")
def equal_parts(normal: Array64, tangent: Array64, weight: Array64, axes: Array64) -> NDArray[np.int64]:
    """The part (m,) of each line: PARTS groups of neighbouring azimuths about axes[:, 2], of equal weight.

    They begin after the widest gap, so that they are as many in an image of 50 deg as in one of 360 deg.
    """
    count = len(normal)
    azimuth = np.empty(count)
    for i in range(count):
        n, t = normal[i], tangent[i]  # middle ray: t x n
        x, y, z = t[1] * n[2] - t[2] * n[1], t[2] * n[0] - t[0] * n[2], t[0] * n[1] - t[1] * n[0]
        along = x * axes[0, 0] + y * axes[1, 0] + z * axes[2, 0]
        left = x * axes[0, 1] + y * axes[1, 1] + z * axes[2, 1]
        azimuth[i] = math.atan2(left, along)
    order = np.argsort(azimuth)
    first, widest = 0, azimuth[order[0]] - azimuth[order[count - 1]] + 2.0 * math.pi
    for k in range(1, count):
        gap = azimuth[order[k]] - azimuth[order[k - 1]]
        if gap > widest:
            first, widest = k, gap
    part = np.empty(count, dtype=np.int64)
    total, so_far = max(weight.sum(), 1e-9), 0.0
    for k in range(count):
        i = order[(first + k) % count]
        so_far += weight[i]
        part[i] = min(int(PARTS * so_far / total), PARTS - 1)
    return part


@compiled_at_once(
    "(float64[:, ::1], float64[:, ::1], float64[::1], float64[::1], float64[:, ::1], float64, int64[::1])"
)
def agreement_of_parts(
    normal: Array64,
    tangent: Array64,
    sigma: Array64,
    weight: Array64,
    axes: Array64,
    sigma_model: float,
    part: NDArray[np.int64],
) -> Array64:
    """Agreement (PARTS,) of one Manhattan frame with the lines of each part, as in `refine_kernel`."""
    assigned, r, spread = assign_kernel(normal, tangent, sigma, all_directions(axes, np.zeros(1)), sigma_model)
    out = np.zeros(PARTS)
    for i in range(len(normal)):
        if assigned[i] != NONE:
            out[part[i]] += weight[i] * max(1.0 - (r[i] / (GATE * spread[i])) ** 2, 0.0)
    return out

"""Compiled functions that build the yaw spectrum of lines and find its peaks.

Source: see `stages/vp/spectrum.py`.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.compiled import compiled

APART_RAD = math.radians(6.0)  # least difference of two horizontal pairs
WIDEST_RAD = math.radians(6.0)  # lines with a larger yaw sigma are ignored


@compiled
def spread(
    normal: Array64,
    tangent: Array64,
    sigma_rad: Array64,
    weights: Array64,
    axes: Array64,
    free: NDArray[np.bool_],
    sigma_model: float,
    middles: Array64,
) -> tuple[Array64, float, float]:
    quarter = 0.5 * math.pi
    bins = len(middles)
    step = middles[1] - middles[0]
    total = np.zeros(bins)
    mean, variance = 0.0, 0.0
    for i in range(len(normal)):
        if not free[i]:
            continue
        n, t = normal[i], tangent[i]
        x = n[0] * axes[0, 0] + n[1] * axes[1, 0] + n[2] * axes[2, 0]
        y = n[0] * axes[0, 1] + n[1] * axes[1, 1] + n[2] * axes[2, 1]
        level = max(math.hypot(x, y), 1e-6)
        # along n x v: (-y, x) / level in the axes' x and y
        along = t[0] * (x * axes[0, 1] - y * axes[0, 0])
        along += t[1] * (x * axes[1, 1] - y * axes[1, 0])
        along += t[2] * (x * axes[2, 1] - y * axes[2, 0])
        sigma = math.hypot(sigma_rad[i] * along / level, sigma_model) / level
        if not sigma < WIDEST_RAD:
            continue
        yaw = math.atan2(x, -y) % quarter
        weight = weights[i] * level
        reach = int(3.0 * sigma / step) + 1
        at = int(yaw / step)
        for k in range(at - reach, at + reach + 1):
            bin_ = k + bins if k < 0 else (k - bins if k >= bins else k)
            away = yaw - middles[bin_]
            if away > 0.5 * quarter:
                away -= quarter
            elif away < -0.5 * quarter:
                away += quarter
            total[bin_] += weight * math.exp(-0.5 * (away / sigma) ** 2)
        share = min(math.sqrt(2.0 * math.pi) * sigma / quarter, 1.0)  # the kernel's mean over all yaws
        mean += weight * share
        variance += weight**2 * max(share / math.sqrt(2.0) - share * share, 0.0)
    return total, mean, variance


@compiled
def peaks_kernel(yaw_rad: Array64, score: Array64, most: int) -> Array64:
    """The `most` highest peaks of a score over yaw, with period 90 deg, at least APART_RAD from each other."""
    quarter = 0.5 * math.pi
    out = np.empty(most)
    left = np.ones(len(score), dtype=np.bool_)
    for count in range(most):
        best = -1
        for k in range(len(score)):
            if left[k] and (best < 0 or score[k] > score[best]):
                best = k
        if best < 0:
            return out[:count].copy()
        out[count] = yaw_rad[best]
        for k in range(len(score)):
            difference = abs(yaw_rad[k] - yaw_rad[best])
            left[k] &= min(difference, quarter - difference) > APART_RAD
    return out

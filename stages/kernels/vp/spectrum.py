"""Compiled functions that build the yaw spectrum of lines, find its peaks, and test a peak on parts of the lines.

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
SECTORS = 8  # of azimuth about the camera, evenly spaced, overlapping
SECTOR_RAD = math.radians(90.0)
Level = tuple[float, float, float]


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
        azimuth, sigma, level = _level_direction(normal[i], tangent[i], sigma_rad[i], axes, sigma_model)
        if not sigma < WIDEST_RAD:
            continue
        yaw = azimuth % quarter
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
        chance = _by_chance(weight, sigma, quarter)
        mean += chance[0]
        variance += chance[1]
    return total, mean, variance


@compiled
def support(
    normal: Array64,
    tangent: Array64,
    sigma_rad: Array64,
    weights: Array64,
    axes: Array64,
    free: NDArray[np.bool_],
    sigma_model: float,
    yaw_rad: float,
) -> tuple[float, float]:
    """How well a horizontal pair at `yaw_rad` stands out in parts of its lines, in sd above random directions.

    The lower score of its two directions, and the lowest score of the pair without the lines in any SECTOR_RAD of
    azimuth about the camera: lines of one object lie in one sector.
    """
    quarter = 0.5 * math.pi
    direction = np.zeros((2, 3))  # sum, mean and variance of each direction
    whole = np.zeros(3)
    sector = np.zeros((SECTORS, 3))
    inside = math.cos(0.5 * SECTOR_RAD)
    for i in range(len(normal)):
        if not free[i]:
            continue
        n, t = normal[i], tangent[i]
        azimuth, sigma, level = _level_direction(n, t, sigma_rad[i], axes, sigma_model)
        if not sigma < WIDEST_RAD:
            continue
        weight = weights[i] * level
        of = np.zeros(2)
        for k in range(2):
            off = (azimuth - yaw_rad - k * quarter) % math.pi
            of[k] = weight * math.exp(-0.5 * (min(off, math.pi - off) / sigma) ** 2)
            mean, variance = _by_chance(weight, sigma, math.pi)
            direction[k] += np.array([of[k], mean, variance])
        mean, variance = _by_chance(weight, sigma, quarter)
        term = np.array([max(of[0], of[1]), mean, variance])
        whole += term
        middle = np.cross(t, n) @ axes  # the ray to the middle of the line, as t = n x m
        flat = max(math.hypot(middle[0], middle[1]), 1e-9)
        for k in range(SECTORS):
            centre = 2.0 * math.pi * k / SECTORS
            if (middle[0] * math.cos(centre) + middle[1] * math.sin(centre)) / flat > inside:
                sector[k] += term
    least = min(_score(direction[0]), _score(direction[1]))
    elsewhere = np.inf
    for k in range(SECTORS):
        elsewhere = min(elsewhere, _score(whole - sector[k]))
    return least, elsewhere


@compiled
def _score(sums: Array64) -> float:
    return (sums[0] - sums[1]) / math.sqrt(max(sums[2], 1e-9))


@compiled
def _level_direction(n: Array64, t: Array64, sigma_rad: float, axes: Array64, sigma_model: float) -> Level:
    """Azimuth of n x v, the direction of a horizontal line with normal n, its sigma, and |n x v|; v = axes[:, 2]."""
    x = n[0] * axes[0, 0] + n[1] * axes[1, 0] + n[2] * axes[2, 0]
    y = n[0] * axes[0, 1] + n[1] * axes[1, 1] + n[2] * axes[2, 1]
    level = max(math.hypot(x, y), 1e-6)
    # along n x v: (-y, x) / level in the axes' x and y
    along = t[0] * (x * axes[0, 1] - y * axes[0, 0])
    along += t[1] * (x * axes[1, 1] - y * axes[1, 0])
    along += t[2] * (x * axes[2, 1] - y * axes[2, 0])
    return math.atan2(x, -y), math.hypot(sigma_rad * along / level, sigma_model) / level, level


@compiled
def _by_chance(weight: float, sigma: float, period: float) -> tuple[float, float]:
    """Mean and variance of a line's kernel when its direction is uniform over the period."""
    share = min(math.sqrt(2.0 * math.pi) * sigma / period, 1.0)
    return weight * share, weight**2 * max(share / math.sqrt(2.0) - share * share, 0.0)


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

"""The yaw spectrum: how much line there is in each horizontal direction, modulo a quarter turn.

Source: ours. DESIGN, Vision: yaw spectra.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.compiled import compiled
from stages.lens import Array64
from stages.vp.directions import Lines

APART_RAD = math.radians(6.0)  # two horizontal pairs differ by more
WIDEST_RAD = math.radians(6.0)  # a line whose yaw is known worse tells nothing


@dataclass(frozen=True)
class Spectrum:
    """How much line there is in each horizontal direction, modulo 90 deg."""

    yaw_rad: Array64  # (b,) bin middles in the upright axes
    score: Array64  # (b,) in standard deviations over directions drawn at random
    lines: Array64  # (b,) sum of weights


def yaw_spectrum(lines: Lines, axes: Array64, free: NDArray[np.bool_], sigma_model: float, bins: int) -> Spectrum:
    """Each line, were it horizontal, runs along n x v; its yaw modulo a quarter turn, spread by its sigma.

    score = (S - E[S]) / sd[S] when all yaws were drawn at random.
    """
    flat = lines.normal @ axes[:, :2]
    level = np.hypot(flat[:, 0], flat[:, 1])
    yaw = np.arctan2(flat[:, 0], -flat[:, 1])  # of n x v
    along = axes[:, :2] @ np.array([np.cos(yaw), np.sin(yaw)])
    sigma_r = np.hypot(lines.sigma_rad * np.einsum("ij,ji->i", lines.tangent, along), 2.0 * sigma_model)
    sigma = sigma_r / np.maximum(level, 1e-6)
    use = free & (sigma < WIDEST_RAD)
    middles: Array64 = (np.arange(bins, dtype=np.float64) + 0.5) * (math.pi / 2 / bins)
    weight = lines.weight * level
    total, mean, variance = _spread(yaw[use], sigma[use], weight[use], middles)
    return Spectrum(middles, (total - mean) / math.sqrt(max(variance, 1e-12)), total)


@compiled
def _spread(yaw: Array64, sigma: Array64, weight: Array64, middles: Array64) -> tuple[Array64, float, float]:
    quarter = 0.5 * np.pi
    step = middles[1] - middles[0]
    total = np.zeros(len(middles))
    mean, variance = 0.0, 0.0
    for i in range(len(yaw)):
        reach = int(3.0 * sigma[i] / step) + 1
        at = int(np.floor((yaw[i] % quarter) / step))
        for k in range(at - reach, at + reach + 1):
            away = (yaw[i] - middles[k % len(middles)] + 0.5 * quarter) % quarter - 0.5 * quarter
            total[k % len(middles)] += weight[i] * np.exp(-0.5 * (away / sigma[i]) ** 2)
        share = min(np.sqrt(2.0 * np.pi) * sigma[i] / quarter, 1.0)  # the kernel's mean over all yaws
        mean += weight[i] * share
        variance += weight[i] ** 2 * max(share / np.sqrt(2.0) - share * share, 0.0)
    return total, mean, variance


def peaks(spectrum: Spectrum, most: int) -> list[float]:
    """Yaws of the highest places, each APART_RAD from the higher ones."""
    found: list[float] = []
    for k in np.argsort(-spectrum.score, kind="stable"):
        yaw = float(spectrum.yaw_rad[k])
        if all(abs(float(quarter(yaw - other))) > APART_RAD for other in found):
            found.append(yaw)
            if len(found) == most:
                break
    return found


def quarter(angle: Array64 | float) -> Array64 | float:
    """Wrapped into -45 to 45 deg."""
    return np.mod(angle + math.pi / 4, math.pi / 2) - math.pi / 4

"""The yaw spectrum: how much line there is in each horizontal direction, modulo a quarter turn.

Source: ours. DESIGN, Vision: yaw spectra.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.vp.spectrum import peaks_kernel, spread
from stages.vp.directions import Lines


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
    middles: Array64 = (np.arange(bins, dtype=np.float64) + 0.5) * (math.pi / 2 / bins)
    total, mean, variance = spread(
        lines.normal,
        lines.tangent,
        lines.sigma_rad,
        lines.weight,
        np.ascontiguousarray(axes),
        free,
        2.0 * sigma_model,
        middles,
    )
    return Spectrum(middles, (total - mean) / math.sqrt(max(variance, 1e-12)), total)


def peaks(spectrum: Spectrum, most: int) -> list[float]:
    """Yaws of the highest places, each APART_RAD from the higher ones."""
    return peaks_kernel(spectrum.yaw_rad, spectrum.score, most).tolist()


def quarter(angle: Array64 | float) -> Array64 | float:
    """Wrapped into -45 to 45 deg."""
    return np.mod(angle + math.pi / 4, math.pi / 2) - math.pi / 4

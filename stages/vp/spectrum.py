"""The yaw spectrum: weight of the lines along each horizontal direction, modulo 90 deg.

Source: ours. DESIGN, Vision: yaw spectra.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.lens import Array64
from stages.kernels.vp.spectrum import peaks_kernel, spread, support
from stages.vp.directions import Lines


@dataclass(frozen=True)
class Spectrum:
    """Weight of the lines along each horizontal direction, modulo 90 deg."""

    yaw_rad: Array64  # (b,) bin centres in the upright axes
    score: Array64  # (b,) in standard deviations above random directions
    lines: Array64  # (b,) sum of weights


def yaw_spectrum(lines: Lines, axes: Array64, free: NDArray[np.bool_], sigma_model: float, bins: int) -> Spectrum:
    """Spectrum of the lines in the mask `free`, `axes` with the vertical v as third column.

    A horizontal line with normal n is parallel to n x v. It adds a Gaussian with its sigma at its yaw modulo 90 deg.
    score = (S - E[S]) / sd[S] under uniformly random yaws.
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


def pair_support(
    lines: Lines, axes: Array64, free: NDArray[np.bool_], sigma_model: float, yaw_rad: float
) -> tuple[float, float]:
    """Score of the weaker direction of a horizontal pair, and lowest score of the pair without a 90 deg sector."""
    return support(
        lines.normal,
        lines.tangent,
        lines.sigma_rad,
        lines.weight,
        np.ascontiguousarray(axes),
        free,
        2.0 * sigma_model,
        yaw_rad,
    )


def peaks(spectrum: Spectrum, max_peaks: int) -> list[float]:
    """Yaws of the highest bins, each at least APART_RAD from the higher ones."""
    return peaks_kernel(spectrum.yaw_rad, spectrum.score, max_peaks).tolist()


def wrap_90deg(angle: Array64 | float) -> Array64 | float:
    """An angle [rad] modulo 90 deg, in -45 to 45 deg."""
    return np.mod(angle + math.pi / 4, math.pi / 2) - math.pi / 4

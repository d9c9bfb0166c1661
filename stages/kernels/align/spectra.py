"""Compiled functions that add line votes to a spectrum over yaw.

Source: see `stages/align/spectra.py`.
"""

from __future__ import annotations

import math

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

BINS = 720  # of 180 deg
BIN_RAD = math.pi / BINS


@compiled
def add_kernels(azimuth_rad: Array64, sigma_rad: Array64, weight: Array64, out: Array64) -> None:
    """Add w / (sqrt(2 pi) s) exp(-(a - a_i)^2 / 2 s^2): the von Mises kernel where it is narrow, without its tails."""
    for i in range(len(azimuth_rad)):
        s = sigma_rad[i]
        reach = int(4.0 * s / BIN_RAD) + 1
        middle = round(azimuth_rad[i] / BIN_RAD)
        for k in range(middle - reach, middle + reach + 1):
            off = (k * BIN_RAD - azimuth_rad[i]) / s
            out[k % BINS] += weight[i] / (math.sqrt(2 * math.pi) * s) * math.exp(-0.5 * off * off)

"""Compiled functions that relate a predicted track to the slices of a scan pass.

Source: see `stages/track/scan_pass.py`.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.compiled import compiled

SCAN_COS = math.cos(math.radians(24.0))  # a slice covers 15 deg to each side of its middle and 5 deg along


@compiled
def largest_sigma_m(P: Array64) -> float:
    """Largest sigma of the position in a covariance (6, 6)."""
    return math.sqrt(np.linalg.eigvalsh(np.ascontiguousarray(P[:3, :3]))[-1])


@compiled
def misfit(xyz_m: Array64, x: Array64, P: Array64) -> float:
    """How far a place (3,) is from a state's, squared sigmas, with 0.3 m of its own."""
    away = xyz_m - x[:3]
    return float(away @ np.linalg.solve(P[:3, :3] + 0.3**2 * np.eye(3), away))


@compiled
def seen_from(R: Array64, t: Array64, origin_m: Array64, x: Array64, axis: Array64) -> tuple[Array64, float, bool]:
    """(line to a state's place (3,) [m], its length, whether a slice looks there), all in the vehicle frame.

    R, t are T_map_vehicle of the slice, origin (3,) and axis (3,) its beams' start and mean direction.
    """
    away = R.T @ (x[:3] - t) - origin_m
    range_m = math.sqrt(away @ away)
    return away, range_m, range_m >= 0.5 and bool(away @ axis >= range_m * math.sqrt(axis @ axis) * SCAN_COS)

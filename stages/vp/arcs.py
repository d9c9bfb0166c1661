"""Great-circle arcs: pieces of edge chains that lie on one great circle, with the plane each spans with the camera.

A straight line in space is a great circle on the unit sphere, whatever the lens. A chain is split where it leaves
the circle through its two ends by more than `tolerance` (Douglas-Peucker on the sphere); each piece is fitted:

    n = n0 + a t0 + b m0,   minimise sum (n . r_k)^2 over its rays r_k  ->  (a, b)

with n0, t0, m0 the plane of the two ends, the direction along it, and its middle ray.

Source: ours. DESIGN, The graph: vp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from stages.geometry.lens import Array64
from stages.kernels.vp.arcs import EXTENT, FIRST, MOMENTS, NORMAL, SIGMA, split_all
from stages.vp.edges import Chains
from stages.vp.pixel_rays import PixelRays

MIN_SIGMA_PX = 0.12  # position noise of an edge point; blur, sampling, JPEG


@dataclass(frozen=True)
class Arcs:
    """Great-circle arcs, or lines made of several. All vectors unit, camera frame."""

    normal: Array64  # (n, 3)
    ends: Array64  # (n, 2, 3) on the circle
    sigma_rad: Array64  # (n,) of the rotation about its middle ray
    extent_rad: Array64  # (n,) angle between the ends
    moments: Array64  # (n, 7) second moments xx, xy, xz, yy, yz, zz of its rays, and their number

    def __len__(self) -> int:
        return len(self.normal)


def fit_arcs(
    chains: Chains,
    pixel_rays: PixelRays,
    tolerance_px: float,
    min_extent_px: float,
    turn_rad_per_row: Array64 | None = None,
) -> Arcs:
    """All arcs of all chains with an extent of at least `min_extent_px`.

    `turn_rad_per_row` (3,): rotation of the camera between the exposures of two rows, camera axes. Rays are returned
    in the camera axes at the exposure of the middle row.
    """
    tolerance, extent = tolerance_px * pixel_rays.pixel_rad, min_extent_px * pixel_rays.pixel_rad
    min_sigma, middle = MIN_SIGMA_PX * pixel_rays.pixel_rad, 0.5 * (pixel_rays.usable.shape[0] - 1)
    turn = np.zeros(3) if turn_rad_per_row is None else turn_rad_per_row
    return arcs_of(
        split_all(chains.points_px, chains.start, pixel_rays.rays, tolerance, extent, min_sigma, turn, middle)
    )


def arcs_of(rows: Array64) -> Arcs:
    """Arcs from the table that the compiled functions write."""
    return Arcs(
        normal=np.ascontiguousarray(rows[:, NORMAL : NORMAL + 3]),
        ends=np.ascontiguousarray(rows[:, FIRST : FIRST + 6]).reshape(-1, 2, 3),
        sigma_rad=rows[:, SIGMA].copy(),
        extent_rad=rows[:, EXTENT].copy(),
        moments=np.ascontiguousarray(rows[:, MOMENTS:]),
    )

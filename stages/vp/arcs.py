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
from stages.kernels.vp.arcs import EXTENT, FIRST, NORMAL, SIGMA, split_all
from stages.vp.edges import Chains
from stages.vp.pixel_rays import PixelRays

MIN_SIGMA_PX = 0.12  # position noise of an edge point; blur, sampling, JPEG


@dataclass(frozen=True)
class Arcs:
    """Great-circle arcs, or lines made of several. All vectors unit, camera frame."""

    rows: Array64  # (n, COLUMNS) table of the compiled functions

    def __len__(self) -> int:
        return len(self.rows)

    @property
    def normal(self) -> Array64:
        """Normals (n, 3) of the great circles."""
        return np.ascontiguousarray(self.rows[:, NORMAL : NORMAL + 3])

    @property
    def ends(self) -> Array64:
        """Both ends (n, 2, 3), on the circle."""
        return np.ascontiguousarray(self.rows[:, FIRST : FIRST + 6]).reshape(-1, 2, 3)

    @property
    def sigma_rad(self) -> Array64:
        """Sigma (n,) of the rotation about its middle ray."""
        return np.ascontiguousarray(self.rows[:, SIGMA])

    @property
    def extent_rad(self) -> Array64:
        """Angle (n,) between the ends."""
        return np.ascontiguousarray(self.rows[:, EXTENT])

    def longest(self, count: int | None = None) -> Arcs:
        """The `count` longest of them, or all, longest first."""
        return Arcs(self.rows[np.argsort(-self.rows[:, EXTENT], kind="stable")[:count]])


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
    return Arcs(split_all(chains.points_px, chains.start, pixel_rays.rays, tolerance, extent, min_sigma, turn, middle))

"""Arcs: pieces of chains that lie on one great circle, each with the plane through the lens's centre it spans.

A straight line of the world is a great circle on the unit sphere, whatever the lens. A chain is split where it leaves
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
from stages.vp.eye import Eye

LEAST_SIGMA_PX = 0.12  # of a point's place; blur, sampling, JPEG


@dataclass(frozen=True)
class Arcs:
    """Great-circle arcs, or lines made of several. All vectors unit, camera frame."""

    normal: Array64  # (n, 3)
    ends: Array64  # (n, 2, 3) on the circle
    sigma_rad: Array64  # (n,) how far its turn about its middle ray is known
    extent_rad: Array64  # (n,) from end to end
    moments: Array64  # (n, 7) xx, xy, xz, yy, yz, zz of its rays and how many

    def __len__(self) -> int:
        return len(self.normal)


def fit_arcs(
    chains: Chains, eye: Eye, tolerance_px: float, min_extent_px: float, turn_rad_per_row: Array64 | None = None
) -> Arcs:
    """All arcs of all chains that reach over `min_extent_px`.

    `turn_rad_per_row` (3,): how the camera turns from one row's exposure to the next one's, its own axes. Rays are told
    in the axes that it had at the middle row.
    """
    tolerance, extent = tolerance_px * eye.pixel_rad, min_extent_px * eye.pixel_rad
    least, middle = LEAST_SIGMA_PX * eye.pixel_rad, 0.5 * (eye.usable.shape[0] - 1)
    turn = np.zeros(3) if turn_rad_per_row is None else turn_rad_per_row
    return arcs_of(split_all(chains.points_px, chains.start, eye.rays, tolerance, extent, least, turn, middle))


def arcs_of(rows: Array64) -> Arcs:
    """Arcs of the table that the compiled functions write."""
    return Arcs(
        normal=np.ascontiguousarray(rows[:, NORMAL : NORMAL + 3]),
        ends=np.ascontiguousarray(rows[:, FIRST : FIRST + 6]).reshape(-1, 2, 3),
        sigma_rad=rows[:, SIGMA].copy(),
        extent_rad=rows[:, EXTENT].copy(),
        moments=np.ascontiguousarray(rows[:, MOMENTS:]),
    )

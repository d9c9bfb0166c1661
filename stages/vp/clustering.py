"""Lines: arcs that lie on one great circle, near each other, are one line, cut by trees, windows or the tracing.

What a facade repeats (sills, cornices, kerbs) is one observation, not ten: counting it ten times is how a covariance
becomes a lie.

Source: ours. DESIGN, Vision: cluster lines.
"""

from __future__ import annotations

import numpy as np

from stages.kernels.vp.clustering import gather
from stages.vp.arcs import LEAST_SIGMA_PX, Arcs, arcs_of
from stages.vp.eye import Eye

TOGETHER_PX = 0.8  # how far an arc's ends may lie from a line's circle


def cluster(arcs: Arcs, eye: Eye, most: int) -> Arcs:
    """The `most` widest lines, the widest first."""
    if len(arcs) == 0:
        return arcs
    order = np.argsort(-arcs.extent_rad, kind="stable")
    rows = gather(
        arcs.normal[order],
        arcs.ends[order],
        arcs.sigma_rad[order],
        arcs.extent_rad[order],
        arcs.moments[order],
        TOGETHER_PX * eye.pixel_rad,
        LEAST_SIGMA_PX * eye.pixel_rad,
    )
    lines = arcs_of(rows)
    keep = np.argsort(-lines.extent_rad, kind="stable")[:most]
    return Arcs(
        lines.normal[keep], lines.ends[keep], lines.sigma_rad[keep], lines.extent_rad[keep], lines.moments[keep]
    )

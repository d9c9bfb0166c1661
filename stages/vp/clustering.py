"""Lines: neighbouring arcs on one great circle are one line, which trees, windows or the edge tracing have split.

Repeated structure on one line (sills, cornices, kerbs) is one observation. Counting each arc would make the covariance
too small.

Source: ours. DESIGN, Vision: cluster lines.
"""

from __future__ import annotations

from stages.kernels.vp.clustering import gather
from stages.vp.arcs import MIN_SIGMA_PX, Arcs
from stages.vp.pixel_rays import PixelRays

MERGE_PX = 0.8  # largest distance of an arc's ends from the great circle of its line


def cluster(arcs: Arcs, pixel_rays: PixelRays, max_lines: int) -> Arcs:
    """The `max_lines` longest lines, longest first.

    From the longest on, each arc takes the shorter ones whose ends are within MERGE_PX of its great circle and near its
    own ends along it; a line is fitted to the rays of all its arcs.
    """
    if len(arcs) == 0:
        return arcs
    lines = gather(arcs.longest().rows, MERGE_PX * pixel_rays.pixel_rad, MIN_SIGMA_PX * pixel_rays.pixel_rad)
    return Arcs(lines).longest(max_lines)

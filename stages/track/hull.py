"""What one look says of where the body's centre is: every pulse near it counts, hits and misses alike.

A pulse that passes the centre at distance rho (across the line of sight) is returned by the drone with probability

    p(rho) = p_0 exp(-rho^2 / (2 s^2)),    s = 0.2 span

(open arms, seen from any side: half of the pulses return at a quarter of the span; measured on simulated drones, and
half as wide as the drone because rotors are mostly air). So over the offsets (a, b) of the centre

    ln L(a, b) = sum_hits ln(p + eps) + sum_misses ln(1 - p)

on a grid, times the prior; its mean and covariance go back to the filter. Misses beside hits draw the edge.

Source: ours; DESIGN, "the misses carry information".
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.track.hull import basis

WIDTH = 0.2  # s over the span
COLUMNS = 6


def across(line: Array64) -> Array64:
    """(2, 3): the axes a and b across a unit line of sight, in the frame in which its a is to be level."""
    ax, ay, bx, by, bz = basis(line[0], line[1], line[2])
    return np.array([[ax, ay, 0.0], [bx, by, bz]])

"""Likelihood of the drone's centre given the pulses of one scan pass, both returns and pass-throughs.

A pulse that passes the centre at distance rho (across the line of sight) is returned by the drone with probability

    p(rho) = p_0 exp(-rho^2 / (2 s^2)),    s = 0.2 span

The width s is that of simulated drones with open arms: half of the pulses return at a quarter of the span. It is half
the drone's width because rotors are mostly air. With eps, the probability of a false return, the log-likelihood of the
centre's offset (a, b) from the prediction is

    ln L(a, b) = sum_returns ln(p + eps) + sum_pass-throughs ln(1 - p)

It is evaluated on a grid and multiplied by the prior. Mean and covariance of the posterior update the filter.
Pass-throughs next to returns determine the drone's edge.

Source: ours.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.track.hull import basis

WIDTH = 0.2  # s over the span
COLUMNS = 6


def across(line: Array64) -> Array64:
    """Axes a (horizontal) and b (2, 3) orthogonal to a unit line of sight (3,), in the same frame."""
    ax, ay, bx, by, bz = basis(line[0], line[1], line[2])
    return np.array([[ax, ay, 0.0], [bx, by, bz]])

"""The vertical from lines alone: proposals where lines meet, and one of them refined.

Source: ours; the vote is that of every method that looks for vanishing points among the meetings of pairs of lines.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.lens import Array64
from stages.kernels.vp.verticals import meetings, picked, refine_vertical_kernel, votes_kernel
from stages.vp.directions import Lines

LEAST_SINE = 0.05  # two lines that meet at less do not say where
LEVEL_APART_RAD = math.radians(12.0)  # between level directions tried for the vertical at right angles to both


def propose_verticals(
    lines: Lines, about: Array64, cone_rad: float, sigma_model: float, pairs: int, most: int
) -> Array64:
    """Verticals (k, 3) within a cone, the best of each kind first: where lines meet that many others run to as well,
    and what is at right angles to two such directions outside the cone (a car park has no upright lines).

    Pairs are drawn from the widest lines.
    """
    count = min(pairs, len(lines.normal))
    meet = meetings(lines.normal[:count], LEAST_SINE)
    meet *= np.where(meet @ about < 0, -1.0, 1.0)[:, None]
    inside = meet @ about > math.cos(cone_rad)
    votes = votes_kernel(meet, lines.normal, lines.tangent, lines.sigma_rad, lines.weight, 2.0 * sigma_model)
    upright_ones = _best_apart(meet[inside], votes[inside], most, 6.0 * sigma_model)
    level = _best_apart(meet[~inside], votes[~inside], most, LEVEL_APART_RAD)
    crossed = meetings(level, math.sin(math.radians(80.0)))
    crossed *= np.where(crossed @ about < 0, -1.0, 1.0)[:, None]
    return np.vstack([upright_ones, crossed[crossed @ about > math.cos(cone_rad)]])


def _best_apart(directions: Array64, votes: Array64, most: int, apart_rad: float) -> Array64:
    return picked(directions, np.argsort(-votes, kind="stable"), most, math.cos(apart_rad))


def refine_vertical(
    lines: Lines, vertical: Array64, prior: Array64, prior_sigma: float, sigma_model: float, gate_rad: float
) -> Array64:
    """The direction nearest to all lines within a gate that closes round by round, pulled by the prior."""
    return refine_vertical_kernel(
        lines.normal,
        lines.tangent,
        lines.sigma_rad,
        lines.weight,
        np.ascontiguousarray(vertical),
        np.ascontiguousarray(prior),
        prior_sigma,
        sigma_model,
        gate_rad,
    )

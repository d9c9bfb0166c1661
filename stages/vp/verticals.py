"""The vertical from lines alone: proposals from intersections of pairs of lines, and their refinement.

Source: ours; the vote over pairwise intersections is common to vanishing point detectors.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.lens import Array64
from stages.kernels.vp.verticals import meetings, picked, refine_vertical_kernel, votes_kernel
from stages.vp.directions import Lines

MIN_SINE = 0.05  # of the angle between two lines; below, their intersection is uncertain
LEVEL_APART_RAD = math.radians(12.0)  # between level directions whose cross products propose verticals


def propose_verticals(
    lines: Lines, about: Array64, cone_rad: float, sigma_model: float, pairs: int, max_proposals: int
) -> Array64:
    """Proposed verticals (k, 3) within a cone about `about`, in two groups, each with the best first.

    The first are intersections of lines with many votes. The second are cross products of two such directions outside
    the cone, for scenes without upright lines. Pairs are taken from the `pairs` longest lines.
    """
    count = min(pairs, len(lines.normal))
    meet = meetings(lines.normal[:count], MIN_SINE)
    meet *= np.where(meet @ about < 0, -1.0, 1.0)[:, None]
    inside = meet @ about > math.cos(cone_rad)
    votes = votes_kernel(meet, lines.normal, lines.tangent, lines.sigma_rad, lines.weight, 2.0 * sigma_model)
    upright_ones = _best_separated(meet[inside], votes[inside], max_proposals, 6.0 * sigma_model)
    level = _best_separated(meet[~inside], votes[~inside], max_proposals, LEVEL_APART_RAD)
    crossed = meetings(level, math.sin(math.radians(80.0)))
    crossed *= np.where(crossed @ about < 0, -1.0, 1.0)[:, None]
    return np.vstack([upright_ones, crossed[crossed @ about > math.cos(cone_rad)]])


def _best_separated(directions: Array64, votes: Array64, max_count: int, min_angle_rad: float) -> Array64:
    return picked(directions, np.argsort(-votes, kind="stable"), max_count, math.cos(min_angle_rad))


def refine_vertical(
    lines: Lines, vertical: Array64, prior: Array64, prior_sigma: float, sigma_model: float, gate_rad: float
) -> Array64:
    """The vertical that best fits the lines within a gate and the prior; the gate narrows in each iteration."""
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

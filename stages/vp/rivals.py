"""Rivals of the best structure: others that fit about as well, and what they add to its sigmas.

    d_k = A_k(best) - A_k(rival),   D = sum d_k,   s_D^2 = n / (n - 1) sum (d_k - D / n)^2,   P = 1 - Phi(D / s_D)

A_k is the agreement with the lines in part k of n; P is the probability that the rival fits other lines of the scene
better. The lines of one object lie in one part, so that D is significant only when several objects agree on it. Each
rival i, turned by v_i against the best, adds to the variance of a direction d

    sum w_i |v_i x d|^2 / (1 + sum w_i),   w_i = P_i / (1 - P_i),   P_i at most 1/2

as in a mixture, about its best component. A rival with another vertical is no error of the best but another answer,
of weight w_i, unless it is rejected at RIVAL_LEVEL.

Source: ours; difference of fits with its sampling error: Vuong, Econometrica 57, 1989.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import rotation_z
from stages.geometry.lens import Array64
from stages.kernels.geometry.so3 import log_rotation
from stages.kernels.vp.rivals import agreement_of_parts, equal_parts
from stages.kernels.vp.spectrum import APART_RAD
from stages.vp.directions import Lines

RIVAL_RAD = math.radians(3.0)  # a vertical farther than this from the best one is another answer
RIVAL_LEVEL = 0.05  # significance level, one-sided
QUARTERS = np.array([rotation_z(k * math.pi / 2) for k in range(4)])
SAME_RAD = math.radians(0.5)  # structures nearer than this are one


@dataclass(frozen=True)
class Rivals:
    """Other answers that are not rejected, and the turns by which near rivals widen the best structure."""

    answers: tuple[tuple[int, float], ...]  # index and weight of each, best first; the best structure has weight 1
    turn_rad: Array64  # (n, 3) in the axes of the best structure
    share: Array64  # (n,) of each in the mixture

    def variance_rad2(self, local: Array64) -> Array64:
        """Variance (k,) that the rivals add to directions (k, 3) in the axes of the best structure."""
        squared = np.square(self.turn_rad).sum(axis=1) - np.square(local @ self.turn_rad.T)  # |v x d|^2, |d| = 1
        return np.maximum(squared, 0.0) @ self.share


def compare(lines: Lines, axes: Array64, others: Sequence[Array64], sigma_model: float) -> Rivals:
    """Compare the Manhattan frame `axes` (3, 3) with others, all as R_mount_frame with the vertical as third column."""
    different: list[int] = []
    for k, other in enumerate(others):
        seen = (axes, *(others[i] for i in different))
        if all(np.linalg.norm(turn_between(one, other)) > SAME_RAD for one in seen):
            different.append(k)
    if not different:
        return Rivals((), np.empty((0, 3)), np.empty(0))
    part = equal_parts(lines.normal, lines.tangent, lines.weight, np.ascontiguousarray(axes))
    best = _agreement(lines, axes, sigma_model, part)
    verticals = [axes[:, 2]]
    answers: list[tuple[int, float]] = []
    turns: list[Array64] = []
    weights: list[float] = []
    for k in different:
        p = probability_better(best - _agreement(lines, others[k], sigma_model, part))
        up = others[k][:, 2]
        if abs(float(axes[:, 2] @ up)) > math.cos(RIVAL_RAD):
            turns.append(turn_between(axes, others[k]))
            weights.append(p / (1.0 - p))
        elif p > RIVAL_LEVEL and all(abs(float(v @ up)) < math.cos(RIVAL_RAD) for v in verticals):
            verticals.append(up)
            answers.append((k, p / (1.0 - p)))
    w = np.array(weights)
    return Rivals(
        tuple(sorted(answers, key=lambda answer: -answer[1])), np.array(turns).reshape(-1, 3), w / (1.0 + w.sum())
    )


def turn_between(axes: Array64, other: Array64) -> Array64:
    """Rotation vector (3,) from one Manhattan frame to another, in the axes of the first, modulo 90 deg of yaw.

    Frames with yaws APART_RAD and more apart are different pairs: the rotation is that of the vertical alone.
    """
    R = axes.T @ other
    quarters = round(math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1]) / (math.pi / 2))
    turn = log_rotation(np.ascontiguousarray(R @ QUARTERS[-quarters % 4]))
    if abs(turn[2]) < APART_RAD:
        return turn
    return np.array([-R[1, 2], R[0, 2], 0.0])


def probability_better(difference: Array64) -> float:
    """Probability, at most 1/2, that the second of two structures fits better, by differences (n,) of n parts."""
    n = len(difference)
    sigma = math.sqrt(n * float(np.var(difference, ddof=1)))
    return min(0.5 * math.erfc(float(difference.sum()) / max(sigma * math.sqrt(2.0), 1e-12)), 0.5)


def _agreement(lines: Lines, axes: Array64, sigma_model: float, part: NDArray[np.int64]) -> Array64:
    return agreement_of_parts(
        lines.normal,
        lines.tangent,
        lines.sigma_rad,
        lines.weight,
        np.ascontiguousarray(axes),
        sigma_model,
        part,
    )

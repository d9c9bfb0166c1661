"""Rotation by both cameras as a measurement: several matches, each on four branches, or none of them.

    r_j = log(R^T Z_j)                                each match on each branch, Z_j; S_j = P + C_j
    l_j = p_j / 4 N(up . r_j; 0, up . S_j up)         likelihood of the yaw, if the tilt agrees
    l_0 = (1 - sum p) / (2 pi)                        no match is right: any yaw

The bank has hypotheses of two kinds. Those that are *tied* follow the matches; the free ones are for the case that the
matches are wrong, and use no image. The first image splits each free hypothesis: one for each plausible match, which
is tied, and itself, with the probabilities above. Lines of the same streets give the same wrong matches image after
image, however long, so later images move and weigh the tied hypotheses only among themselves: the odds of tied against
free change by the drone's motion alone. Of a later image a share f is new evidence, the rest repeats what is known:

    w <- (1 - f) w + f w l / sum(w l)                 of the tied hypotheses

Once the heading is decided, the matches are combined into one rotation whose covariance includes their spread (PDA).

Source: Bar-Shalom and Li (1995), 3.4 (PDA); Alspach and Sorenson (1972), Gaussian sums; ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64, rotation_z
from stages.geometry.se3 import CHI2_999_2, CHI2_999_3
from stages.heading.inertial_bank import DROPPED, InertialBank, joined
from stages.heading.inertial_state import THETA, InertialState, exp_rotations, log_rotations

QUARTERS = np.array([rotation_z(0.5 * math.pi * k) for k in range(4)])
LEAST_SHARE = 1e-3  # of a hypothesis: a less plausible match is ignored
TINY = 1e-300
LEAST_WRONG = 0.05  # probability that all matches of a street are wrong, at least


@dataclass(frozen=True)
class RotationMatches:
    """Rotations at one time, in `map`."""

    R_map_drone: Array64  # (k, 3, 3) branch 0 of each
    covariance_rad2: Array64  # (k, 3, 3) drone axes
    probability: Array64  # (k,)
    R_map_vehicle: Array64  # (3, 3): the branches are about its vertical

    def turned(self, dR: Array64, variance_rad2: float) -> RotationMatches:
        """The same at a later time: the drone has turned by dR (3, 3), with a variance of each axis."""
        covariance = dR.T @ self.covariance_rad2 @ dR + variance_rad2 * np.eye(3)
        return RotationMatches(self.R_map_drone @ dR, covariance, self.probability, self.R_map_vehicle)


@dataclass(frozen=True)
class _Association:
    """Likelihoods of the 4 k matches and branches for n hypotheses."""

    residual: Array64  # (n, 4 k, 3) drone axes
    S: Array64  # (n, 4 k, 3, 3)
    squared: Array64  # (n, 4 k) squared Mahalanobis distances
    log_likelihood: Array64  # (n, 4 k); -inf: the tilt does not agree
    log_none: float
    covariance: Array64  # (4 k, 3, 3) of the matches

    def shares(self) -> tuple[Array64, Array64]:
        """Probabilities given each hypothesis: of the matches (n, 4 k), and log of the sum of the likelihoods (n,)."""
        total = np.logaddexp.reduce(np.column_stack([self.log_likelihood, np.full(len(self.S), self.log_none)]), axis=1)
        return np.exp(self.log_likelihood - total[:, None]), total


def _associate(state: InertialState, matches: RotationMatches) -> _Association:
    V, k = matches.R_map_vehicle, len(matches.probability)
    Z = np.concatenate([V @ QUARTERS @ V.T @ R for R in matches.R_map_drone])  # (4 k, 3, 3)
    C = np.repeat(matches.covariance_rad2, 4, axis=0)
    n = len(state)
    off = log_rotations((np.swapaxes(state.R, 1, 2)[:, None] @ Z[None]).reshape(-1, 3, 3)).reshape(n, 4 * k, 3)
    S = state.covariance[:, None, THETA, THETA] + C
    squared = np.einsum("nji,nji->nj", off, np.linalg.solve(S, off[..., None])[..., 0])
    up = state.R[:, 2, :]
    yaw, variance = np.einsum("ni,nji->nj", up, off), np.einsum("ni,njik,nk->nj", up, S, up)
    of_yaw = yaw**2 / variance
    log_p = np.log(np.maximum(np.repeat(matches.probability, 4) / 4, 1e-12))
    log_likelihood = log_p - 0.5 * (of_yaw + np.log(2 * math.pi * variance))
    log_likelihood = np.where(squared - of_yaw < CHI2_999_2, log_likelihood, -np.inf)
    none = max(1.0 - float(matches.probability.sum()), LEAST_WRONG)
    return _Association(off, S, squared, log_likelihood, math.log(none / (2 * math.pi)), C)


def add_matches(bank: InertialBank, matches: RotationMatches, share: float) -> float:
    """Add the matches to the bank; `share`: how much of them is new evidence, if there are tied hypotheses.

    Returns the probability that one of them is right, given that the tied hypotheses are.
    """
    first = not bank.tied.any()
    rows = np.arange(len(bank.tied)) if first else np.flatnonzero(bank.tied)
    others = np.flatnonzero(~bank.tied) if not first else rows[:0]
    share = 1.0 if first else share
    state, log_weight = bank.state.rows(rows), bank.log_weight[rows]
    found = _associate(state, matches)
    right, total = found.shares()
    log_sum = np.logaddexp.reduce(log_weight)
    log_all = log_weight + total
    log_all = log_all - np.logaddexp.reduce(log_all) + log_sum  # after the image
    none = np.maximum(1.0 - right.sum(axis=1), 0.0)
    kept = np.log(np.maximum((1.0 - share) * np.exp(log_weight) + share * np.exp(log_all) * none, TINY))
    new = math.log(share) + log_all[:, None] + np.log(np.maximum(right, TINY))
    which, match = np.nonzero((right > LEAST_SHARE) & (new > math.log(DROPPED)))
    probability = float(np.exp(log_all - log_sum) @ right.sum(axis=1))
    if len(which):
        moved = _updated(state.rows(which), found.residual[which, match], found.S[which, match])
        bank.replace(
            joined([bank.state.rows(others), state, moved]),
            np.concatenate([bank.log_weight[others], kept, new[which, match]]),
            np.repeat([False, not first, True], [len(others), len(rows), len(which)]),
        )
    return probability


def _updated(prior: InertialState, residual: Array64, S: Array64) -> InertialState:
    """Each hypothesis after its own match."""
    PHt = prior.covariance[:, :, THETA]
    K = np.swapaxes(np.linalg.solve(S, np.swapaxes(PHt, 1, 2)), 1, 2)
    after = prior.covariance - K @ np.swapaxes(PHt, 1, 2)
    after = 0.5 * (after + np.swapaxes(after, 1, 2))
    step = np.einsum("nij,nj->ni", K, residual)
    return InertialState(prior.R, prior.xyz_m, prior.velocity_mps, prior.bias, after).moved(step)


@dataclass(frozen=True)
class Combined:
    """One rotation from all matches that agree with a decided heading."""

    residual_rad: Array64  # (3,) of the nearest match
    covariance_rad2: Array64  # (3, 3) of the nearest match
    R_map_drone: Array64 | None  # None: no match is plausible
    spread_rad2: Array64  # (3, 3) covariance of R_map_drone


def combine(state: InertialState, matches: RotationMatches) -> Combined:
    """The matches as one measurement of a state (one row)."""
    found = _associate(state, matches)
    nearest = int(np.argmin(found.squared[0]))
    off, covariance = found.residual[0, nearest], found.covariance[nearest]
    share = found.shares()[0][0] * (found.squared[0] < CHI2_999_3)
    right = float(share.sum())
    if right < 0.5:
        return Combined(off, covariance, None, covariance)
    share /= right
    mean = share @ found.residual[0]
    apart = found.residual[0] - mean
    spread = np.einsum("j,jik->ik", share, found.covariance) + np.einsum("j,ji,jk->ik", share, apart, apart)
    return Combined(off, covariance, state.R[0] @ exp_rotations(mean[None])[0], spread / right)

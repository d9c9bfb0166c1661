"""Metric length of a translation with known direction, from features with known depth. P V.B.

With q = 1 / depth at the earlier image: x' ~ R x + (s q) t_hat, so rho = s q = -(y x x') . (t x x') / |t x x'|^2
and each feature gives s = rho / q. Their robust mean is the motion's length.

Source: P V.B; ours: the weights.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.geometry.frames import Array64

LEAST_FEATURES = 5
ROUNDS = 10
LEAST_RHO_SIGMAS = 4.0  # features with less parallax are biased
CAUCHY = 2.385
SHARED = 0.004  # relative error common to all features: LiDAR, lens and mount


@dataclass(frozen=True, slots=True)
class Length:
    """A length [m], its sigma, and the number of features it is from."""

    m: float
    sigma_m: float
    features: int


def parallax_ratio(
    earlier: Array64, later: Array64, R: Array64, t: Array64, sigma_rad: float
) -> tuple[Array64, Array64]:
    """rho = |t| / depth at the earlier image (n,) and its sigma; of rays (n, 3), R_later_earlier, t_hat_later."""
    y = earlier @ R.T
    tx = np.cross(t, later)
    square = np.maximum((tx**2).sum(axis=1), 1e-12)
    rho = -(np.cross(y, later) * tx).sum(axis=1) / square
    return rho, math.sqrt(2.0) * sigma_rad / np.sqrt(square)


def length_of(rho: Array64, rho_sigma: Array64, inverse_m: Array64, inverse_sigma: Array64) -> Length | None:
    """Robust mean of rho / q (n,); None with fewer than LEAST_FEATURES usable features. NaN inputs are ignored."""
    good = np.isfinite(inverse_m) & (rho > LEAST_RHO_SIGMAS * rho_sigma) & (inverse_m > 3.0 * inverse_sigma)
    if np.count_nonzero(good) < LEAST_FEATURES:
        return None
    s = rho[good] / inverse_m[good]
    relative = np.hypot(rho_sigma[good] / rho[good], inverse_sigma[good] / inverse_m[good])
    relative = np.hypot(relative, 0.01)
    # mean of the logarithm: twice and half the depth are equal errors
    log_s = np.log(s)
    weight = 1.0 / relative**2
    order = np.argsort(log_s)
    share = np.cumsum(weight[order])
    mean = float(log_s[order][np.searchsorted(share, 0.5 * share[-1])])
    spread, total = 1.0, weight
    for _ in range(ROUNDS):
        off = (log_s - mean) / relative
        spread = max(1.0, 1.4826 * float(np.median(np.abs(off))))
        total = weight / (1.0 + (off / (CAUCHY * spread)) ** 2)
        mean = float((total * log_s).sum() / total.sum())
    m = math.exp(mean)
    return Length(m, m * math.hypot(spread / math.sqrt(float(total.sum())), SHARED), int(np.count_nonzero(good)))

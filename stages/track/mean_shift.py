"""Mean shift: the weighted mean of the returns around the drone's last position, and its covariance.

    C(t) = exp(-|t - t_hat|^2),  t^{n+1} = sum_F C(t) t / sum_F C(t)                        Equation (6)

t in metres, t_hat = t^n. F, the returns within r of t^0, stays the same for the whole frame.

Source: P III.C, Equation 6. The covariance is ours: the paper gives none.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64

NEW_CROSSING_NS = 10_000_000  # a longer pause between a laser's returns separates two passes of the fan


def crossings(point_stamp_ns: NDArray[np.int64], laser: NDArray[np.uint8]) -> int:
    """Number of beam crossings of the target: runs of one laser without a pause of NEW_CROSSING_NS."""
    count = 0
    for beam in np.unique(laser):
        count += 1 + int((np.diff(np.sort(point_stamp_ns[laser == beam])) > NEW_CROSSING_NS).sum())
    return count


def fix_covariance_m2(
    points_m: Array64,
    weights: Array64,
    beam_crossings: int,
    origin_m: Array64,
    span_m: float,
    range_noise_m: float,
    pointing_rad: float,
    beam_rad: float,
) -> Array64:
    """Covariance (3, 3) of the weighted mean of points (n, 3) as the position of the drone's *centre*.

        P = S / n_eff + u u^T (sigma_r^2 + s^2 / 12) + (I - u u^T) (s^2 / (12 m) + R^2 (sigma_p^2 + beta^2 / 12))

    S / n_eff    weighted scatter over n_eff = (sum C)^2 / sum C^2: random choice of the parts that were hit
    u, R         direction and distance from the LiDAR to the mean
    sigma_r      range noise. It is the same for neighbouring returns, so it is not divided by their number
    s^2 / 12     along the ray the centre lies behind the returns, by 0 to s/2. The mean is not corrected for it: this
                 is the mean square of a uniform offset in [0, s/2]
    s^2 / (12 m) across the ray one crossing beam determines the centre only within the span: uniform, variance
                 s^2 / 12; m crossings are m such measurements
    sigma_p      pointing: encoder, calibration, servo time. Common to all returns of a frame, so not divided
    beta         beam divergence: a return may come from anywhere in the footprint, uniform over R beta

    Positive definite for span_m > 0 or all of the noises > 0, also for a single return.
    """
    mean_m = np.average(points_m, axis=0, weights=weights)
    offsets = points_m - mean_m
    share = weights / weights.sum()
    scatter = (offsets * share[:, np.newaxis]).T @ offsets
    n_eff = 1.0 / float((share * share).sum())
    ray = mean_m - origin_m
    distance_m = float(np.linalg.norm(ray))
    u = ray / distance_m if distance_m > 0 else np.array([0.0, 0.0, 1.0])
    along = np.outer(u, u)
    hull = span_m**2 / 12.0
    across_m2 = hull / beam_crossings + distance_m**2 * (pointing_rad**2 + beam_rad**2 / 12.0)
    return scatter / n_eff + along * (range_noise_m**2 + hull) + (np.eye(3) - along) * across_m2

"""Bias of a cue: its slowly changing error, estimated while the LiDAR sees the drone; and whether the cue is wrong.

    b' = -b / T + w,   stationary covariance B        (first-order Gauss-Markov; before any comparison b ~ N(0, B))
    r  = b + v         residual of the cue to the LiDAR

A residual that neither bias nor noise explains, three times in a row, is a contradiction: the cue is of another drone,
or its sensor has failed. It is trusted again after ten residuals in a row that agree.

The bias learns only from residuals that agree. Agreements and contradictions are counted in measurements, not in time:
a cue at 1 Hz is distrusted after 3 s and trusted again after 10 s, one at 10 Hz in a tenth of it.

Source: ours (also CONTRADICTIONS and AGREEMENTS, chosen, not measured); Brown, Hwang, Introduction to Random Signals
and Applied Kalman Filtering, ch. 3 (Gauss-Markov).
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64

TIME_S = 120.0  # correlation time: the logged GNSS bias was nearly constant over 188 s
CHI2_999 = {1: 10.83, 2: 13.82, 3: 16.27}  # 99.9 % quantiles by degrees of freedom
CONTRADICTIONS = 3
AGREEMENTS = 10


class CueBias:
    """Kalman filter of one cue's bias (n,)."""

    def __init__(self, stationary_m2: Array64, trusted: bool = True) -> None:
        self.mean_m: Array64 = np.zeros(len(stationary_m2))
        self.covariance_m2: Array64 = stationary_m2.copy()
        self.trusted = trusted
        self._stamp_ns: int | None = None
        self._contradictions = self._agreements = 0

    def predict(self, stamp_ns: int, stationary_m2: Array64) -> None:
        """Propagate to a time."""
        if self._stamp_ns is not None and stamp_ns > self._stamp_ns:
            kept = math.exp(-(stamp_ns - self._stamp_ns) * 1e-9 / TIME_S)
            self.mean_m = kept * self.mean_m
            self.covariance_m2 = kept**2 * self.covariance_m2 + (1.0 - kept**2) * stationary_m2
        self._stamp_ns = stamp_ns if self._stamp_ns is None else max(stamp_ns, self._stamp_ns)

    def distance2(self, residual_m: Array64, noise_m2: Array64) -> float:
        """Squared Mahalanobis distance of a residual (n,) with noise (n, n)."""
        innovation_m = residual_m - self.mean_m
        return float(innovation_m @ np.linalg.solve(self.covariance_m2 + noise_m2, innovation_m))

    def compare(self, residual_m: Array64, noise_m2: Array64) -> None:
        """Compare with the LiDAR: update the bias, or count a contradiction."""
        if self.distance2(residual_m, noise_m2) > CHI2_999[len(residual_m)]:
            self._agreements = 0
            self._contradictions += 1
            self.trusted = self.trusted and self._contradictions < CONTRADICTIONS
            return
        self._contradictions = 0
        self._agreements += 1
        self.trusted = self.trusted or self._agreements >= AGREEMENTS
        gain = self.covariance_m2 @ np.linalg.inv(self.covariance_m2 + noise_m2)
        self.mean_m = self.mean_m + gain @ (residual_m - self.mean_m)
        self.covariance_m2 = (np.eye(len(gain)) - gain) @ self.covariance_m2

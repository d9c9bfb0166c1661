"""Bias of a cue: its slowly changing error, estimated while the LiDAR sees the drone; and whether the cue is wrong.

    b' = -b / T + w,   stationary covariance B        (first-order Gauss-Markov; before any comparison b ~ N(0, B))
    r  = b + v         residual of the cue to the LiDAR

Residuals that neither bias nor noise explains, all of CONTRADICTS_NS and at least three, are a contradiction: the cue
is of another drone, or its sensor has failed. It is trusted again after AGREES_NS in which all agree, and at least
three do.

The bias learns only from residuals that agree.

Source: ours (also LEAST, CONTRADICTS_NS and AGREES_NS, chosen, not measured); Brown, Hwang, Introduction to Random
Signals and Applied Kalman Filtering, ch. 3 (Gauss-Markov).
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64

CHI2_999 = {1: 10.83, 2: 13.82, 3: 16.27}  # 99.9 % quantiles by degrees of freedom
LEAST = 3  # a single reflection is neither
CONTRADICTS_NS = 400_000_000
AGREES_NS = 1_800_000_000


class CueBias:
    """Kalman filter of one cue's bias (n,)."""

    def __init__(self, stationary_m2: Array64, trusted: bool = True) -> None:
        self.mean_m: Array64 = np.zeros(len(stationary_m2))
        self.covariance_m2: Array64 = stationary_m2.copy()
        self.trusted = trusted
        self.confirmed = False
        """Whether the cue has agreed with the LiDAR for AGREES_NS, and has not contradicted since."""
        self._stamp_ns: int | None = None
        self._agrees, self._in_a_row, self._since_ns = True, 0, 0  # the newest residuals that agree, or that do not

    def predict(self, stamp_ns: int, stationary_m2: Array64, time_s: float) -> None:
        """Propagate to a time; `time_s`: correlation time T."""
        if self._stamp_ns is not None and stamp_ns > self._stamp_ns:
            kept = math.exp(-(stamp_ns - self._stamp_ns) * 1e-9 / time_s)
            self.mean_m = kept * self.mean_m
            self.covariance_m2 = kept**2 * self.covariance_m2 + (1.0 - kept**2) * stationary_m2
        self._stamp_ns = stamp_ns if self._stamp_ns is None else max(stamp_ns, self._stamp_ns)

    def distance2(self, residual_m: Array64, noise_m2: Array64) -> float:
        """Squared Mahalanobis distance of a residual (n,) with noise (n, n)."""
        innovation_m = residual_m - self.mean_m
        return float(innovation_m @ np.linalg.solve(self.covariance_m2 + noise_m2, innovation_m))

    def compare(self, stamp_ns: int, residual_m: Array64, noise_m2: Array64) -> None:
        """Compare with the LiDAR: update the bias, or note a contradiction."""
        agrees = self.distance2(residual_m, noise_m2) <= CHI2_999[len(residual_m)]
        if agrees is not self._agrees or self._in_a_row == 0:
            self._agrees, self._in_a_row, self._since_ns = agrees, 0, stamp_ns
        self._in_a_row += 1
        enough_ns = AGREES_NS if agrees else CONTRADICTS_NS
        if self._in_a_row >= LEAST and stamp_ns - self._since_ns >= enough_ns:
            self.trusted = self.confirmed = agrees
        if not agrees:
            return
        gain = self.covariance_m2 @ np.linalg.inv(self.covariance_m2 + noise_m2)
        self.mean_m = self.mean_m + gain @ (residual_m - self.mean_m)
        self.covariance_m2 = (np.eye(len(gain)) - gain) @ self.covariance_m2

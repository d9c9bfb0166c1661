"""Whether the object that the LiDAR follows moves as the drone's IMU measures, or independently of it.

The alternative is an object that moves without any relation to the IMU: Kalman filters of position and velocity with a
white acceleration, one of low and one of high density. Both alternatives predict each LiDAR position; the log ratios of
their likelihoods are summed. The sum is bounded, so that a change of the followed object is detected within seconds.

Source: Bar-Shalom, Li, Kirubarajan (2001), 6.2 (white acceleration) and 11.6 (static multiple model); ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.bank_measurements import POSITION_DENSITY, POSITION_OUTLIERS
from stages.heading.inertial_bank import log_normal

ACCELERATIONS = 0.7, 2.2  # white noise densities [m/s^2 / sqrt(Hz)]
START_MPS = 4.0  # one axis
LEAST_SHARE = 1e-3  # of each of the two filters
BOUND = 18.0
CERTAIN = math.log(999.0)
START, START_SUSPECT = -2.0, -6.0  # prior log ratio: the tracker may follow other drones and birds;
# START_SUSPECT after another object was followed
EXCLUDED = -10.0


class Ownership:
    """Log likelihood ratio of the IMU's motion against any other."""

    def __init__(self) -> None:
        self._stamp_ns: int | None = None
        self._x, self._covariance = np.zeros((2, 6)), np.zeros((2, 6, 6))
        self._weight = np.full(2, 0.5)
        self.log_ratio = START

    @property
    def certain(self) -> bool:
        """Whether the object is the drone, with P > 0.999."""
        return self.log_ratio > CERTAIN

    @property
    def cleared(self) -> bool:
        """Whether the object is the drone, by the stricter threshold for one that is followed after another object."""
        return self.log_ratio > 2.0 * CERTAIN

    @property
    def denied(self) -> bool:
        """Whether a motion independent of the IMU is more probable."""
        return self.log_ratio < 0.0

    @property
    def excluded(self) -> bool:
        """Whether the object is another one, almost certainly."""
        return self.log_ratio < EXCLUDED

    def restart(self, suspect: bool = False) -> None:
        """Start again for a possibly different object; `suspect`: the previous one was not the drone."""
        self._stamp_ns, self._weight = None, np.full(2, 0.5)
        self.log_ratio = START_SUSPECT if suspect else START

    def add(self, stamp_ns: int, xyz_m: Array64, covariance_m2: Array64, log_evidence: float | None) -> None:
        """Add a LiDAR position (map); log_evidence: its log density as predicted by the IMU; None: not predicted."""
        if self._stamp_ns is None or stamp_ns <= self._stamp_ns:
            if self._stamp_ns is None:
                self._x[:, :3], self._x[:, 3:] = xyz_m, 0.0
                self._covariance[:, :3, :3], self._covariance[:, 3:, 3:] = covariance_m2, START_MPS**2 * np.eye(3)
                self._covariance[:, :3, 3:] = self._covariance[:, 3:, :3] = 0.0
                self._stamp_ns = stamp_ns
            return
        self._predict((stamp_ns - self._stamp_ns) * 1e-9)
        self._stamp_ns = stamp_ns
        own = self._update(xyz_m, covariance_m2)
        if log_evidence is not None:
            self.log_ratio = min(max(self.log_ratio + log_evidence - own, -BOUND), BOUND)

    def _predict(self, dt: float) -> None:
        F = np.eye(6)
        F[:3, 3:] = dt * np.eye(3)
        unit = np.kron(np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3))
        self._x = self._x @ F.T
        self._covariance = F @ self._covariance @ F.T + np.square(ACCELERATIONS)[:, None, None] * unit

    def _update(self, z: Array64, covariance_m2: Array64) -> float:
        """Returns the log density of the position."""
        S = self._covariance[:, :3, :3] + covariance_m2
        off = z - self._x[:, :3]
        K = np.swapaxes(np.linalg.solve(S, self._covariance[:, :3, :]), 1, 2)
        log_in = log_position(off, S)
        beta = np.exp(log_in - _with_outliers(log_in)) * (1.0 - POSITION_OUTLIERS)
        step = beta[:, None] * np.einsum("nij,nj->ni", K, off)
        self._x = self._x + step
        self._covariance = self._covariance - beta[:, None, None] * (K @ self._covariance[:, :3, :])
        likelihood = self._weight * np.exp(_with_outliers(log_in))
        evidence = float(likelihood.sum())
        self._weight = np.maximum(likelihood / evidence, LEAST_SHARE)
        self._weight /= self._weight.sum()
        return math.log(evidence)


def log_position(off_m: Array64, S: Array64) -> Array64:
    """(n,) log density of residuals (n, 3) with covariances (n, 3, 3)."""
    return log_normal(np.einsum("ni,ni->n", off_m, np.linalg.solve(S, off_m[:, :, None])[:, :, 0]), S)


def log_evidence(off_m: Array64, S: Array64) -> float:
    """Log density of one residual (3,), outliers included."""
    return float(_with_outliers(log_position(off_m[None], S[None]))[0])


def _with_outliers(log_in: Array64) -> Array64:
    return np.logaddexp(log_in + math.log(1.0 - POSITION_OUTLIERS), math.log(POSITION_OUTLIERS * POSITION_DENSITY))

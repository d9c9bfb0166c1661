"""Extended Kalman filter of the paper on the relative rotation and its slowly varying angular rate.

    state       R, w: R_vehicle_drone and the drone's angular rate against the vehicle [rad/s], drone axes
    predict     R <- R exp(w dt), w stays, its change is white noise of `rate_noise`     (a rate that changes slowly)
    observe     R_obs = R exp(phi + noise),   y = log(R^T R_obs),   H = [I 0]

The covariance (6, 6) is that of (phi, w), phi in R exp(phi).

Source: P V.C, V.D (EKF on R with its angular rate); its noises are not given: settings of `PaperAlign`.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation, log_rotation, nearest_rotation

FURTHEST_S = 1.0  # the rate is applied for at most this time after the newest observation


class RotationFilter:
    """Extended Kalman filter on R and its rate."""

    def __init__(self, R: Array64, sigma_rad: float, rate_sigma_radps: float, rate_noise: float) -> None:
        """`rate_noise` [rad/s / sqrt(s)]: noise density of the rate."""
        self.rotation = R
        self.rate_radps = np.zeros(3)
        self.covariance: Array64 = np.diag([sigma_rad**2] * 3 + [rate_sigma_radps**2] * 3)
        self._rate_sigma_radps, self._rate_noise = rate_sigma_radps, rate_noise
        self._stamp_ns: int | None = None
        self._observed_ns: int | None = None

    def predict(self, stamp_ns: int) -> None:
        """Propagate to a time; an earlier time has no effect."""
        last_ns, self._stamp_ns = self._stamp_ns, max(stamp_ns, self._stamp_ns or stamp_ns)
        if last_ns is None or stamp_ns <= last_ns:
            return
        dt = (stamp_ns - last_ns) * 1e-9
        known_s = FURTHEST_S if self._observed_ns is None else FURTHEST_S - (last_ns - self._observed_ns) * 1e-9
        turn = exp_rotation(self.rate_radps * min(dt, max(known_s, 0.0)))
        self.rotation = nearest_rotation(self.rotation @ turn)
        F = np.eye(6)
        F[:3, :3], F[:3, 3:] = turn.T, dt * np.eye(3)
        self.covariance = F @ self.covariance @ F.T + self._rate_noise**2 * np.kron(
            np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]]), np.eye(3)
        )

    def observe(self, R_obs: Array64, sigma_rad: float) -> None:
        """One observed rotation at the predicted time, sigma_rad about each axis."""
        S = self.covariance[:3, :3] + sigma_rad**2 * np.eye(3)
        K = np.linalg.solve(S, self.covariance[:3, :]).T
        step = K @ log_rotation(self.rotation.T @ R_obs)
        self.rotation = nearest_rotation(self.rotation @ exp_rotation(step[:3]))
        self.rate_radps = self.rate_radps + step[3:]
        left = np.eye(6)
        left[:, :3] -= K
        self.covariance = left @ self.covariance @ left.T + sigma_rad**2 * K @ K.T
        self._observed_ns = self._stamp_ns

    def restart(self, R: Array64, sigma_rad: float) -> None:
        """Reset to a rotation with zero rate: another branch has another rate history."""
        self.rotation, self.rate_radps = R, np.zeros(3)
        self.covariance = np.diag([sigma_rad**2] * 3 + [self._rate_sigma_radps**2] * 3)
        self._observed_ns = self._stamp_ns

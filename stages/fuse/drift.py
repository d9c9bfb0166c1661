"""Position of the drone by LiDAR and the drift velocity of its odometry: a Kalman filter in `map`.

    p' = p + u + b dt      u: displacement by odometry, turned into map axes;   z = p + noise

With odometry b is its drift, a Gauss-Markov velocity that lasts for seconds; known from the recent fixes, it reduces
the error of a gap without fixes. Without odometry u = 0 and b is the whole velocity of the drone, with white
acceleration, plus the change of velocity that the autopilot reports, in an unknown direction.

Each displacement u was rotated by the yaw estimate at its time. When that estimate is corrected, `correct_yaw` corrects
b too; otherwise one error would be counted both as yaw and as drift. x is linear in u, so the filter propagates s, its
derivative by yaw (the displacements turned by 90 deg), and c, their level part:

    s' = F s + (z x u, 0) - K (F s + z x u)_p,     x(a) = x + sin(a) s + (cos(a) - 1) c

    V(T) = T^2 P_b + q T^3 / 3

is what a time T without a fix adds to the position covariance, with q = 2 sigma^2 / tau with odometry.

Source: Bar-Shalom, Li, Kirubarajan, Estimation with Applications to Tracking and Navigation (2001), 6.2; ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse.settings import FuseErrors
from stages.geometry.frames import Array64

START_MPS = 1.0  # sigma of the tracker's velocity
UNKNOWN_MPS = 6.0  # sigma of an unknown velocity


class Drift:
    """Kalman filter of position and drift velocity, in `map`."""

    def __init__(self, errors: FuseErrors, odometry: bool) -> None:
        """`odometry`: whether u is measured."""
        self._errors, self.odometry = errors, odometry
        self._x = np.zeros(6)
        self._covariance = np.eye(6)
        self._by_yaw = np.zeros((6, 2))  # s, c
        self.stamp_ns: int | None = None  # of the newest fix
        self.q = 2 * errors.drift_mps**2 / errors.drift_time_s if odometry else errors.manoeuvre

    @property
    def xyz_map_m(self) -> Array64:
        """Position at the newest fix."""
        return self._x[:3]

    @property
    def velocity_mps(self) -> Array64:
        """Drift velocity b (3,), map axes."""
        return self._x[3:]

    @property
    def velocity_covariance(self) -> Array64:
        """Covariance (3, 3) of b."""
        return self._covariance[3:, 3:]

    def start(self, stamp_ns: int, xyz_m: Array64, covariance_m2: Array64, velocity_mps: Array64 | None) -> None:
        """Start at a fix; b starts at zero with odometry, else at the tracker's velocity."""
        self.stamp_ns = stamp_ns
        known = np.zeros(3) if self.odometry or velocity_mps is None else velocity_mps
        sigma = START_MPS if velocity_mps is not None else UNKNOWN_MPS
        self._x, self._by_yaw = np.concatenate([xyz_m, known]), np.zeros((6, 2))
        self._covariance = np.zeros((6, 6))
        self._covariance[:3, :3] = covariance_m2
        self._covariance[3:, 3:] = (self._errors.drift_mps if self.odometry else sigma) ** 2 * np.eye(3)

    def see(
        self, stamp_ns: int, xyz_m: Array64, covariance_m2: Array64, moved_m: Array64 | None, turned_mps: float
    ) -> None:
        """Add a fix; one older than the newest is ignored.

        moved_m: u since the fix before; turned_mps: change of velocity that the autopilot reports since then.
        """
        if self.stamp_ns is None or stamp_ns <= self.stamp_ns:
            return
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        e = self._errors
        moved = np.zeros(3) if moved_m is None else moved_m
        keep = float(np.exp(-dt / e.drift_time_s)) if self.odometry else 1.0
        random_walk = e.walk_m_per_sqrt_s**2 * dt if self.odometry else 0.0
        fresh = ((e.drift_scale if self.odometry else 0.7) * turned_mps) ** 2
        x = np.column_stack([self._x, self._by_yaw])
        u = np.array([[moved[0], -moved[1], moved[0]], [moved[1], moved[0], moved[1]], [moved[2], 0.0, 0.0]])
        x, P = _step(x, self._covariance, u, dt, keep, self.q, random_walk, fresh)
        residual = np.column_stack([xyz_m, np.zeros((3, 2))]) - x[:3]
        x, self._covariance = _correct(x, P, residual, covariance_m2)
        self._x, self._by_yaw = x[:, 0].copy(), x[:, 1:].copy()
        self.stamp_ns = stamp_ns

    def correct_yaw(self, yaw_rad: float) -> None:
        """Turn the displacements so far by a correction of the yaw."""
        sin, cos = math.sin(yaw_rad), math.cos(yaw_rad)
        self._x = self._x + self._by_yaw @ np.array([sin, cos - 1.0])
        self._by_yaw = self._by_yaw @ np.array([[cos, sin], [-sin, cos]])

    def turn(self, R: Array64, t_m: Array64) -> None:
        """Change to another map frame: p <- R p + t."""
        whole = np.zeros((6, 6))
        whole[:3, :3] = whole[3:, 3:] = R
        self._x = whole @ self._x
        self._x[:3] += t_m
        self._by_yaw = whole @ self._by_yaw
        self._covariance = whole @ self._covariance @ whole.T

    def forget_velocity(self, guess_mps: Array64) -> None:
        """Reset b to a guess with sigma UNKNOWN_MPS."""
        self._x[3:], self._by_yaw[3:] = guess_mps, 0.0
        self._covariance[3:, :] = self._covariance[:, 3:] = 0.0
        self._covariance[3:, 3:] = UNKNOWN_MPS**2 * np.eye(3)

    def ahead(self, stamp_ns: int) -> tuple[Array64, Array64]:
        """Position (3,) and covariance (3, 3) at a time, propagated by b alone."""
        assert self.stamp_ns is not None
        dt = (stamp_ns - self.stamp_ns) * 1e-9
        x, P = _step(self._x, self._covariance, np.zeros(3), dt, 1.0, self.q if dt > 0 else 0.0, 0.0, 0.0)
        return x[:3], P[:3, :3]

    def add_direction(self, direction_map: Array64, sigma_rad: float) -> None:
        """Add a direction of flight by the camera, at any speed: no velocity across it. Without odometry."""
        speed = float(np.linalg.norm(self._x[3:]))
        across = np.eye(3) - np.outer(direction_map, direction_map)
        self._x, self._covariance = _across(self._x, self._covariance, across, (speed * sigma_rad) ** 2 + 0.05**2)

    def growth_covariance_m2(self, since_s: float) -> Array64:
        """V(T) (3, 3), map axes."""
        T = max(since_s, 0.0)
        return T**2 * self._covariance[3:, 3:] + self.q * T**3 / 3 * np.eye(3)


def _step(  # x: (6,), or columns (6, n) with theirs in `moved`
    x: Array64, P: Array64, moved: Array64, dt: float, keep: float, q: float, random_walk: float, fresh: float
) -> tuple[Array64, Array64]:
    F = np.eye(6)
    for axis in range(3):
        F[axis, axis + 3] = dt
        F[axis + 3, axis + 3] = keep
    ahead = F @ x
    ahead[:3] += moved
    spread = F @ P @ F.T
    for axis in range(3):
        spread[axis, axis] += q * dt**3 / 3 + random_walk
        spread[axis, axis + 3] += q * dt**2 / 2
        spread[axis + 3, axis] += q * dt**2 / 2
        spread[axis + 3, axis + 3] += q * dt + fresh
    return ahead, spread


def _correct(x: Array64, P: Array64, residual: Array64, R: Array64) -> tuple[Array64, Array64]:
    """Joseph's form of z = p + noise."""
    K = np.linalg.solve(P[:3, :3] + R, np.ascontiguousarray(P[:3, :])).T
    left = np.eye(6)
    left[:, :3] -= K
    after = left @ P @ left.T + K @ R @ K.T
    return x + K @ residual, 0.5 * (after + after.T)


def _across(x: Array64, P: Array64, across: Array64, variance: float) -> tuple[Array64, Array64]:
    """0 = across v + noise."""
    H = np.zeros((3, 6))
    H[:, 3:] = across
    S = H @ P @ H.T + variance * np.eye(3)
    K = np.linalg.solve(S, H @ P).T
    left = np.eye(6) - K @ H
    after = left @ P @ left.T + variance * (K @ K.T)
    return x - K @ (H @ x), 0.5 * (after + after.T)

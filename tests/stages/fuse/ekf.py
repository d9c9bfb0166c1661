"""The error-state Kalman filter that the smoother is compared with: one pose, late data moved to its time.

    extend       T <- T D,  P <- Ad(D^-1) P Ad(D^-1)^T + Q
    position     z = T d + noise,  d: where the body was at the measurement's time, in the body's axes now
    rotation     R_z = R d_R exp(noise)

It is as accurate as the smoother while every measurement is good, and cannot correct a wrong start.

Source: Sola, Quaternion kinematics for the error-state Kalman filter (2017), 6; DESIGN, Fusion.
"""

from __future__ import annotations

import math

import numpy as np

from stages.fuse import Fuse
from stages.fuse.motion_model import Step
from stages.fuse.smoother import HUBER
from stages.geometry.frames import Array64
from stages.geometry.se3 import composed_covariance
from stages.kernels.geometry.so3 import exp_rotation, hat, log_rotation


class Ekf:
    """See `stages.fuse.smoother.BackEnd`."""

    def __init__(self) -> None:
        self.stamp_ns, self.recoveries = 0, 0
        self.R_map_drone, self.xyz_map_m, self.covariance = np.eye(3), np.zeros(3), np.eye(6)

    def start(self, stamp_ns: int, R_map_drone: Array64, xyz_map_m: Array64, covariance: Array64) -> None:
        """Start from one pose."""
        self.stamp_ns, self.covariance = stamp_ns, covariance
        self.R_map_drone, self.xyz_map_m = R_map_drone, xyz_map_m

    def extend(self, stamp_ns: int, step: Step, up_drone: Array64 | None, tilt_rad2: float) -> None:
        """Propagate; `up_drone` is the vertical by the autopilot."""
        self.xyz_map_m = self.xyz_map_m + self.R_map_drone @ step.t_m
        self.R_map_drone = self.R_map_drone @ step.R
        self.covariance = composed_covariance(self.covariance, step.R, step.t_m, step.covariance)
        self.stamp_ns = stamp_ns
        if up_drone is not None:
            H = np.zeros((3, 6))
            H[:, :3] = hat(self.R_map_drone.T[:, 2].copy())  # of R^T z
            self._correct(H, up_drone - self.R_map_drone.T[:, 2], tilt_rad2 * np.eye(3))

    def near(self, stamp_ns: int) -> tuple[int, Array64, Array64]:
        """The pose that a measurement refers to, with its time: always the newest."""
        return self.stamp_ns, self.R_map_drone, self.xyz_map_m

    def add_position(self, key_ns: int, step: Step, xyz_m: Array64, covariance_m2: Array64) -> bool:
        """Correct by a position at the end of a step from the newest pose."""
        H = np.zeros((3, 6))
        H[:, :3] = -self.R_map_drone @ hat(step.t_m)
        H[:, 3:] = self.R_map_drone
        self._correct(H, xyz_m - self.xyz_map_m - self.R_map_drone @ step.t_m, covariance_m2)
        return True

    def add_rotation(self, key_ns: int, step: Step, R: Array64, covariance_rad2: Array64) -> bool:
        """Correct by a rotation at the end of a step from the newest pose."""
        H = np.zeros((3, 6))
        H[:, :3] = np.eye(3)
        e = log_rotation(self.R_map_drone.T @ R @ step.R.T)
        self._correct(H, e, step.R @ covariance_rad2 @ step.R.T)
        return True

    def _correct(self, H: Array64, e: Array64, noise: Array64) -> None:
        """Kalman update with the Huber weight of the whitened residual, as in the factors of the smoother."""
        far = math.sqrt(max(float(e @ np.linalg.solve(noise, e)), 0.0))
        noise = noise * max(1.0, far / HUBER)
        K = np.linalg.solve(H @ self.covariance @ H.T + noise, H @ self.covariance).T
        left = np.eye(6) - K @ H
        after = left @ self.covariance @ left.T + K @ noise @ K.T
        xi = K @ e
        self.xyz_map_m = self.xyz_map_m + self.R_map_drone @ xi[3:]
        self.R_map_drone = self.R_map_drone @ exp_rotation(xi[:3])
        self.covariance = 0.5 * (after + after.T)


class EkfFuse(Fuse):
    """`Fuse` with this filter in place of the smoother."""

    def _back_end(self) -> Ekf:
        return Ekf()

"""State of the drone by IMU: attitude, position, velocity and both biases, for several hypotheses at once.

Errors (15), in the order of GTSAM's keys: theta (R exp(theta), drone axes), position and velocity (map axes),
accelerometer bias, gyroscope bias. Over an interval T with the preintegrated motion (dR, dv, dp):

    R' = R dR,   v' = v + g T + R dv,   p' = p + v T + g T^2 / 2 + R dp

Source: Forster et al. (T-RO 2017); Sola, Quaternion kinematics for the error-state Kalman filter (2017), 5 and 6.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stages.geometry.frames import Array64
from stages.kernels.heading.prediction import predict_states
from stages.kernels.heading.preintegration import preintegrate

GRAVITY_MPS2 = np.array([0.0, 0.0, -9.80665])  # standard gravity, map axes
SIZE = 15
THETA, POSITION, VELOCITY = slice(0, 3), slice(3, 6), slice(6, 9)
ACCEL_BIAS, GYRO_BIAS, BIASES = slice(9, 12), slice(12, 15), slice(9, 15)
ACCEL_WALK, GYRO_WALK = 0.005, 1e-4  # random walk of the biases [m/s^2 / sqrt(s)], [rad/s / sqrt(s)]


@dataclass(frozen=True)
class ImuIntervals:
    """Consecutive IMU intervals."""

    step_s: Array64  # (n,)
    force_mps2: Array64  # (n, 3) specific force, drone axes
    rate_radps: Array64  # (n, 3)
    force_noise: Array64  # (n, 3) [m/s^2 / sqrt(Hz)]
    rate_noise: Array64  # (n, 3) [rad/s / sqrt(Hz)]

    @property
    def seconds(self) -> float:
        """Total duration [s]."""
        return float(self.step_s.sum())


@dataclass
class InertialState:
    """n hypotheses; each array has n rows."""

    R: Array64  # (n, 3, 3) R_map_drone
    xyz_m: Array64  # (n, 3) map
    velocity_mps: Array64  # (n, 3) map
    bias: Array64  # (n, 6) accelerometer [m/s^2], gyroscope [rad/s], drone axes
    covariance: Array64  # (n, 15, 15)

    def __len__(self) -> int:
        return len(self.xyz_m)

    def contiguous(self) -> tuple[Array64, Array64, Array64, Array64, Array64]:
        """All arrays, as compiled functions take them."""
        arrays = self.R, self.xyz_m, self.velocity_mps, self.bias, self.covariance
        R, xyz_m, velocity_mps, bias, covariance = map(np.ascontiguousarray, arrays)
        return R, xyz_m, velocity_mps, bias, covariance

    def rows(self, index: NDArray[np.intp]) -> InertialState:
        """The hypotheses of an index array."""
        return InertialState(
            self.R[index], self.xyz_m[index], self.velocity_mps[index], self.bias[index], self.covariance[index]
        )

    @property
    def yaw_rad(self) -> Array64:
        """(n,) rotation about the vertical: of R with its tilt removed."""
        R = self.R
        return np.arctan2(R[:, 1, 0] - R[:, 0, 1], R[:, 0, 0] + R[:, 1, 1])

    @property
    def yaw_variance_rad2(self) -> Array64:
        """(n,) variance of the rotation about the vertical."""
        up = self.R[:, 2, :]
        return np.einsum("ni,nij,nj->n", up, self.covariance[:, THETA, THETA], up)

    def moved(self, by: Array64) -> InertialState:
        """Each hypothesis moved by an error (n, 15), same covariance; the rotation's tangent is transported."""
        turn = exp_rotations(by[:, THETA])
        reset = np.tile(np.eye(SIZE), (len(self), 1, 1))
        reset[:, THETA, THETA] -= 0.5 * hats(by[:, THETA])
        return InertialState(
            self.R @ turn,
            self.xyz_m + by[:, POSITION],
            self.velocity_mps + by[:, VELOCITY],
            self.bias + by[:, BIASES],
            reset @ self.covariance @ np.swapaxes(reset, 1, 2),
        )


def hats(v: Array64) -> Array64:
    """(n, 3, 3): cross product matrices of (n, 3)."""
    out = np.zeros((len(v), 3, 3))
    out[:, 0, 1], out[:, 0, 2], out[:, 1, 2] = -v[:, 2], v[:, 1], -v[:, 0]
    out[:, 1, 0], out[:, 2, 0], out[:, 2, 1] = v[:, 2], -v[:, 1], v[:, 0]
    return out


def exp_rotations(phi_rad: Array64) -> Array64:
    """Rotations (n, 3, 3) of rotation vectors (n, 3)."""
    angle = np.linalg.norm(phi_rad, axis=1)[:, None, None]
    K = hats(phi_rad)
    a = np.maximum(angle, 1e-8)
    return np.eye(3) + np.sin(a) / a * K + (1.0 - np.cos(a)) / a**2 * (K @ K)


def log_rotations(R: Array64) -> Array64:
    """Rotation vectors (n, 3) of rotations (n, 3, 3); the angle up to pi, accurate away from pi."""
    axis = 0.5 * np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1)
    sin, cos = np.linalg.norm(axis, axis=1), 0.5 * (R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2] - 1.0)
    angle = np.arctan2(sin, cos)
    return axis * (angle / np.maximum(sin, 1e-12))[:, None]


def predict(state: InertialState, imu: ImuIntervals, weight: Array64) -> InertialState:
    """The state after some IMU intervals; `weight` (n,) sums to 1. The biases are corrected to first order."""
    mean = weight @ state.bias
    T = imu.seconds
    dR, dv, dp, J, C = preintegrate(
        imu.step_s, imu.force_mps2, imu.rate_radps, imu.force_noise, imu.rate_noise, mean.reshape(2, 3)
    )
    walk = np.zeros(SIZE)
    walk[ACCEL_BIAS], walk[GYRO_BIAS] = ACCEL_WALK**2 * T, GYRO_WALK**2 * T
    moved = predict_states(
        *state.contiguous(),
        *(dR, dv, dp, J, C, mean, T, GRAVITY_MPS2, walk),
    )
    return InertialState(*moved[:3], state.bias, moved[3])


FREE_ACCELERATION, FREE_RATE = 2.2, 0.7  # process noise without an IMU [m/s^2 / sqrt(Hz)], [rad/s / sqrt(Hz)]
FREE_MOST_RAD = 0.35  # largest sigma of the rotation about each axis without an IMU


def predict_free(state: InertialState, seconds: float, turn: Array64, variance_rad2: float | None) -> InertialState:
    """The state after a time without an IMU: constant velocity, and a rotation (3, 3) with the variance of each axis.

    variance_rad2 None: the rotation is not measured, `turn` is a guess.
    """
    n, T = len(state), seconds
    F = np.tile(np.eye(SIZE), (n, 1, 1))
    F[:, THETA, THETA] = turn.T
    F[:, POSITION, VELOCITY] = T * np.eye(3)
    P = F @ state.covariance @ np.swapaxes(F, 1, 2)
    q, three = FREE_ACCELERATION**2, np.eye(3)
    known = np.trace(P[:, THETA, THETA], axis1=1, axis2=2) < 3 * FREE_MOST_RAD**2
    variance = min(FREE_RATE**2 * T, FREE_MOST_RAD**2) if variance_rad2 is None else variance_rad2
    P[known, THETA, THETA] += variance * three
    P[:, VELOCITY, VELOCITY] += q * T * three
    P[:, POSITION, POSITION] += q * T**3 / 3 * three
    P[:, POSITION, VELOCITY] += q * T**2 / 2 * three
    P[:, VELOCITY, POSITION] += q * T**2 / 2 * three
    symmetric = 0.5 * (P + np.swapaxes(P, 1, 2))
    xyz_m = state.xyz_m + T * state.velocity_mps
    return InertialState(state.R @ turn, xyz_m, state.velocity_mps, state.bias, symmetric)


def yaw_sigma_rad(R: Array64, covariance: Array64) -> float:
    """Sigma of the rotation about the vertical [rad]; R (3, 3), and a covariance whose first block is its tangent's."""
    return math.sqrt(max(float(R[2] @ covariance[:3, :3] @ R[2]), 0.0))

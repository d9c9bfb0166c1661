"""Measurements of the bank of yaw hypotheses: residual, derivative and noise of each kind.

    LiDAR position      z = p + e
    vertical            u = R^T e_z, by the autopilot's roll and pitch
    vanishing points    R Z^T = E: one of four rotations, 90 deg of yaw apart, equally probable
    direction of flight |v| d = R^T v, by the drone's camera
    turn between images the gyroscope's mean rate less the mean rate by images is the gyroscope's bias

Source: ours; the outlier shares: stages/heading/hypothesis_bank.py.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64, rotation_z
from stages.heading.inertial_bank import InertialBank
from stages.heading.inertial_state import GYRO_BIAS, POSITION, SIZE, THETA, VELOCITY, hats, log_rotations

POSITION_OUTLIERS, POSITION_DENSITY = 0.02, 1.0 / (4.0 / 3.0 * math.pi * 5.0**3)  # false returns within 5 m
TILT_OUTLIERS, TILT_DENSITY = 0.05, 1.0
ROTATION_OUTLIERS, ROTATION_DENSITY = 0.05, 1.0 / (8 * math.pi**2)  # uniform over the rotations
DIRECTION_OUTLIERS = 0.3
RATE_OUTLIERS, RATE_DENSITY = 0.1, 1.0
SPEED_NOISE_MPS = 0.25  # change of the velocity within an interval of images
LEAST_MPS = 0.5  # a slower drone has no direction of flight
QUARTERS = np.array([rotation_z(0.5 * math.pi * k) for k in range(4)])


def add_position(bank: InertialBank, xyz_m: Array64, covariance_m2: Array64) -> float:
    """Add a LiDAR position in map. Returns the probability that it is no outlier."""
    H = np.zeros((len(bank.state), 3, SIZE))
    H[:, :, POSITION] = np.eye(3)
    return bank.update(xyz_m - bank.state.xyz_m, H, covariance_m2, POSITION_OUTLIERS, POSITION_DENSITY)


def add_vertical(bank: InertialBank, up_drone: Array64, sigma_rad: float) -> float:
    """Add the vertical (3,) in drone axes. Returns the probability that it is no outlier."""
    up = bank.state.R[:, 2, :]
    H = np.zeros((len(up), 3, SIZE))
    H[:, :, THETA] = hats(up)
    return bank.update(up_drone - up, H, sigma_rad**2 * np.eye(3), TILT_OUTLIERS, TILT_DENSITY)


def nearest_quarter(R: Array64, R_map_drone: Array64, R_map_vehicle: Array64) -> tuple[Array64, Array64]:
    """For each of some rotations R (n, 3, 3), the nearest of four, 90 deg apart about the vehicle's vertical.

    Returns the residuals (n, 3) and the nearest rotations (n, 3, 3).
    """
    four = R_map_vehicle @ QUARTERS @ R_map_vehicle.T @ R_map_drone
    off = np.stack([log_rotations(np.swapaxes(R, 1, 2) @ Z) for Z in four], axis=1)
    near = np.argmin(np.linalg.norm(off, axis=2), axis=1)
    return off[np.arange(len(off)), near], four[near]


def add_rotation(bank: InertialBank, R_map_drone: Array64, R_map_vehicle: Array64, covariance_rad2: Array64) -> float:
    """Add a rotation by vanishing points, its branch unknown; covariance in drone axes. Returns P of no outlier."""
    H = np.zeros((len(bank.state), 3, SIZE))
    H[:, :, THETA] = np.eye(3)
    residual, _ = nearest_quarter(bank.state.R, R_map_drone, R_map_vehicle)
    return bank.update(residual, H, covariance_rad2, ROTATION_OUTLIERS, 4.0 * ROTATION_DENSITY)


def add_direction(bank: InertialBank, direction_drone: Array64, sigma_rad: float, interval_s: float) -> None:
    """Add the direction of flight (3,) over an interval that ends now, in drone axes of now."""
    state = bank.state
    speed = np.linalg.norm(state.velocity_mps, axis=1)
    if float(bank.weight @ speed) < LEAST_MPS:
        return
    own = np.einsum("nji,nj->ni", state.R, state.velocity_mps)
    H = np.zeros((len(state), 3, SIZE))
    H[:, :, THETA] = hats(own)
    H[:, :, VELOCITY] = np.swapaxes(state.R, 1, 2)
    noise = ((speed * sigma_rad) ** 2 + SPEED_NOISE_MPS**2)[:, None, None] * np.eye(3)
    density = 1.0 / (4.0 / 3.0 * math.pi * float(speed.max()) ** 3)
    bank.update(speed[:, None] * direction_drone - own, H, noise, DIRECTION_OUTLIERS, density)


def add_turn(bank: InertialBank, rate_radps: Array64, rate_visual_radps: Array64, covariance: Array64) -> None:
    """Add the mean rates (3,) over an interval by the gyroscope and by images; covariance of the latter, drone axes."""
    H = np.zeros((len(bank.state), 3, SIZE))
    H[:, :, GYRO_BIAS] = np.eye(3)
    residual = rate_radps - rate_visual_radps - bank.state.bias[:, 3:]
    bank.update(residual, H, covariance, RATE_OUTLIERS, RATE_DENSITY)

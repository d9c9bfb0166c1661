"""Measurements of the bank of yaw hypotheses: residual, derivative and noise of each kind.

    LiDAR position      z = p + e
    vertical            u = R^T e_z, by the autopilot's roll and pitch
    direction of flight |v| d = R^T v, by the drone's camera
    turn between images the gyroscope's mean rate less the mean rate by images is the gyroscope's bias
    magnetic field      the gyroscope's bias about the vertical

Rotations by both cameras: rotation_matches.py.

Source: ours.
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.heading.inertial_bank import InertialBank
from stages.heading.inertial_state import GYRO_BIAS, POSITION, SIZE, THETA, VELOCITY, hats
from stages.messages import GyroBias

POSITION_OUTLIERS, POSITION_DENSITY = 0.02, 1.0 / (4.0 / 3.0 * math.pi * 5.0**3)  # false returns within 5 m
TILT_OUTLIERS, TILT_DENSITY = 0.05, 1.0
DIRECTION_OUTLIERS = 0.3
RATE_OUTLIERS, RATE_DENSITY = 0.1, 1.0
SPEED_NOISE_MPS = 0.25  # change of the velocity within an interval of images
LEAST_MPS = 0.5  # a slower drone has no direction of flight


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


def add_vertical_gyro_bias(bank: InertialBank, measured: GyroBias) -> None:
    """Add a measurement of the gyroscope's bias about the vertical."""
    H = np.zeros((len(bank.state), 1, SIZE))
    H[:, 0, GYRO_BIAS] = measured.up_drone
    residual = measured.bias_radps - bank.state.bias[:, 3:] @ measured.up_drone
    bank.update(residual[:, None], H, np.array([[measured.sigma_radps**2]]), RATE_OUTLIERS, RATE_DENSITY)

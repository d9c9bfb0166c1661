"""Messages of an autopilot for the tests of the drone's motion: an accelerating flight at a constant turn rate."""

from __future__ import annotations

from typing import Any

import numpy as np

from stages.geometry.frames import rotation_z
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import DroneAttitude, DroneImu, DroneLocalPosition, DroneOdometry, DroneTilt

START, MS = 1_748_773_230_000_000_000, 1_000_000
RATE = np.array([0.02, -0.03, 0.4])
R_START = rotation_z(0.7) @ exp_rotation(np.array([0.1, 0.2, 0.0]))
ACCELERATION = np.array([0.5, -0.3, 0.1])  # odom
VELOCITY = np.array([2.0, 1.0, 0.0])
POSITION = np.array([10.0, -4.0, 15.0])
GRAVITY = np.array([0.0, 0.0, 9.80665])


def stamp(at_ms: float) -> int:
    return START + round(at_ms * MS)


def R_odom_drone(at_ms: float) -> np.ndarray:
    return R_START @ exp_rotation(1e-3 * at_ms * RATE)


def velocity(at_ms: float) -> np.ndarray:
    return VELOCITY + 1e-3 * at_ms * ACCELERATION


def position(at_ms: float) -> np.ndarray:
    t = 1e-3 * at_ms
    return POSITION + t * VELOCITY + 0.5 * t * t * ACCELERATION


def imu(at_ms: float, **changes: Any) -> DroneImu:
    values = {
        "acceleration_drone_mps2": R_odom_drone(at_ms).T @ (ACCELERATION + GRAVITY),
        "angular_velocity_drone_radps": RATE,
    }
    return DroneImu(stamp_ns=stamp(at_ms), **(values | changes))


def attitude(at_ms: float, independent: bool = True, R: np.ndarray | None = None) -> DroneAttitude:
    return DroneAttitude(
        stamp_ns=stamp(at_ms),
        R_odom_drone=R_odom_drone(at_ms) if R is None else R,
        angular_velocity_drone_radps=RATE,
        independent=independent,
    )


def tilt(at_ms: float) -> DroneTilt:
    return DroneTilt(
        stamp_ns=stamp(at_ms), up_drone=R_odom_drone(at_ms)[2].copy(), sigma_rad=0.02, angular_velocity_drone_radps=None
    )


def local_position(
    at_ms: float, independent: bool = True, jump_m: float = 0.0, jump_mps: float = 0.0
) -> DroneLocalPosition:
    return DroneLocalPosition(
        stamp_ns=stamp(at_ms),
        xyz_odom_m=position(at_ms) + np.array([jump_m, 0, 0]),
        velocity_odom_mps=velocity(at_ms) + np.array([0, jump_mps, 0]),
        independent=independent,
    )


def odometry(at_ms: float, independent: bool = True, counter: int = 3, quality: int | None = 90) -> DroneOdometry:
    return DroneOdometry(
        stamp_ns=stamp(at_ms),
        xyz_odom_m=position(at_ms),
        R_odom_drone=R_odom_drone(at_ms),
        velocity_drone_mps=R_odom_drone(at_ms).T @ velocity(at_ms),
        angular_velocity_drone_radps=RATE,
        pose_covariance=None,
        velocity_covariance=None,
        reset_counter=counter,
        quality_percent=quality,
        independent=independent,
    )

"""Returns placed by a mount, and the derivatives of their distance from a plane by each parameter.

Source: ours: derivatives of `stages/calibration/servo_mount.py`'s two formulas.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stages.calibration.scan_passes import Returns, ServoAt
from stages.calibration.servo_mount import ORDERS, ServoMount
from stages.geometry.frames import Array64


class Placed(NamedTuple):
    """Returns in the base frame (n, 3); `turned`: cosine and sine (n, 2) of the turntable's angle."""

    xyz_m: Array64
    origin_m: Array64  # origin of each beam
    direction: Array64  # of the beam, unit
    turned: Array64
    servo: ServoAt

    def taken(self, index: NDArray[np.int64]) -> Placed:
        """The returns at `index`."""
        return Placed(
            self.xyz_m[index],
            self.origin_m[index],
            self.direction[index],
            self.turned[index],
            self.servo.taken(index),
        )


def place(returns: Returns, servo: ServoAt, mount: ServoMount, bias_m: Array64) -> Placed:
    """Place returns by a mount; bias_m (lasers,) is subtracted from each laser's ranges. NaN where the angle is NaN."""
    angle = mount.sign * (servo.position_rad - servo.play_side * mount.play_rad / 2 - mount.zero_rad)
    angle = angle - mount.encoder_error_rad(servo.position_rad)
    turned = np.column_stack([np.cos(angle), np.sin(angle)])
    along = returns.xyz_lidar_m / np.linalg.norm(returns.xyz_lidar_m, axis=1, keepdims=True)
    xyz = returns.xyz_lidar_m - bias_m[returns.laser, None] * along
    R, t = mount.R_turntable_lidar, mount.t_turntable_lidar_m
    return Placed(
        xyz_m=about_z(xyz @ R.T + t, turned),
        origin_m=about_z(np.broadcast_to(t, xyz.shape), turned),
        direction=about_z(along @ R.T, turned),
        turned=turned,
        servo=servo,
    )


def about_z(xyz: Array64, turned: Array64) -> Array64:
    """Vectors (n, 3) rotated about z by angles given as cosine and sine (n, 2)."""
    c, s = turned[:, 0], turned[:, 1]
    return np.column_stack([c * xyz[:, 0] - s * xyz[:, 1], s * xyz[:, 0] + c * xyz[:, 1], xyz[:, 2]])


def mount_columns(placed: Placed, normal: Array64, mount: ServoMount) -> dict[str, Array64]:
    """d(normal . p) / d(parameter), (n,) each, by the parameter's name; normals (n, 3)."""
    p, arm, servo = placed.xyz_m, placed.xyz_m - placed.origin_m, placed.servo
    c, s = placed.turned[:, 0], placed.turned[:, 1]
    x, y = np.column_stack([c, s, 0 * c]), np.column_stack([-s, c, 0 * c])  # the turntable's axes
    by_angle = normal[:, 1] * p[:, 0] - normal[:, 0] * p[:, 1]  # normal . (z x p)
    columns = {
        "tilt_x": np.einsum("ij,ij->i", np.cross(x, arm), normal),
        "tilt_y": np.einsum("ij,ij->i", np.cross(y, arm), normal),
        "axis_x": np.einsum("ij,ij->i", x, normal),
        "axis_y": np.einsum("ij,ij->i", y, normal),
    }
    slope = np.full(len(p), float(mount.sign))  # of the turntable's angle over the encoder's position
    for order, (sine, cosine) in mount.sin_cos_rad.items():
        at = order * servo.position_rad
        slope -= order * (sine * np.cos(at) - cosine * np.sin(at))
    for order in ORDERS:
        columns[f"sin_{order}"] = -by_angle * np.sin(order * servo.position_rad)
        columns[f"cos_{order}"] = -by_angle * np.cos(order * servo.position_rad)
    columns["play"] = -0.5 * mount.sign * by_angle * servo.play_side
    columns["time"] = -by_angle * slope * servo.rate_radps
    columns["zero"] = -mount.sign * by_angle
    return columns


def laser_columns(placed: Placed, normal: Array64, laser: NDArray[np.uint8], lasers: int) -> Array64:
    """d(normal . p) / d(bias of each laser), (n, lasers)."""
    columns = np.zeros((len(laser), lasers))
    columns[np.arange(len(laser)), laser] = -np.einsum("ij,ij->i", placed.direction, normal)
    return columns


def drift_columns(placed: Placed, normal: Array64, since_s: Array64) -> Array64:
    """d(normal . p) / d(velocity, turn rate) of a vehicle in steady motion, (n, 6), x, y, z each."""
    turning = np.cross(placed.xyz_m, normal)  # normal . (e x p) = e . (p x normal)
    return np.column_stack([normal, turning]) * since_s[:, None]

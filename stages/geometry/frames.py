"""The frames of the project, and rigid transforms between them.

| frame     | origin and axes                                                                          |
| --------- | ---------------------------------------------------------------------------------------- |
| map       | the vehicle frame at the start of the vehicle's odometry; gravity aligned, z up (REP-105) |
| odom      | the local frame of the drone's autopilot; z up, any yaw; continuous within one segment    |
| vehicle   | at the vehicle camera; x forward, y left, z up                                            |
| turntable | on the servo's axis; z up along the axis; rotates with the servo angle                    |
| lidar     | VLP-16: z_lidar is the spin axis, azimuth 0 along +y_lidar, growing towards +x_lidar      |
| drone     | at the centre of the drone's body; x forward, y left, z up                                |
| camera    | at the lens; z along the optical axis, x right in the image, y down                       |
| world     | the ground truth frame of the simulator; no stage uses it                                 |

The vehicle camera is mounted on `vehicle`, the drone camera on `drone` (CameraMount). Directions and rotations derived
from images are given in the axes of the mount, not of the lens. A reset of the autopilot's estimate begins a new
segment of `odom`: displacements within a segment are meaningful, those across segments are not.

`T_a_b` takes points from b to a: p_a = T_a_b @ p_b (4x4, float64). NED and FRD occur in links/mavlink only.

Source: DESIGN, Frames; REP-105; VLP-16 user manual 63-9243, section 9 (lidar axes).
"""

from __future__ import annotations

import math
import operator
from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from flow.stage import StrictModel

Array64 = NDArray[np.float64]
Angle = TypeVar("Angle", float, Array64)
Vector3 = tuple[float, float, float]


def rotation_from_rpy_deg(rpy_deg: Vector3) -> Array64:
    """Rotation (3, 3) R = Rz(yaw) Ry(pitch) Rx(roll), fixed axes as in URDF, in degrees."""
    roll, pitch, yaw = (math.radians(a) for a in rpy_deg)
    cr, sr, cp, sp, cy, sy = (f(a) for a in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def rotation_from_quaternion_xyzw(quaternion_xyzw: tuple[float, float, float, float]) -> Array64:
    """Rotation (3, 3) of a quaternion (x, y, z, w), which is normalised first."""
    x, y, z, w = np.asarray(quaternion_xyzw, dtype=np.float64) / math.hypot(*quaternion_xyzw)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternions_xyzw(rotations: Array64) -> Array64:
    """Quaternions (n, 4) with w >= 0 of rotations (n, 3, 3), by the eigenvectors of Bar-Itzhack's matrix (2000)."""
    R = rotations
    K = np.zeros((len(R), 4, 4))  # eigh reads the lower half only
    K[:, 0, 0] = R[:, 0, 0] - R[:, 1, 1] - R[:, 2, 2]
    K[:, 1, 1] = R[:, 1, 1] - R[:, 0, 0] - R[:, 2, 2]
    K[:, 2, 2] = R[:, 2, 2] - R[:, 0, 0] - R[:, 1, 1]
    K[:, 3, 3] = R[:, 0, 0] + R[:, 1, 1] + R[:, 2, 2]
    K[:, 1, 0], K[:, 2, 0], K[:, 2, 1] = (R[:, i, j] + R[:, j, i] for i, j in ((1, 0), (2, 0), (2, 1)))
    K[:, 3, 0], K[:, 3, 1], K[:, 3, 2] = (R[:, i, j] - R[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    q = np.linalg.eigh(K)[1][:, :, -1]
    return np.where(q[:, 3:] >= 0, q, -q)


def rotations_from_xyzw(quaternions: Array64) -> Array64:
    """Rotations (n, 3, 3) of quaternions (n, 4) of any length."""
    x, y, z, w = (quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True)).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
        [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
        [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
    ]
    return np.moveaxis(np.array(rows), 2, 0)


def rotation_z(angle_rad: float) -> Array64:
    """Rotation (3, 3) about z by `angle_rad`, counter-clockwise seen from above."""
    c, s = math.cos(angle_rad), math.sin(angle_rad)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def heading_rad(R: Array64) -> float:
    """Yaw [rad] of a rotation (3, 3) that is nearly about z; a remaining tilt affects both axes equally."""
    return math.atan2(R[1, 0] - R[0, 1], R[0, 0] + R[1, 1])


def level_axes(up: Array64) -> Array64:
    """R_body_level (3, 3): z is `up` (3,) in body axes, x the levelled x axis of the body (y where x is upright)."""
    z = up / np.linalg.norm(up)
    forward = np.array([1.0, 0.0, 0.0]) if abs(z[0]) < 0.9 else np.array([0.0, 1.0, 0.0])
    x = forward - (forward @ z) * z
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def transform(rotation: Array64, translation_m: Array64) -> Array64:
    """T_a_b (4, 4) from R_a_b (3, 3) and the origin of b in a (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation_m
    return T


class Pose(StrictModel):
    """A transform in a configuration file: `{xyz_m: [0, 0, 1.2], rpy_deg: [0, 0, 90]}` or with `quaternion_xyzw`."""

    xyz_m: Vector3 = (0.0, 0.0, 0.0)
    rpy_deg: Vector3 | None = None
    quaternion_xyzw: tuple[float, float, float, float] | None = None

    @model_validator(mode="after")
    def _one_rotation(self) -> Pose:
        if self.rpy_deg is not None and self.quaternion_xyzw is not None:
            raise ValueError("give rpy_deg or quaternion_xyzw, not both")
        if self.quaternion_xyzw is not None and abs(math.hypot(*self.quaternion_xyzw) - 1.0) > 1e-3:
            raise ValueError("quaternion_xyzw must have length 1")
        return self

    def matrix(self) -> Array64:
        """The transform as (4, 4)."""
        if self.quaternion_xyzw is not None:
            rotation = rotation_from_quaternion_xyzw(self.quaternion_xyzw)
        else:
            rotation = rotation_from_rpy_deg(self.rpy_deg or (0.0, 0.0, 0.0))
        return transform(rotation, np.asarray(self.xyz_m, dtype=np.float64))


class Harmonic(StrictModel):
    """One term of the servo encoder's error: amplitude * sin(order * angle + phase)."""

    order: Annotated[int, Field(ge=1, le=16)]
    amplitude_deg: Annotated[float, Field(ge=0, le=5)]
    phase_deg: float = 0.0


UNCALIBRATED_DEG = 0.3  # MX-28 without calibration: encoder error, half the gear play, zero set by eye


def _is_uncalibrated(value: float) -> bool:
    return value == UNCALIBRATED_DEG


class LidarMount(StrictModel):
    """Mount of the LiDAR on the vehicle: T_vehicle_lidar = T_vehicle_turntable Rz(angle) T_turntable_lidar.

    angle = sign * (servo position - zero) - encoder error. `turns: false` is a fixed LiDAR without servo.
    A servo stamp is corrected by `servo_time_offset_s` before interpolation (positive: the servo's stamps are early).
    `servo_play_deg` is the gear's backlash, end to end: the table lags by half of it (`stages/sweep/turntable.py`).
    Files contain it only where it is not zero. `pointing_sigma_deg` is one sigma of the angle's systematic error;
    `grd calibrate` writes it.
    """

    T_vehicle_turntable: Pose = Pose()
    T_turntable_lidar: Pose = Pose()
    turns: bool = True
    servo_sign: Literal[1, -1] = 1
    servo_zero_deg: float = 0.0
    servo_time_offset_s: Annotated[float, Field(ge=-0.5, le=0.5)] = 0.0
    servo_harmonics: tuple[Harmonic, ...] = ()
    servo_play_deg: Annotated[float, Field(ge=0, le=5, exclude_if=operator.not_)] = 0.0
    pointing_sigma_deg: Annotated[float, Field(ge=0, le=5, exclude_if=_is_uncalibrated)] = UNCALIBRATED_DEG

    def turntable_rad(self, servo_rad: Angle) -> Angle:
        """Turntable angle for servo encoder positions, one or (n,) [rad]."""
        sin: Any = math.sin if isinstance(servo_rad, float) else np.sin
        angle: Any = self.servo_sign * (servo_rad - math.radians(self.servo_zero_deg))
        for term in self.servo_harmonics:
            angle = angle - math.radians(term.amplitude_deg) * sin(
                term.order * servo_rad + math.radians(term.phase_deg)
            )
        return angle

    def servo_rad(self, turntable_rad: float) -> float:
        """Servo position for a turntable angle [rad]: the inverse of `turntable_rad`, by fixed-point iteration.

        The encoder error is below 5 deg and smooth: each iteration gains at least one digit.
        """
        servo = math.radians(self.servo_zero_deg) + self.servo_sign * turntable_rad
        for _ in range(4 if self.servo_harmonics else 0):
            servo += self.servo_sign * (turntable_rad - self.turntable_rad(servo))
        return servo

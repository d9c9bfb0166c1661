"""MAVLink messages of the flight stack from its estimate, its IMU and its filter.

RAW_IMU and SCALED_IMU hold integers: mg and mrad/s. RAW_IMU's time_usec is the time of sending, as in ArduPilot.

Source: https://mavlink.io/en/messages/common.html; ArduPilot GCS_Common.cpp (send_raw_imu, send_scaled_imu,
send_local_position, send_ekf_status_report), AP_NavEKF3_Outputs.cpp; PX4 src/modules/mavlink/streams.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.ned_frd import (
    flip_yz,
    rpy_from_R_odom_drone,
    upper_from_pose_covariance,
    upper_from_velocity_covariance,
    wxyz_from_R_odom_drone,
)
from stages.cues.geodesy import Geographic
from stages.geometry.frames import Array64, rotation_from_quaternion_xyzw

mavlink: Any = ardupilotmega
STANDARD_GRAVITY_MPS2 = 9.80665
INT16 = 32767
NO_FIX, FIX_3D, UNKNOWN, SATELLITES = 1, 3, 65_535, 14  # GPS_FIX_TYPE; fields that are not known; of a good fix
MS, US = 1_000_000, 1_000


def attitude(device_ns: int, estimate: Array64, gyro: Array64) -> Any:
    """ATTITUDE; estimate (10,): p, v, quaternion xyzw; gyro: rate without the estimated bias, body axes."""
    R = rotation_of(estimate)
    return mavlink.MAVLink_attitude_message(device_ns // MS, *rpy_from_R_odom_drone(R), *flip_yz(gyro))


def local_position(device_ns: int, estimate: Array64) -> Any:
    """LOCAL_POSITION_NED."""
    return mavlink.MAVLink_local_position_ned_message(device_ns // MS, *flip_yz(estimate[0:3]), *flip_yz(estimate[3:6]))


def odometry(device_ns: int, estimate: Array64, gyro: Array64, P: Array64, resets: int, px4: bool) -> Any:
    """ODOMETRY with the filter's covariance P (15, 15): LOCAL_FRD and BODY_FRD; PX4: all but the rates in LOCAL_NED."""
    R = rotation_of(estimate)
    frames = (mavlink.MAV_FRAME_LOCAL_FRD, mavlink.MAV_FRAME_BODY_FRD)
    velocity_mps = R.T @ estimate[3:6]
    if px4:
        frames, velocity_mps = (mavlink.MAV_FRAME_LOCAL_NED, mavlink.MAV_FRAME_LOCAL_NED), estimate[3:6]
    covariance, velocity = np.zeros((6, 6)), np.zeros((6, 6))
    covariance[:3, :3], covariance[3:, 3:] = P[6:9, 6:9], R.T @ P[0:3, 0:3] @ R
    velocity[:3, :3], velocity[3:, 3:] = P[9:12, 9:12], R.T @ P[3:6, 3:6] @ R
    return mavlink.MAVLink_odometry_message(
        device_ns // US,
        *frames,
        *flip_yz(estimate[0:3]),
        wxyz_from_R_odom_drone(R),
        *flip_yz(velocity_mps),
        *flip_yz(gyro),
        upper_from_pose_covariance(covariance, R),
        upper_from_velocity_covariance(velocity),
        resets % 256,
        mavlink.MAV_ESTIMATOR_TYPE_AUTOPILOT,
        0,
    )


def raw_imu(device_ns: int, sample: Array64, field_ut: Array64) -> Any:
    """RAW_IMU of a sample (6,): gyro, accelerometer, body axes; magnetic field (3,)."""
    return mavlink.MAVLink_raw_imu_message(device_ns // US, *imu_counts(sample), *field_counts(field_ut))


def scaled_imu(device_ns: int, sample: Array64, field_ut: Array64) -> Any:
    """SCALED_IMU."""
    return mavlink.MAVLink_scaled_imu_message(device_ns // MS, *imu_counts(sample), *field_counts(field_ut))


def highres_imu(device_ns: int, sample: Array64, field_ut: Array64) -> Any:
    """HIGHRES_IMU (PX4), SI units and gauss."""
    values = [*flip_yz(sample[3:6]).tolist(), *flip_yz(sample[0:3]).tolist(), *flip_yz(0.01 * field_ut).tolist()]
    return mavlink.MAVLink_highres_imu_message(device_ns // US, *values, *[0.0] * 4, 0b111_111_111)


def gps_raw(device_ns: int, fix: Geographic | None, sigma_m: float) -> Any:
    """GPS_RAW_INT of the newest fix, with its horizontal accuracy; None: no fix."""
    if fix is None:
        return mavlink.MAVLink_gps_raw_int_message(device_ns // US, NO_FIX, 0, 0, 0, *[UNKNOWN] * 4, 0)
    position = round(1e7 * math.degrees(fix.latitude_rad)), round(1e7 * math.degrees(fix.longitude_rad))
    altitude_mm, accuracy_mm = round(1e3 * fix.altitude_m), round(1e3 * sigma_m)
    return mavlink.MAVLink_gps_raw_int_message(
        device_ns // US, FIX_3D, *position, altitude_mm, *[UNKNOWN] * 4, SATELLITES, h_acc=accuracy_mm
    )


def field_counts(field_ut: Array64) -> list[int]:
    """mgauss as integers, FRD axes."""
    return np.rint(10.0 * flip_yz(field_ut)).astype(int).tolist()


def imu_counts(sample: Array64) -> list[int]:
    """mg and mrad/s as integers, FRD axes, clipped to 16 bits; ArduPilot converts by truncation."""
    counts = np.concatenate([flip_yz(sample[3:6]) / STANDARD_GRAVITY_MPS2, flip_yz(sample[0:3])]) * 1e3
    return np.clip(np.trunc(counts), -INT16, INT16).astype(int).tolist()


def status_flags(*, attitude: bool, velocity: bool, position: bool, height: bool, constant: bool, gps: bool) -> int:
    """Bits that EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS have in common."""
    flags = 1 * attitude + 2 * velocity + 4 * (velocity or height) + 8 * position + 16 * position + 32 * height
    return flags + 128 * constant + 256 * position + 512 * (position and gps)


def ekf_status(flags: int, ratios: tuple[float, float, float, float]) -> Any:
    """EKF_STATUS_REPORT: velocity, position, height and compass "variances" are roots of test ratios."""
    velocity, position, height, yaw = (math.sqrt(max(r, 0.0)) for r in ratios)
    return mavlink.MAVLink_ekf_status_report_message(flags, velocity, position, height, yaw, 0.0, 0.0)


def estimator_status(device_ns: int, flags: int, ratios: tuple[float, float, float, float], P: Array64) -> Any:
    """ESTIMATOR_STATUS (PX4): test ratios, and one sigma of position."""
    velocity, position, height, yaw = (math.sqrt(max(r, 0.0)) for r in ratios)
    accuracy = math.sqrt(P[0, 0] + P[1, 1]), math.sqrt(P[2, 2])
    return mavlink.MAVLink_estimator_status_message(
        device_ns // US, flags, velocity, position, height, yaw, 0.0, 0.0, *accuracy
    )


def rotation_of(estimate: Array64) -> Array64:
    """R_odom_drone of an estimate (10,)."""
    x, y, z, w = estimate[6:10].tolist()
    return rotation_from_quaternion_xyzw((x, y, z, w))

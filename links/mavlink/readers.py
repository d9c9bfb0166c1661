"""Conversion of an autopilot's MAVLink messages to grd's messages, axes and units: one function per message.

RAW_IMU is read in ArduPilot's units, which are SCALED_IMU's (mg, mrad/s), HIGHRES_IMU (PX4) in SI units; which of them
is used: `streams/imu_stamps.py`. SCALED_IMU2 and SCALED_IMU3, of other sensors, are not read. The functions raise
ValueError for non-finite values.

HIGHRES_IMU is not raw: PX4 subtracts the biases that EKF2 estimates (estimator_sensor_bias). They change within tens of
seconds, and after the first sent pose they depend on it. The fusion estimates a bias of its own, which follows them.
Its magnetic field is not read: less the bias that EKF2 fits to its yaw, it would bring a yaw that grd sent back.
ArduPilot's RAW_IMU and SCALED_IMU hold the calibrated samples without the bias of its EKF.

Source: https://mavlink.io/en/messages/common.html; PX4 src/modules/mavlink/streams/HIGHRES_IMU.hpp; ArduPilot
GCS_MAVLINK::send_raw_imu for RAW_IMU's units, NavEKF3_core::send_status_report and getVariances for EKF_STATUS_REPORT.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from links.mavlink.ned_frd import (
    R_odom_drone_from_rpy,
    R_odom_drone_from_wxyz,
    pose_covariance_from_upper,
    velocity_covariance_from_upper,
)
from stages.messages import (
    AutopilotEstimator,
    AutopilotStatus,
    DroneAttitude,
    DroneGlobalPosition,
    DroneGnss,
    DroneImu,
    DroneLocalPosition,
    DroneOdometry,
    UwbRange,
)

AutopilotMessage = (
    DroneAttitude
    | DroneLocalPosition
    | DroneOdometry
    | DroneImu
    | AutopilotStatus
    | AutopilotEstimator
    | DroneGnss
    | DroneGlobalPosition
    | UwbRange
)

STANDARD_GRAVITY_MPS2 = 9.80665
LOCAL_FRAMES = (1, 20)  # MAV_FRAME_LOCAL_NED, MAV_FRAME_LOCAL_FRD
BODY_FRD = 12
FIX_3D = 3  # GPS_FIX_TYPE
UNKNOWN_SENSOR, CUSTOM_ORIENTATION = 4, 100  # MAV_DISTANCE_SENSOR_UNKNOWN, MAV_SENSOR_ROTATION_CUSTOM

# bits common to EKF_STATUS_FLAGS and ESTIMATOR_STATUS_FLAGS
ATTITUDE, VELOCITY_HORIZONTAL, VELOCITY_VERTICAL, HORIZONTAL_RELATIVE = 1, 2, 4, 8
HEIGHT, CONSTANT_POSITION, PREDICTED_RELATIVE = 32, 128, 256


def _vector(frame: Any, *names: str, unit: float = 1.0) -> NDArray[np.float64]:
    """Fields as a vector in grd's axes. Raises ValueError when one is not finite."""
    x, y, z = _numbers(frame, *names)
    return np.array([unit * x, -(unit * y), -(unit * z)])  # as `flip_yz`, but faster


def _counts(frame: Any, *names: str) -> NDArray[np.float64]:
    """Integers that were truncated towards zero, in grd's axes: n stands for n to n + 1, and 0 for -1 to 1."""
    counts = _vector(frame, *names)
    return counts + 0.5 * np.sign(counts)


def _numbers(frame: Any, *names: str) -> list[float]:
    values = [float(getattr(frame, name)) for name in names]
    if not all(map(math.isfinite, values)):
        raise ValueError("not finite")
    return values


def read_attitude(frame: Any, stamp_ns: int) -> DroneAttitude:
    """ATTITUDE."""
    return DroneAttitude(
        stamp_ns=stamp_ns,
        R_odom_drone=R_odom_drone_from_rpy(*_numbers(frame, "roll", "pitch", "yaw")),
        angular_velocity_drone_radps=_vector(frame, "rollspeed", "pitchspeed", "yawspeed"),
    )


def read_local_position(frame: Any, stamp_ns: int) -> DroneLocalPosition:
    """LOCAL_POSITION_NED."""
    return DroneLocalPosition(
        stamp_ns=stamp_ns,
        xyz_odom_m=_vector(frame, "x", "y", "z"),
        velocity_odom_mps=_vector(frame, "vx", "vy", "vz"),
    )


def read_odometry(frame: Any, stamp_ns: int) -> DroneOdometry:
    """ODOMETRY in a local frame, with the velocity in the body frame or, of PX4, in the same; others: ValueError."""
    if frame.frame_id not in LOCAL_FRAMES or frame.child_frame_id not in (BODY_FRD, frame.frame_id):
        raise ValueError("odometry in other frames")
    length = math.hypot(*frame.q)
    if not abs(length - 1.0) < 0.01:  # NaN compares false
        raise ValueError("invalid rotation")
    R_odom_drone = R_odom_drone_from_wxyz(frame.q)
    velocity_mps, in_body = _vector(frame, "vx", "vy", "vz"), frame.child_frame_id == BODY_FRD
    return DroneOdometry(
        stamp_ns=stamp_ns,
        xyz_odom_m=_vector(frame, "x", "y", "z"),
        R_odom_drone=R_odom_drone,
        velocity_drone_mps=velocity_mps if in_body else R_odom_drone.T @ velocity_mps,
        angular_velocity_drone_radps=_vector(frame, "rollspeed", "pitchspeed", "yawspeed"),
        pose_covariance=pose_covariance_from_upper(frame.pose_covariance, R_odom_drone),
        velocity_covariance=velocity_covariance_from_upper(frame.velocity_covariance) if in_body else None,
        reset_counter=frame.reset_counter,
        quality_percent=None if frame.quality == 0 else max(frame.quality, 0),
    )


def read_raw_imu(frame: Any, stamp_ns: int) -> DroneImu:
    """RAW_IMU in ArduPilot's units, or SCALED_IMU: mg, mrad/s and mgauss, truncated (by PX4, too)."""
    return DroneImu(
        stamp_ns=stamp_ns,
        acceleration_drone_mps2=1e-3 * STANDARD_GRAVITY_MPS2 * _counts(frame, "xacc", "yacc", "zacc"),
        angular_velocity_drone_radps=1e-3 * _counts(frame, "xgyro", "ygyro", "zgyro"),
        magnetic_field_drone_ut=_magnetic_field(frame),
    )


def read_highres_imu(frame: Any, stamp_ns: int) -> DroneImu:
    """HIGHRES_IMU: m/s^2 and rad/s. Its magnetic field is not read (see above)."""
    return DroneImu(
        stamp_ns=stamp_ns,
        acceleration_drone_mps2=_vector(frame, "xacc", "yacc", "zacc"),
        angular_velocity_drone_radps=_vector(frame, "xgyro", "ygyro", "zgyro"),
    )


def _magnetic_field(frame: Any) -> NDArray[np.float64] | None:
    """Field (3,) [uT] of a message in mgauss, drone axes; None: all zero, no magnetometer."""
    field = _vector(frame, "xmag", "ymag", "zmag", unit=0.1)
    return field if field.any() else None


def read_ekf_status(frame: Any, stamp_ns: int) -> AutopilotEstimator:
    """EKF_STATUS_REPORT (ArduPilot). Its "variances" are square roots of innovation test ratios."""
    names = ("velocity_variance", "pos_horiz_variance", "pos_vert_variance", "compass_variance")
    return _estimator(frame.flags, stamp_ns, [getattr(frame, name) for name in names])


def read_estimator_status(frame: Any, stamp_ns: int) -> AutopilotEstimator:
    """ESTIMATOR_STATUS (PX4)."""
    ratios = [frame.vel_ratio, frame.pos_horiz_ratio, frame.pos_vert_ratio, frame.mag_ratio]
    return _estimator(frame.flags, stamp_ns, ratios)


def _estimator(flags: int, stamp_ns: int, ratios: list[float]) -> AutopilotEstimator:
    """A ratio that is not finite or negative becomes NaN (unknown)."""
    velocity, horizontal, height, compass = (float(r) if math.isfinite(r) and r >= 0 else math.nan for r in ratios)
    moving = VELOCITY_HORIZONTAL | VELOCITY_VERTICAL
    return AutopilotEstimator(
        stamp_ns=stamp_ns,
        attitude_good=bool(flags & ATTITUDE),
        velocity_good=flags & moving == moving,
        position_good=bool(flags & HORIZONTAL_RELATIVE),
        height_good=bool(flags & HEIGHT),
        constant_position=bool(flags & CONSTANT_POSITION),
        velocity_ratio=velocity,
        horizontal_ratio=horizontal,
        height_ratio=height,
        compass_ratio=compass,
        flags=flags,
    )


def read_gps_raw(frame: Any, stamp_ns: int) -> DroneGnss:
    """GPS_RAW_INT with a 3D fix; other fixes raise ValueError. An accuracy of 0 is not reported."""
    if frame.fix_type < FIX_3D:
        raise ValueError("GNSS without a 3D fix")
    return DroneGnss(
        stamp_ns=stamp_ns,
        **_geographic(frame),
        sigma_m=1e-3 * frame.h_acc or None,
        sigma_up_m=1e-3 * frame.v_acc or None,
    )


def read_global_position(frame: Any, stamp_ns: int) -> DroneGlobalPosition:
    """GLOBAL_POSITION_INT."""
    position: dict[str, Any] = {**_geographic(frame), "altitude_above_home_m": 1e-3 * frame.relative_alt}
    return DroneGlobalPosition(stamp_ns=stamp_ns, **position)


def read_distance_sensor(frame: Any, stamp_ns: int) -> UwbRange:
    """DISTANCE_SENSOR of a ranging radio (`is_ranging_radio`)."""
    if not frame.min_distance <= frame.current_distance <= frame.max_distance or frame.current_distance == 0:
        raise ValueError("distance out of the sensor's range")
    known = 0 < frame.covariance < 255  # [cm^2]; 255: unknown
    sigma_m = 1e-2 * math.sqrt(frame.covariance) if known else None
    return UwbRange(stamp_ns=stamp_ns, range_m=1e-2 * frame.current_distance, sigma_m=sigma_m)


def is_ranging_radio(frame: Any) -> bool:
    """Whether a DISTANCE_SENSOR is of a ranging radio, type UNKNOWN, orientation CUSTOM; others are rangefinders."""
    return (frame.type, frame.orientation) == (UNKNOWN_SENSOR, CUSTOM_ORIENTATION)


def _geographic(frame: Any) -> dict[str, float]:
    """Latitude, longitude and altitude of a message with lat, lon [1e-7 deg] and alt [mm]."""
    if abs(frame.lat) > 900_000_000 or abs(frame.lon) > 1_800_000_000 or (frame.lat == 0 and frame.lon == 0):
        raise ValueError("no geographic position")
    latitude_rad, longitude_rad = math.radians(1e-7 * frame.lat), math.radians(1e-7 * frame.lon)
    return {"latitude_rad": latitude_rad, "longitude_rad": longitude_rad, "altitude_m": 1e-3 * frame.alt}


Reader = Callable[[Any, int], AutopilotMessage]

READERS: dict[str, Reader] = {
    "ATTITUDE": read_attitude,
    "LOCAL_POSITION_NED": read_local_position,
    "ODOMETRY": read_odometry,
    "RAW_IMU": read_raw_imu,
    "SCALED_IMU": read_raw_imu,
    "HIGHRES_IMU": read_highres_imu,
    "ESTIMATOR_STATUS": read_estimator_status,
    "GPS_RAW_INT": read_gps_raw,
    "GLOBAL_POSITION_INT": read_global_position,
    "DISTANCE_SENSOR": read_distance_sensor,
}
"""Readers of messages with a time stamp."""

TIMELESS_READERS: dict[str, Reader] = {"EKF_STATUS_REPORT": read_ekf_status}
"""Readers of messages without a time stamp, which are stamped at arrival."""

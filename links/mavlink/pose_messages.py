"""MAVLink messages of a relative pose: ODOMETRY, VISION_POSITION_ESTIMATE and LANDING_TARGET.

ODOMETRY and VISION_POSITION_ESTIMATE contain the drone's pose in the vehicle's *start* frame, which is static while the
vehicle drives, as an EKF requires. Its x axis is the vehicle's forward direction at the start, not north: LOCAL_FRD.
LANDING_TARGET contains the vehicle's position in the drone's body frame.

    p_drone_vehicle = -R_vehicle_drone^T t_vehicle_drone

Unknown values are NaN, never 0: an EKF fuses a velocity of zero, and the drone drifts away.

quality: 100 for a sigma of 0, 1 at the limits (`PoseLimits`), by the worse of position and rotation; 0 would mean
unknown. time_usec is host time (microseconds since 1970), the same as in TIMESYNC replies.

Source: https://mavlink.io/en/messages/common.html#ODOMETRY, #VISION_POSITION_ESTIMATE, #LANDING_TARGET;
https://ardupilot.org/dev/docs/mavlink-nongps-position-estimation.html; ArduPilot AC_PrecLand_MAVLink::handle_msg.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from links.mavlink.framing import SEQUENCE, dialect
from links.mavlink.gate import PoseLimits, velocity_to_send, worst_sigmas
from links.mavlink.ned_frd import (
    flip_yz,
    rpy_from_R_odom_drone,
    upper_from_pose_covariance,
    upper_from_velocity_covariance,
    wxyz_from_R_odom_drone,
)
from stages.messages import RelativePose

LOCAL_FRD, BODY_FRD = 20, 12  # MAV_FRAME: the only ones that ArduPilot accepts in ODOMETRY
VIO = 3  # MAV_ESTIMATOR_TYPE_VIO: accepted by PX4, unlike LIDAR
VISION_OTHER = 3  # LANDING_TARGET_TYPE
UNKNOWN = [math.nan] * 3


def quality_percent(pose: RelativePose, limits: PoseLimits) -> int:
    """Quality, 1 (at the limit) to 100 (sigma 0), linear in the larger of the two ratios of sigma to limit."""
    sigmas = worst_sigmas(pose)
    if sigmas is None:
        return 1
    worst = max(math.degrees(sigmas[0]) / limits.rotation_sigma_deg, sigmas[1] / limits.position_sigma_m)
    return max(1, min(100, round(100 * (1 - worst))))


def odometry(pose: RelativePose, reset_counter: int, limits: PoseLimits) -> Any:
    """ODOMETRY of a pose that the gate has accepted."""
    xyz_m, R, covariance = _start_pose(pose)
    velocity = velocity_to_send(pose, limits)
    return dialect().MAVLink_odometry_message(
        pose.stamp_ns // 1000,
        LOCAL_FRD,
        BODY_FRD,
        *flip_yz(xyz_m),
        wxyz_from_R_odom_drone(R),
        *(UNKNOWN if velocity is None else flip_yz(R.T @ velocity)),
        *UNKNOWN,  # angular velocity: the autopilot's gyros are better
        upper_from_pose_covariance(covariance, R),
        _velocity_upper(pose.velocity_covariance if velocity is not None else None, R),
        reset_counter % SEQUENCE,
        VIO,
        quality_percent(pose, limits),
    )


def vision_position_estimate(pose: RelativePose, reset_counter: int) -> Any:
    """VISION_POSITION_ESTIMATE of a pose that the gate has accepted; for ArduPilot only, PX4 assumes north."""
    xyz_m, R, covariance = _start_pose(pose)
    return dialect().MAVLink_vision_position_estimate_message(
        pose.stamp_ns // 1000,
        *flip_yz(xyz_m),
        *rpy_from_R_odom_drone(R),
        upper_from_pose_covariance(covariance, R),
        reset_counter % SEQUENCE,
    )


def landing_target(pose: RelativePose) -> Any:
    """LANDING_TARGET of a pose that the gate has accepted: the vehicle in the drone's body frame.

    The angles are those of the line of sight from straight down about the body's x and y axes, as ArduPilot reads them
    when the position is not valid: (-tan angle_y, tan angle_x, 1). NaN when the vehicle is not below the drone.
    """
    if pose.xyz_vehicle_m is None or pose.R_vehicle_drone is None:
        raise ValueError("a landing target needs the drone's rotation")
    x, y, z = flip_yz(-pose.R_vehicle_drone.T @ pose.xyz_vehicle_m).tolist()
    angles = (math.atan2(y, z), math.atan2(-x, z)) if z > 0 else (math.nan, math.nan)
    R_drone_vehicle = pose.R_vehicle_drone.T
    return dialect().MAVLink_landing_target_message(
        pose.stamp_ns // 1000,
        0,
        BODY_FRD,
        *angles,
        math.sqrt(x * x + y * y + z * z),
        0.0,
        0.0,
        x,
        y,
        z,
        wxyz_from_R_odom_drone(R_drone_vehicle),
        VISION_OTHER,
        1,
    )


def _start_pose(pose: RelativePose) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    if pose.xyz_map_m is None or pose.R_map_drone is None or pose.map_covariance is None:
        raise ValueError("incomplete pose: the gate must reject it")
    return pose.xyz_map_m, pose.R_map_drone, pose.map_covariance


def _velocity_upper(covariance_start: NDArray[np.float64] | None, R_map_drone: NDArray[np.float64]) -> list[float]:
    """21 numbers, drone axes; those of the angular velocity are NaN, and all if the velocity is unknown."""
    if covariance_start is None:
        return [math.nan] * 21
    covariance = np.full((6, 6), np.nan)
    covariance[3:, 3:] = R_map_drone.T @ covariance_start @ R_map_drone
    return upper_from_velocity_covariance(covariance)

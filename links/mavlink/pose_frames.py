"""A relative pose as the MAVLink messages that an autopilot takes.

ODOMETRY and VISION_POSITION_ESTIMATE tell where the drone is in the vehicle's *start* frame, which stands still in
the world though the vehicle drives: an EKF wants a frame that stands still. Its x axis is where the vehicle looked at
the start, not north: LOCAL_FRD. LANDING_TARGET tells where the vehicle is, in the drone's body frame.

    p_drone_vehicle = -R_vehicle_drone^T t_vehicle_drone

What is not known is NaN, never 0: a velocity of zero is believed, and the drone flies away.

quality: 100 for a pose that is known exactly, 1 at the limit (`gate.Limits`), by the worse of position and rotation;
0 would mean unknown. time_usec is the host's time (microseconds since 1970), the time that TIMESYNC tells, too.

Source: https://mavlink.io/en/messages/common.html#ODOMETRY, #VISION_POSITION_ESTIMATE, #LANDING_TARGET;
https://ardupilot.org/dev/docs/mavlink-nongps-position-estimation.html; ArduPilot AC_PrecLand_MAVLink::handle_msg.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from links.mavlink.frames import (
    rpy_from_R_odom_drone,
    turned_over,
    upper_from_pose_covariance,
    upper_from_velocity_covariance,
    wxyz_from_R_odom_drone,
)
from links.mavlink.gate import Limits, velocity_to_send, worst_sigmas
from links.mavlink.wire import SEQUENCE, dialect
from stages.messages import PoseEstimate, RelativePose

LOCAL_FRD, BODY_FRD = 20, 12  # MAV_FRAME: ArduPilot takes ODOMETRY in these two alone
VIO = 3  # MAV_ESTIMATOR_TYPE_VIO: PX4 takes it, and not LIDAR
VISION_OTHER = 3  # LANDING_TARGET_TYPE
NO_NUMBERS = [math.nan] * 3


def quality_percent(pose: PoseEstimate, limits: Limits) -> int:
    """1 (at the limit) to 100 (exact), linear in the worse of the two sigmas over their limits."""
    sigmas = worst_sigmas(pose)
    if sigmas is None:
        return 1
    worst = max(math.degrees(sigmas[0]) / limits.rotation_sigma_deg, sigmas[1] / limits.position_sigma_m)
    return max(1, min(100, round(100 * (1 - worst))))


def odometry(pose: RelativePose, reset_counter: int, limits: Limits) -> Any:
    """ODOMETRY of a pose that the gate let through."""
    estimate = _estimate(pose)
    R = estimate.R_map_drone
    velocity = velocity_to_send(estimate, limits)
    return dialect().MAVLink_odometry_message(
        pose.stamp_ns // 1000,
        LOCAL_FRD,
        BODY_FRD,
        *turned_over(estimate.xyz_map_m),
        wxyz_from_R_odom_drone(R),
        *(NO_NUMBERS if velocity is None else turned_over(R.T @ velocity)),
        *NO_NUMBERS,  # turn rates: the autopilot's gyros know better
        upper_from_pose_covariance(estimate.map_covariance, R),
        _velocity_upper(estimate.velocity_covariance if velocity is not None else None, R),
        reset_counter % SEQUENCE,
        VIO,
        quality_percent(estimate, limits),
    )


def vision_position_estimate(pose: RelativePose, reset_counter: int) -> Any:
    """VISION_POSITION_ESTIMATE of a pose that the gate let through; for ArduPilot alone, PX4 takes it for north."""
    estimate = _estimate(pose)
    R = estimate.R_map_drone
    return dialect().MAVLink_vision_position_estimate_message(
        pose.stamp_ns // 1000,
        *turned_over(estimate.xyz_map_m),
        *rpy_from_R_odom_drone(R),
        upper_from_pose_covariance(estimate.map_covariance, R),
        reset_counter % SEQUENCE,
    )


def landing_target(pose: RelativePose) -> Any:
    """LANDING_TARGET of a pose that the gate let through: the vehicle in the drone's body frame.

    The angles are those of the line of sight about the body's x and y from straight down, as ArduPilot reads them
    where the position is not valid: (-tan angle_y, tan angle_x, 1). NaN when the vehicle is not below the drone.
    """
    estimate = _estimate(pose)
    x, y, z = turned_over(-estimate.R_vehicle_drone.T @ estimate.xyz_vehicle_m).tolist()
    angles = (math.atan2(y, z), math.atan2(-x, z)) if z > 0 else (math.nan, math.nan)
    R_drone_vehicle = estimate.R_vehicle_drone.T
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


def _estimate(pose: RelativePose) -> PoseEstimate:
    """The estimate with its rotation. ValueError: there is none, so the gate must reject the pose."""
    if not isinstance(pose.estimate, PoseEstimate):
        raise ValueError("the pose has no rotation: the gate must reject it")
    return pose.estimate


def _velocity_upper(covariance_start: NDArray[np.float64] | None, R_map_drone: NDArray[np.float64]) -> list[float]:
    """21 numbers, drone axes; the turn rates' are NaN, and all where the velocity is not known."""
    if covariance_start is None:
        return [math.nan] * 21
    covariance = np.full((6, 6), np.nan)
    covariance[3:, 3:] = R_map_drone.T @ covariance_start @ R_map_drone
    return upper_from_velocity_covariance(covariance)

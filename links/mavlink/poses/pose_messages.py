"""MAVLink messages of a pose with rotation: ODOMETRY, VISION_POSITION_ESTIMATE and LANDING_TARGET.

ODOMETRY and VISION_POSITION_ESTIMATE contain the drone's pose with the origin of `map`, which is static while the
vehicle drives, as an EKF requires, in axes that point as the autopilot's own did when the first pose was sent:

    p_sent = Rz(axes_yaw)^T p_map,   R_sent_drone = Rz(axes_yaw)^T R_map_drone

axes_yaw is constant, so that its error turns the axes against north and adds no error to a pose in them. The axes stay
parallel to those of the autopilot's position and velocity unless its EKF resets its yaw, so a switch between its own
sources and grd turns its attitude by the error of its compass at most. The frame is LOCAL_FRD, not LOCAL_NED: the yaw
is not relative to the true north.
Positions without yaw: `position_messages.py`. LANDING_TARGET contains the vehicle's position in the drone's body frame.

    p_drone_vehicle = -R_vehicle_drone^T t_vehicle_drone

Unknown values are NaN, never 0: an EKF fuses a velocity of zero, and the drone drifts away. The velocity is never sent:
ArduPilot fuses it also when its position comes from another source (EK3_SRC_OPTIONS bit 0), in another frame.

quality: 100 for a sigma of 0, 1 at the limits (`PoseLimits`), by the worse of position and rotation; 0 would mean
unknown. time_usec is host time (microseconds since 1970), the same as in TIMESYNC replies.

Source: https://mavlink.io/en/messages/common.html#ODOMETRY, #VISION_POSITION_ESTIMATE, #LANDING_TARGET;
https://ardupilot.org/dev/docs/mavlink-nongps-position-estimation.html; ArduPilot AC_PrecLand_MAVLink::handle_msg.
"""

from __future__ import annotations

import math
from typing import Any

from links.mavlink.ned_frd import (
    flip_yz,
    rpy_from_R_odom_drone,
    upper_from_pose_covariance,
    wxyz_from_R_odom_drone,
)
from links.mavlink.poses.gate import PoseLimits, worst_sigmas
from links.mavlink.transport.framing import SEQUENCE, dialect
from stages.geometry.frames import Array64, rotation_z
from stages.messages import PoseEstimate, RelativePose

LOCAL_FRD, BODY_FRD = 20, 12  # MAV_FRAME: the only ones that ArduPilot accepts in ODOMETRY
VIO = 3  # MAV_ESTIMATOR_TYPE_VIO: accepted by PX4, unlike LIDAR
VISION_OTHER = 3  # LANDING_TARGET_TYPE
UNKNOWN, UNKNOWN_COVARIANCE = [math.nan] * 3, [math.nan] * 21


def quality_percent(pose: PoseEstimate, limits: PoseLimits) -> int:
    """Quality, 1 (at the limit) to 100 (sigma 0), linear in the larger of the two ratios of sigma to limit."""
    sigmas = worst_sigmas(pose)
    if sigmas is None:
        return 1
    worst = max(math.degrees(sigmas[0]) / limits.rotation_sigma_deg, sigmas[1] / limits.position_sigma_m)
    return max(1, min(100, round(100 * (1 - worst))))


def odometry(pose: RelativePose, axes_yaw_rad: float, reset_counter: int, limits: PoseLimits) -> Any:
    """ODOMETRY of a pose that the gate has accepted; `axes_yaw_rad`: yaw in `map` of the axes that it is sent in."""
    estimate = _estimate(pose)
    xyz_m, R = _in_axes(estimate, axes_yaw_rad)
    return dialect().MAVLink_odometry_message(
        pose.stamp_ns // 1000,
        LOCAL_FRD,
        BODY_FRD,
        *flip_yz(xyz_m),
        wxyz_from_R_odom_drone(R),
        *UNKNOWN,  # velocity
        *UNKNOWN,  # angular velocity: the autopilot's gyros are better
        upper_from_pose_covariance(estimate.map_covariance, R),
        UNKNOWN_COVARIANCE,
        reset_counter % SEQUENCE,
        VIO,
        quality_percent(estimate, limits),
    )


def vision_position_estimate(pose: RelativePose, axes_yaw_rad: float, reset_counter: int) -> Any:
    """VISION_POSITION_ESTIMATE of a pose that the gate has accepted; for ArduPilot only, PX4 assumes true north."""
    estimate = _estimate(pose)
    xyz_m, R = _in_axes(estimate, axes_yaw_rad)
    return dialect().MAVLink_vision_position_estimate_message(
        pose.stamp_ns // 1000,
        *flip_yz(xyz_m),
        *rpy_from_R_odom_drone(R),
        upper_from_pose_covariance(estimate.map_covariance, R),
        reset_counter % SEQUENCE,
    )


def landing_target(pose: RelativePose) -> Any:
    """LANDING_TARGET of a pose that the gate has accepted: the vehicle in the drone's body frame.

    The angles are those of the line of sight from straight down about the body's x and y axes, as ArduPilot reads them
    when the position is not valid: (-tan angle_y, tan angle_x, 1). NaN when the vehicle is not below the drone.
    """
    estimate = _estimate(pose)
    x, y, z = flip_yz(-estimate.R_vehicle_drone.T @ estimate.xyz_vehicle_m).tolist()
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


def _in_axes(estimate: PoseEstimate, axes_yaw_rad: float) -> tuple[Array64, Array64]:
    """Position (3,) and rotation (3, 3) of the drone in axes with this yaw in `map`."""
    R_axes_map = rotation_z(-axes_yaw_rad)
    return R_axes_map @ estimate.xyz_map_m, R_axes_map @ estimate.R_map_drone


def _estimate(pose: RelativePose) -> PoseEstimate:
    """The estimate with its rotation. Raises ValueError without one: the gate must reject such a pose."""
    if not isinstance(pose.estimate, PoseEstimate):
        raise ValueError("the pose has no rotation: the gate must reject it")
    return pose.estimate

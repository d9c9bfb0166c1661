"""MAVLink messages of a pose with rotation: ODOMETRY, VISION_POSITION_ESTIMATE and LANDING_TARGET.

ODOMETRY and VISION_POSITION_ESTIMATE contain the drone's pose in a frame that is static while the vehicle drives, as an
EKF requires, with the axes and the origin of the autopilot's own position when the first pose was sent (`SentFrame`).
Its yaw in `map` is constant, so that its error turns the axes against north and adds no error to a pose in them. The
axes stay parallel to those of the autopilot's position and velocity unless its EKF resets its yaw, so a switch between
its own sources and grd turns its attitude by the error of its compass at most.

ArduPilot   LOCAL_FRD, the only frame that it accepts
PX4         LOCAL_NED: in LOCAL_FRD it takes the yaw, but calls it unaligned for the rest of the flight, and turns a
            position that it fuses without yaw. It needs `measured` without GPS and compass, so that no other yaw is
            meant by north

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
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.profiles import ProfileName
from links.mavlink.transport.framing import SEQUENCE, dialect
from stages.messages import PoseEstimate, RelativePose

LOCAL_NED, LOCAL_FRD, BODY_FRD = 1, 20, 12  # MAV_FRAME
ODOMETRY_FRAME: dict[ProfileName, int] = {"ardupilot": LOCAL_FRD, "px4": LOCAL_NED}
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


def odometry(
    pose: RelativePose, frame: SentFrame, reset_counter: int, limits: PoseLimits, profile: ProfileName = "ardupilot"
) -> Any:
    """ODOMETRY of a pose that the gate has accepted."""
    estimate = _estimate(pose)
    R = frame.R_sent_map @ estimate.R_map_drone
    return dialect().MAVLink_odometry_message(
        pose.stamp_ns // 1000,
        ODOMETRY_FRAME[profile],
        BODY_FRD,
        *flip_yz(frame.position(estimate.xyz_map_m)),
        wxyz_from_R_odom_drone(R),
        *UNKNOWN,  # velocity
        *UNKNOWN,  # angular velocity: the autopilot's gyros are better
        upper_from_pose_covariance(estimate.map_covariance, R),
        UNKNOWN_COVARIANCE,
        reset_counter % SEQUENCE,
        VIO,
        quality_percent(estimate, limits),
    )


def vision_position_estimate(pose: RelativePose, frame: SentFrame, reset_counter: int) -> Any:
    """VISION_POSITION_ESTIMATE of a pose that the gate has accepted; for ArduPilot only."""
    estimate = _estimate(pose)
    R = frame.R_sent_map @ estimate.R_map_drone
    return dialect().MAVLink_vision_position_estimate_message(
        pose.stamp_ns // 1000,
        *flip_yz(frame.position(estimate.xyz_map_m)),
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


def _estimate(pose: RelativePose) -> PoseEstimate:
    """The estimate with its rotation. Raises ValueError without one: the gate must reject such a pose."""
    if not isinstance(pose.estimate, PoseEstimate):
        raise ValueError("the pose has no rotation: the gate must reject it")
    return pose.estimate

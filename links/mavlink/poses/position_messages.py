"""Positions without yaw as ODOMETRY and VISION_POSITION_ESTIMATE, in the autopilot's own north-aligned axes.

ArduPilot   frame LOCAL_FRD, the only one it accepts; the position is taken as it is. Rotation: its own attitude with a
            yaw variance of pi^2. The quaternion is checked for NaN nowhere, and if EK3_SRCn_YAW is 6 by mistake, its
            own yaw does the least harm
PX4         frame LOCAL_NED: with LOCAL_FRD it would rotate the position by the message's rotation. Rotation: NaN
both        velocity NaN, which they skip

Source: ArduPilot GCS_MAVLINK::handle_odometry, AP_VisualOdom_MAV::handle_pose_estimate, NavEKF3_core::writeExtNavData
(checks position and its error for NaN, not the rotation); PX4 MavlinkReceiver::handle_message_odometry,
Ekf::controlEvPosFusion (LOCAL_FRAME_NED, LOCAL_FRAME_FRD), Ekf::controlEvYawFusion.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from links.mavlink.ned_frd import R_odom_drone_from_rpy, flip_yz, upper_from_pose_covariance, wxyz_from_R_odom_drone
from links.mavlink.poses.autopilot_estimate import AutopilotAttitude
from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.pose_messages import BODY_FRD, LOCAL_FRD, LOCAL_NED, UNKNOWN, UNKNOWN_COVARIANCE, VIO
from links.mavlink.poses.position_gate import position_quality_percent, sent_position
from links.mavlink.poses.sent_frame import SentFrame
from links.mavlink.transport.framing import SEQUENCE, dialect
from stages.messages import RelativePose

TILT_RAD2 = math.radians(2.0) ** 2  # of the autopilot's own roll and pitch
NO_YAW_RAD2 = math.pi**2  # of a yaw that is not measured


def position_odometry(
    pose: RelativePose, frame: SentFrame, reset_counter: int, limits: PoseLimits, attitude: AutopilotAttitude | None
) -> Any:
    """ODOMETRY of a position that the gate has accepted. `attitude` None: for PX4."""
    position = sent_position(pose, frame)
    return dialect().MAVLink_odometry_message(
        pose.stamp_ns // 1000,
        LOCAL_NED if attitude is None else LOCAL_FRD,
        BODY_FRD,
        *flip_yz(position.xyz_m),
        [math.nan] * 4 if attitude is None else wxyz_from_R_odom_drone(R_odom_drone_from_rpy(*_angles(attitude))),
        *UNKNOWN,
        *UNKNOWN,
        _upper(position.covariance_m2, TILT_RAD2, NO_YAW_RAD2) if attitude else _upper(position.covariance_m2),
        UNKNOWN_COVARIANCE,
        reset_counter % SEQUENCE,
        VIO,
        position_quality_percent(pose, limits),
    )


def position_vision_estimate(
    pose: RelativePose, frame: SentFrame, reset_counter: int, attitude: AutopilotAttitude
) -> Any:
    """VISION_POSITION_ESTIMATE of an accepted position, for ArduPilot."""
    position = sent_position(pose, frame)
    return dialect().MAVLink_vision_position_estimate_message(
        pose.stamp_ns // 1000,
        *flip_yz(position.xyz_m),
        *_angles(attitude),
        _upper(position.covariance_m2, TILT_RAD2, NO_YAW_RAD2),
        reset_counter % SEQUENCE,
    )


def _angles(attitude: AutopilotAttitude) -> tuple[float, float, float]:
    return attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad


def _upper(position_m2: Any, tilt_rad2: float = math.nan, yaw_rad2: float = math.nan) -> list[float]:
    """MAVLink's 21 numbers; without variances of the angles these are NaN."""
    covariance = np.zeros((6, 6))
    covariance[3:, 3:] = position_m2
    upper = upper_from_pose_covariance(covariance, np.eye(3))
    for at, variance in ((15, tilt_rad2), (18, tilt_rad2), (20, yaw_rad2)):
        upper[at] = variance
    return upper

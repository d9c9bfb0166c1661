"""The autopilot's local frame `odom` in `map`, by a sent pose and the autopilot's own estimate at that time.

    yaw    of positions without yaw: RelativePose.odom_yaw_rad; of poses with yaw: difference of both yaws of the body
    origin p_map - Rz(yaw) p_odom

A restart of grd in flight learns from it where `map` is (`sent_state.py`). It is stored as an ODOMETRY frame of our own
ids, because a recording has to contain it.

Source: ours.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from links.mavlink.ned_frd import (
    R_odom_drone_from_rpy,
    flip_yz,
    upper_from_pose_covariance,
    wxyz_from_R_odom_drone,
)
from links.mavlink.poses.autopilot_estimate import MAX_ATTITUDE_AGE_NS, AutopilotEstimate
from links.mavlink.poses.pose_messages import BODY_FRD, LOCAL_FRD, UNKNOWN_COVARIANCE, VIO
from links.mavlink.readers import read_odometry
from links.mavlink.transport.framing import dialect
from stages.geometry.frames import heading_rad, rotation_z
from stages.heading.inertial_state import yaw_sigma_rad
from stages.messages import EarlierOdomFrame, PoseEstimate, RelativePose


def odom_yaw_rad(pose: RelativePose, autopilot: AutopilotEstimate) -> float | None:
    """Yaw of the autopilot's axes in `map`: as learnt, or the difference of both yaws of the body; None: not known."""
    attitude = autopilot.attitude
    if pose.odom_yaw_rad is not None:
        return pose.odom_yaw_rad
    if attitude is None or not isinstance(pose.estimate, PoseEstimate):
        return None
    if abs(pose.stamp_ns - attitude.arrival_ns) > MAX_ATTITUDE_AGE_NS:
        return None
    R_odom_drone = R_odom_drone_from_rpy(attitude.roll_rad, attitude.pitch_rad, attitude.yaw_rad)
    return heading_rad(pose.estimate.R_map_drone) - heading_rad(R_odom_drone)


def odom_frame(pose: RelativePose, autopilot: AutopilotEstimate, sender: tuple[int, int]) -> bytes | None:
    """Frame of `odom` in `map` at a pose that was sent; None: not known."""
    yaw_rad, sigma_rad = odom_yaw_rad(pose, autopilot), pose.odom_yaw_sigma_rad
    if pose.odom_yaw_rad is None and isinstance(pose.estimate, PoseEstimate):
        sigma_rad = yaw_sigma_rad(pose.estimate.R_map_drone, pose.estimate.map_covariance)
    xyz_odom_m = None if autopilot.position is None else autopilot.position.at(pose.stamp_ns)
    if yaw_rad is None or sigma_rad is None or xyz_odom_m is None or pose.xyz_map_m is None:
        return None
    R_map_odom = rotation_z(yaw_rad)
    message = dialect().MAVLink_odometry_message(
        pose.stamp_ns // 1000,
        LOCAL_FRD,
        BODY_FRD,
        *flip_yz(pose.xyz_map_m - R_map_odom @ xyz_odom_m),
        wxyz_from_R_odom_drone(R_map_odom),
        *[0.0] * 3,
        *[0.0] * 3,
        upper_from_pose_covariance(np.diag([0.0, 0.0, sigma_rad**2, 0.0, 0.0, 0.0]), R_map_odom),
        UNKNOWN_COVARIANCE,
        0,
        VIO,
    )
    return bytes(message.pack(dialect().MAVLink(None, *sender)))


def read_odom_frame(frame: Any, stamp_ns: int) -> EarlierOdomFrame:
    """The frame `odom` in `map` of a frame of `odom_frame`. Raises ValueError for another one."""
    read = read_odometry(frame, stamp_ns)
    if read.pose_covariance is None:
        raise ValueError("no covariance")
    return EarlierOdomFrame(
        stamp_ns=stamp_ns,
        yaw_map_odom_rad=heading_rad(read.R_odom_drone),
        sigma_rad=math.sqrt(float(read.pose_covariance[2, 2])),
        xyz_map_m=read.xyz_odom_m,
    )

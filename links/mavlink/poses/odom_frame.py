"""The autopilot's local frame `odom` in `map`, by a sent pose and the autopilot's own estimate at that time.

    yaw    of positions without yaw: RelativePose.odom_yaw_rad; of poses with yaw: difference of both yaws of the body
    origin p_map - Rz(yaw) p_odom

A restart of grd in flight learns from it where `map` is (`sent_state.py`). It is stored as an ODOMETRY frame of our own
ids, because a recording has to contain it.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from links.mavlink.ned_frd import (
    R_odom_drone_from_rpy,
    flip_yz,
    upper_from_pose_covariance,
    wxyz_from_R_odom_drone,
)
from links.mavlink.poses.pose_messages import BODY_FRD, LOCAL_FRD, UNKNOWN_COVARIANCE, VIO
from links.mavlink.poses.position_messages import OwnAttitude
from links.mavlink.readers import read_odometry
from links.mavlink.transport.framing import dialect
from stages.fuse.chain import yaw_sigma_rad
from stages.geometry.frames import Array64, heading_rad, rotation_z
from stages.messages import EarlierOdomFrame, PoseEstimate, RelativePose

OWN_AGE_NS = 300_000_000  # of its position against the pose; it is extrapolated by its velocity


@dataclass(frozen=True, slots=True)
class OwnPosition:
    """The autopilot's own position as it reported it, in grd's axes."""

    arrival_ns: int
    xyz_odom_m: Array64
    velocity_odom_mps: Array64

    @classmethod
    def of(cls, message: Any, arrival_ns: int) -> OwnPosition | None:
        """LOCAL_POSITION_NED; None: not finite."""
        values = np.array([message.x, message.y, message.z, message.vx, message.vy, message.vz])
        return cls(arrival_ns, flip_yz(values[:3]), flip_yz(values[3:])) if np.isfinite(values).all() else None

    def at(self, stamp_ns: int) -> Array64 | None:
        """Position at a time; None: too old."""
        since_ns = stamp_ns - self.arrival_ns
        return None if abs(since_ns) > OWN_AGE_NS else self.xyz_odom_m + 1e-9 * since_ns * self.velocity_odom_mps


def odom_yaw_rad(pose: RelativePose, own: OwnAttitude | None) -> float | None:
    """Yaw of the autopilot's axes in `map`; None: not known."""
    if pose.odom_yaw_rad is not None:
        return pose.odom_yaw_rad
    if own is None or not isinstance(pose.estimate, PoseEstimate):
        return None
    R_odom_drone = R_odom_drone_from_rpy(own.roll_rad, own.pitch_rad, own.yaw_rad)
    return heading_rad(pose.estimate.R_map_drone) - heading_rad(R_odom_drone)


def odom_frame(
    pose: RelativePose, own: OwnAttitude | None, position: OwnPosition | None, sender: tuple[int, int]
) -> bytes | None:
    """Frame of `odom` in `map` at a pose that was sent; None: not known."""
    yaw_rad, sigma_rad = odom_yaw_rad(pose, own), pose.odom_yaw_sigma_rad
    if pose.odom_yaw_rad is None and isinstance(pose.estimate, PoseEstimate):
        sigma_rad = yaw_sigma_rad(pose.estimate.R_map_drone, pose.estimate.map_covariance)
    xyz_odom_m = None if position is None else position.at(pose.stamp_ns)
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

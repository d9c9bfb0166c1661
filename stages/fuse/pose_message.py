"""The fused estimate as a message: in `vehicle` and in `map`, with the covariance of each.

The translation of a covariance is in drone axes where the rotation is known, else in the axes of its frame.

Source: ours; stages/messages/pose.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.fuse.map_frame import MapFrame
from stages.geometry.frames import Array64
from stages.heading.odometry_heading import OdomYaw
from stages.messages import PoseEstimate, PoseState, PositionEstimate, RelativePose


@dataclass(frozen=True)
class MapEstimate:
    """The drone in `map` at one moment."""

    stamp_ns: int
    R_map_drone: Array64 | None
    xyz_map_m: Array64
    covariance: Array64  # (6, 6); without a rotation only its position block is valid, map axes
    velocity_map_mps: Array64
    velocity_covariance: Array64


@dataclass(frozen=True)
class Status:
    """State of the estimate, as the message reports it."""

    state: PoseState
    reason: str
    measured_ns: int | None
    track_id: int
    resets: int
    nis: float
    rotation_ns: int | None = None
    odom_yaw: OdomYaw | None = None
    map_number: int = 0


def lost(stamp_ns: int, status: Status) -> RelativePose:
    """The message without an estimate."""
    return _message(stamp_ns, status, None, math.nan)


def pose(estimate: MapEstimate, status: Status, map_frame: MapFrame) -> RelativePose:
    """The message with the estimate in `map` and in `vehicle`, there with the uncertainty of the vehicle's motion."""
    vehicle, stamp_ns = map_frame.vehicle, estimate.stamp_ns
    R_map_vehicle, _ = vehicle.at(stamp_ns)
    xyz, velocity = vehicle.to_vehicle(stamp_ns, estimate.xyz_map_m, estimate.velocity_map_mps)
    R, covariance = estimate.R_map_drone, estimate.covariance
    if R is None:
        position_m2, _, _ = map_frame.vehicle_covariance_m2(stamp_ns, xyz)
        covariance_m2 = covariance[3:, 3:]
        position = PositionEstimate(
            xyz_vehicle_m=xyz,
            covariance_vehicle_m2=R_map_vehicle.T @ covariance_m2 @ R_map_vehicle + position_m2,
            velocity_vehicle_mps=velocity,
            xyz_map_m=estimate.xyz_map_m,
            covariance_map_m2=covariance_m2.copy(),
            velocity_map_mps=estimate.velocity_map_mps,
            velocity_covariance=estimate.velocity_covariance,
        )
        return _message(stamp_ns, status, position, status.nis)
    R_vehicle_drone = R_map_vehicle.T @ R
    whole = PoseEstimate(
        xyz_vehicle_m=xyz,
        R_vehicle_drone=R_vehicle_drone,
        covariance=covariance + _vehicle_covariance(map_frame, stamp_ns, xyz, R_vehicle_drone),
        velocity_vehicle_mps=velocity,
        xyz_map_m=estimate.xyz_map_m,
        R_map_drone=R,
        map_covariance=covariance,  # tangent at the drone: the same in both frames
        velocity_map_mps=estimate.velocity_map_mps,
        velocity_covariance=estimate.velocity_covariance,
    )
    return _message(stamp_ns, status, whole, status.nis)


def _message(
    stamp_ns: int, status: Status, estimate: PositionEstimate | PoseEstimate | None, nis: float
) -> RelativePose:
    yaw = status.odom_yaw
    return RelativePose(
        stamp_ns=stamp_ns,
        state=status.state,
        reason=status.reason,
        measured_ns=status.measured_ns,
        track_id=status.track_id,
        resets=status.resets,
        nis=nis,
        estimate=estimate,
        rotation_ns=status.rotation_ns if isinstance(estimate, PoseEstimate) else None,
        odom_yaw_rad=None if yaw is None else yaw.yaw_rad,
        odom_yaw_sigma_rad=None if yaw is None else yaw.sigma_rad,
        map_number=status.map_number,
    )


def _vehicle_covariance(map_frame: MapFrame, stamp_ns: int, xyz_vehicle_m: Array64, R: Array64) -> Array64:
    """(6, 6) uncertainty of the vehicle's motion since its newest message, tangent at the drone; R is R_vehicle_drone.

    Its shift moves the drone, its yaw turns the drone about the vertical and moves it along the lever arm.
    """
    position_m2, yaw_rad2, lever = map_frame.vehicle_covariance_m2(stamp_ns, xyz_vehicle_m)
    covariance = np.zeros((6, 6))
    by_yaw = np.concatenate([R[2], R.T @ lever])
    covariance[3:, 3:] = R.T @ (position_m2 - yaw_rad2 * np.outer(lever, lever)) @ R
    return covariance + yaw_rad2 * np.outer(by_yaw, by_yaw)

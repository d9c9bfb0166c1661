"""Relative poses for the tests of the autopilot link."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from stages.messages import PoseEstimate, PoseState, PositionEstimate, RelativePose

HOST0, MS = 1_748_773_230_000_000_000, 1_000_000


def good_pose(stamp_ns: int = HOST0, **changes: Any) -> RelativePose:
    """A pose that the gate accepts: drone level, 10 m above the vehicle, 1 m/s forward over ground; `changes` of any field."""
    estimate = PoseEstimate(
        xyz_vehicle_m=np.array([1.0, 2.0, 10.0]),
        R_vehicle_drone=np.eye(3),
        covariance=np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.01, 0.01]),
        velocity_vehicle_mps=np.array([0.0, 0.0, 0.0]),
        xyz_map_m=np.array([101.0, 2.0, 10.0]),
        R_map_drone=np.eye(3),
        map_covariance=np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.01, 0.01]),
        velocity_map_mps=np.array([1.0, 0.0, 0.0]),
        velocity_covariance=0.01 * np.eye(3),
    )
    names = {field.name for field in dataclasses.fields(estimate)} & changes.keys()
    pose = RelativePose(
        stamp_ns=stamp_ns,
        state=PoseState.FULL,
        reason="lidar and both cameras",
        measured_ns=stamp_ns,
        track_id=1,
        resets=0,
        nis=1.0,
        rotation_ns=stamp_ns,
        odom_yaw_rad=0.0,
        odom_yaw_sigma_rad=math.radians(1.0),
        estimate=dataclasses.replace(estimate, **{name: changes.pop(name) for name in names}),
    )
    return dataclasses.replace(pose, **changes)


def position_of(pose: RelativePose) -> PositionEstimate:
    """The estimate of a pose without its rotation."""
    estimate = pose.estimate
    assert isinstance(estimate, PoseEstimate)
    return PositionEstimate(
        xyz_vehicle_m=estimate.xyz_vehicle_m,
        covariance_vehicle_m2=estimate.covariance[3:, 3:],
        velocity_vehicle_mps=estimate.velocity_vehicle_mps,
        xyz_map_m=estimate.xyz_map_m,
        covariance_map_m2=estimate.map_covariance[3:, 3:],
        velocity_map_mps=estimate.velocity_map_mps,
        velocity_covariance=estimate.velocity_covariance,
    )

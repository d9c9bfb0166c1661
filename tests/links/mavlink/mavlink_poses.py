"""Relative poses for the tests of the autopilot link."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np

from stages.messages import PoseState, RelativePose

HOST0, MS = 1_748_773_230_000_000_000, 1_000_000


def good_pose(stamp_ns: int = HOST0, **changes: Any) -> RelativePose:
    """A pose that may go out: drone level, 10 m over the vehicle, 1 m/s forward over ground."""
    pose = RelativePose(
        stamp_ns=stamp_ns,
        state=PoseState.FULL,
        reason="lidar and both cameras",
        measured_ns=stamp_ns,
        track_id=1,
        xyz_vehicle_m=np.array([1.0, 2.0, 10.0]),
        R_vehicle_drone=np.eye(3),
        covariance=np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.01, 0.01]),
        velocity_vehicle_mps=np.array([0.0, 0.0, 0.0]),
        xyz_map_m=np.array([101.0, 2.0, 10.0]),
        R_map_drone=np.eye(3),
        map_covariance=np.diag([1e-4, 1e-4, 4e-4, 0.01, 0.01, 0.01]),
        velocity_map_mps=np.array([1.0, 0.0, 0.0]),
        velocity_covariance=0.01 * np.eye(3),
        resets=0,
        nis=1.0,
    )
    return dataclasses.replace(pose, **changes)

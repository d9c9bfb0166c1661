"""The message made of a pose in the start frame: in the vehicle's, with velocities and honest covariances.

A covariance's translation is in the drone's axes where the rotation is known, else in the frame's own; then its
rotation has infinite variance.

Source: ours; stages/messages/pose.py.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from stages.fuse.motions import Motions
from stages.geometry.frames import Array64
from stages.messages import PoseState, RelativePose


@dataclass(frozen=True)
class Known:
    """The drone in the start frame at one moment."""

    stamp_ns: int
    R_map_drone: Array64 | None
    xyz_map_m: Array64
    covariance: Array64  # (6, 6); without a rotation only its position block counts, start axes
    velocity_map_mps: Array64
    velocity_covariance: Array64


@dataclass(frozen=True)
class Verdict:
    """What is to be said with it."""

    state: PoseState
    reason: str
    measured_ns: int | None
    track_id: int
    resets: int
    nis: float


def lost(stamp_ns: int, verdict: Verdict) -> RelativePose:
    """Nothing is known."""
    return RelativePose(
        stamp_ns=stamp_ns,
        state=PoseState.LOST,
        reason=verdict.reason,
        measured_ns=verdict.measured_ns,
        track_id=verdict.track_id,
        xyz_vehicle_m=None,
        R_vehicle_drone=None,
        covariance=None,
        velocity_vehicle_mps=None,
        xyz_map_m=None,
        R_map_drone=None,
        map_covariance=None,
        velocity_map_mps=None,
        velocity_covariance=None,
        resets=verdict.resets,
        nis=math.nan,
    )


def pose(known: Known, verdict: Verdict, motions: Motions) -> RelativePose:
    """The pose, in both frames. Relative to the vehicle it is no better than the vehicle's own place is known."""
    vehicle = motions.vehicle
    R_map_vehicle, _ = vehicle.at(known.stamp_ns)
    xyz, velocity = vehicle.to_vehicle(known.stamp_ns, known.xyz_map_m, known.velocity_map_mps)
    R = known.R_map_drone
    if R is None:
        start = np.diag([math.inf] * 3 + [0.0] * 3)
        relative = start.copy()
        start[3:, 3:] = known.covariance[3:, 3:]
        relative[3:, 3:] = R_map_vehicle.T @ known.covariance[3:, 3:] @ R_map_vehicle
    else:
        start = relative = known.covariance  # tangent at the drone: the same seen from either frame
    relative = relative + _vehicle_ahead(motions, known.stamp_ns, xyz, None if R is None else R_map_vehicle.T @ R)
    return RelativePose(
        stamp_ns=known.stamp_ns,
        state=verdict.state,
        reason=verdict.reason,
        measured_ns=verdict.measured_ns,
        track_id=verdict.track_id,
        xyz_vehicle_m=xyz,
        R_vehicle_drone=None if R is None else R_map_vehicle.T @ R,
        covariance=relative,
        velocity_vehicle_mps=velocity,
        xyz_map_m=known.xyz_map_m,
        R_map_drone=R,
        map_covariance=start,
        velocity_map_mps=known.velocity_map_mps,
        velocity_covariance=known.velocity_covariance,
        resets=verdict.resets,
        nis=verdict.nis,
    )


def _vehicle_ahead(motions: Motions, stamp_ns: int, xyz_vehicle_m: Array64, R_vehicle_drone: Array64 | None) -> Array64:
    """(6, 6) what the vehicle may have moved since its newest word: a shift, and a yaw that turns place and drone."""
    place_m2, yaw_rad2, lever = motions.vehicle_ahead_m2(stamp_ns, xyz_vehicle_m)
    covariance = np.zeros((6, 6))
    if R_vehicle_drone is None:
        covariance[3:, 3:] = place_m2
        return covariance
    R = R_vehicle_drone
    turned = np.concatenate([R[2], R.T @ lever])
    covariance[3:, 3:] = R.T @ (place_m2 - yaw_rad2 * np.outer(lever, lever)) @ R
    return covariance + yaw_rad2 * np.outer(turned, turned)

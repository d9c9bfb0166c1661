"""The links that read `fix_sensor` (fixes, states of a track, and the host's clock) and `rotation_sensor`.

Source: ours.
"""

from __future__ import annotations

import json
from collections.abc import Iterator

import numpy as np

from flow.link import Record, Source, SourceSettings
from stages.kernels.geometry.so3 import nearest_rotation
from stages.messages import BranchState, DroneFix, RelativeRotation, Tick, TrackingState, TrackState

FIX_TOPIC, ROTATION_TOPIC = "/simulated/fixes", "/simulated/rotations"
FRAME_S = 0.1
RETURNS = 5


class SimulatedFixesSettings(SourceSettings):
    """Settings of `SimulatedFixes`."""

    topic: str = FIX_TOPIC


class SimulatedFixes(Source[SimulatedFixesSettings]):
    """Fixes of a simulated position sensor, in place of LiDAR, detection and track."""

    def decode(self, record: Record) -> Iterator[DroneFix | TrackState | Tick]:
        """One tick, or one fix with the state of its track; in a gap the track coasts."""
        content = json.loads(record.data)
        if "xyz_m" not in content:
            if "coasting" in content:
                yield TrackState(
                    stamp_ns=record.stamp_ns, state=TrackingState.COASTING, reason="no fix", hits=0, frame_s=FRAME_S
                )
            yield Tick(stamp_ns=record.arrival_ns)
            return
        xyz, velocity = np.array(content["xyz_m"]), np.array(content["velocity_mps"])
        bias = content["bias_sigma_m"] ** 2 * np.eye(3)
        covariance = content["sigma_m"] ** 2 * np.eye(3) + bias
        yield TrackState(
            stamp_ns=record.stamp_ns,
            state=TrackingState.TRACKING,
            reason="simulated fix",
            hits=RETURNS,
            frame_s=FRAME_S,
            xyz_vehicle_m=xyz,
            velocity_vehicle_mps=velocity,
            covariance_m2=covariance,
        )
        yield DroneFix(
            stamp_ns=record.stamp_ns,
            xyz_vehicle_m=xyz,
            covariance_m2=covariance,
            hits=RETURNS,
            velocity_vehicle_mps=velocity,
            bias_covariance_m2=bias,
        )
        yield Tick(stamp_ns=record.arrival_ns)


class SimulatedRotationsSettings(SourceSettings):
    """Settings of `SimulatedRotations`."""

    topic: str = ROTATION_TOPIC


class SimulatedRotations(Source[SimulatedRotationsSettings]):
    """Rotations of a simulated sensor, in place of cameras, vanishing points and align; their branch is not known."""

    def decode(self, record: Record) -> RelativeRotation:
        """One rotation."""
        content = json.loads(record.data)
        R, covariance = nearest_rotation(np.array(content["R"])), content["sigma_rad"] ** 2 * np.eye(3)
        open_branch, state = np.full(4, 0.25), BranchState.OPEN
        return RelativeRotation.one(record.stamp_ns, R, covariance, open_branch, state, 0, "simulated rotation")

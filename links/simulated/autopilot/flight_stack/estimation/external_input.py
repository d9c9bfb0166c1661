"""External poses as ArduPilot and PX4 take them from MAVLink: their checks, then the pose in frame odom for the EKF.

The checks, the noise floors and the clock correction are those of `ardupilot_rules` and `px4_rules`; instead of their
constant-velocity model the pose goes to the EKF, which gates it when its horizon reaches the time of the pose.

Source: as of those modules.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from links.simulated.autopilot.ardupilot_rules import ArduPilotRules
from links.simulated.autopilot.flight_stack.estimation.observations import External
from links.simulated.autopilot.px4_rules import Px4Rules
from links.simulated.autopilot.rules import ExternalPose, PoseResult

FLIP = np.array([1.0, -1.0, -1.0])  # NED or FRD to z up


@dataclass(slots=True)
class ArduPilotInput(ArduPilotRules):
    """AP_VisualOdom_MAV: `taken` holds the poses for EKF3 until they are fetched."""

    taken: list[External] = field(default_factory=list[External])

    def _fuse(self, pose: ExternalPose, now_ns: int) -> PoseResult:
        if not math.isfinite(pose.yaw_rad):
            return PoseResult.NOT_FINITE
        before, self._reset_counter = self._reset_counter, pose.reset_counter
        self._last_fused_ns = now_ns
        self.taken.append(in_odom(pose, before is not None and before != pose.reset_counter))
        return PoseResult.FUSED


@dataclass(slots=True)
class Px4Input(Px4Rules):
    """handle_message_odometry: `taken` holds the samples for EKF2 until they are fetched."""

    taken: list[External] = field(default_factory=list[External])

    def _fuse(self, pose: ExternalPose, now_ns: int) -> PoseResult:
        before, self._reset_counter = self._reset_counter, pose.reset_counter
        self._last_received_ns = now_ns
        if self.ekf2_ev_qmin > 0 and pose.quality < self.ekf2_ev_qmin:
            return PoseResult.LOW_QUALITY
        self.taken.append(in_odom(pose, before is not None and before != pose.reset_counter))
        return PoseResult.FUSED


def in_odom(pose: ExternalPose, reset: bool) -> External:
    """A pose in NED or FRD axes, with z up."""
    return External(
        time_ns=pose.time_ns,
        xyz_m=pose.xyz_m * FLIP,
        yaw_rad=-pose.yaw_rad,
        velocity_mps=None if pose.velocity_mps is None else pose.velocity_mps * FLIP,
        position_sigma_m=pose.position_sigma_m,
        yaw_sigma_rad=pose.yaw_sigma_rad,
        reset=reset,
    )

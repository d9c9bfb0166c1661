"""How PX4 uses an external pose: EKF2_EV_CTRL position and yaw, without GPS and compass.

A message has the time of its arrival: PX4's filter over TIMESYNC replies, which maps times, is not modelled.

Source: https://github.com/PX4/PX4-Autopilot, src/modules/mavlink/mavlink_receiver.cpp (handle_message_odometry),
src/modules/ekf2/EKF/aid_sources/external_vision (ev_control.cpp, ev_pos_control.cpp, ev_yaw_control.cpp), common.h.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from links.simulated.autopilot.rules import (
    LOCAL_FRD,
    LOCAL_NED,
    MS,
    US,
    ExternalPose,
    PoseResult,
    Rules,
    pose_of,
    variances_of,
    yaw_of,
)

mavlink: Any = ardupilotmega
OWN_POSITION = 256  # ESTIMATOR_PRED_POS_HORIZ_REL: the scripted telemetry is of another sensor


@dataclass(slots=True)
class Px4Rules(Rules):
    """PX4 with EKF2_EV_CTRL position and yaw, without GPS and compass. Parameters have their PX4 names."""

    ekf2_evp_noise: float = 0.1
    ekf2_eva_noise: float = 0.05  # of the variance, unsquared
    ekf2_ev_qmin: int = 0
    ekf2_ev_delay_ms: int = 0
    compass: bool = False  # EKF2_MAG_TYPE other than 5: a position in LOCAL_NED needs no rotation
    gate: float = 5.0  # EKF2_EVP_GATE
    interval_ms: int = 200  # EV_MAX_INTERVAL
    failing_s: float = 1.0  # no_aid_timeout_max
    resets_left: int = 5  # _nb_ev_pos_reset_available, in the air
    _fusing: bool = False
    _last_ns: int | None = None  # time of the newest sample
    _last_quality: int = 0

    def healthy(self, now_ns: int) -> bool:
        """The same as fusing."""
        return self.fusing(now_ns)

    def fusing(self, now_ns: int) -> bool:
        """Whether it has started and was not stopped by 400 ms without messages."""
        if self._last_received_ns is None or now_ns - self._last_received_ns > 2 * self.interval_ms * MS:
            self._fusing = False
        return self._fusing

    def report(self, now_ns: int) -> Any:
        """ESTIMATOR_STATUS."""
        position, yaw = self.ratios
        return mavlink.MAVLink_estimator_status_message(
            now_ns // US, self._flags(now_ns) | OWN_POSITION, 0.0, position, position, yaw, 0.0, 0.0, 0.1, 0.1
        )

    def _process(self, message: Any, now_ns: int) -> PoseResult:
        if message.get_type() != "ODOMETRY":
            return PoseResult.WRONG_FRAME  # taken as north-oriented, and without a compass its yaw is not aligned
        if message.estimator_type not in (0, 1, 2, 3):
            return PoseResult.WRONG_ESTIMATOR
        if message.frame_id not in (LOCAL_NED, LOCAL_FRD):
            return PoseResult.WRONG_FRAME
        xyz, R, velocity, upper = pose_of(message)
        position_var, angle_var = variances_of(upper)
        by_compass = self.compass and message.frame_id == LOCAL_NED
        if not (np.isfinite(xyz).all() and (by_compass or np.isfinite(R).all())):
            return PoseResult.NOT_FINITE
        pose = ExternalPose(
            now_ns - self.ekf2_ev_delay_ms * MS,
            xyz,
            yaw_of(R),
            velocity,
            _at_least(max(position_var), self.ekf2_evp_noise),
            _at_least(angle_var[2], math.sqrt(self.ekf2_eva_noise)),
            message.reset_counter,
            message.quality,
        )
        return self._fuse(pose, now_ns)

    def _fuse(self, pose: ExternalPose, now_ns: int) -> PoseResult:
        fusing = self.fusing(now_ns)
        gap_ns = None if self._last_ns is None else pose.time_ns - self._last_ns
        good = self.ekf2_ev_qmin <= 0 or min(pose.quality, self._last_quality) >= self.ekf2_ev_qmin
        self._last_quality = pose.quality
        previous_counter, self._reset_counter = self._reset_counter, pose.reset_counter
        self._last_received_ns = now_ns
        if self.ekf2_ev_qmin > 0 and pose.quality < self.ekf2_ev_qmin:
            return PoseResult.LOW_QUALITY
        self._last_ns = pose.time_ns
        if not fusing or self.estimate is None:
            if not good or gap_ns is None or gap_ns >= self.interval_ms * MS:
                return PoseResult.NOT_STARTED
            self._fusing, self.resets_left = True, 5
            return self._reset_to(pose, now_ns)
        if previous_counter != pose.reset_counter:
            return self._reset_to(pose, now_ns)
        self.ratios = self.estimate.ratios(pose, self.gate)
        if max(self.ratios) <= 1:
            self.estimate.fuse(pose)
            self._last_fused_ns = now_ns
            return PoseResult.FUSED
        if self._last_fused_ns is None or now_ns - self._last_fused_ns <= self.failing_s * 1e9:
            return PoseResult.GATED
        if self.resets_left == 0:
            self._fusing = False
            return PoseResult.GATED
        self.resets_left -= 1
        return self._reset_to(pose, now_ns)


def _at_least(variance: float, floor: float) -> float:
    """Sigma of a variance, at least the floor; the floor where the message has no variance."""
    return max(math.sqrt(variance), floor) if variance > 0 else floor

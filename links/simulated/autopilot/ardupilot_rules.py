"""How ArduPilot uses an external pose: VISO_TYPE 1, EKF3 with position and yaw from it.

Source: https://github.com/ArduPilot/ardupilot, libraries/AP_VisualOdom (AP_VisualOdom_MAV.cpp, _Backend.cpp),
GCS_MAVLink (GCS_MAVLINK::handle_odometry), AP_NavEKF3 (writeExtNavData; gates and retry times of AP_NavEKF3.h), AP_RTC
(JitterCorrection.cpp).
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from links.simulated.autopilot.rules import (
    BODY_FRD,
    LOCAL_FRD,
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


@dataclass(slots=True)
class JitterCorrection:
    """ArduPilot's map from the sender's clock to its own [us]: the message with the least lag has no delay."""

    max_lag_us: int = 500_000
    convergence_loops: int = 100
    _offset_us: int | None = None
    _least_us: int = 0
    _count: int = 0

    def local_us(self, sent_us: int, arrival_us: int) -> int:
        """The time of sending on the receiver's clock."""
        lag_us = arrival_us - sent_us
        if self._offset_us is None or lag_us < self._offset_us:
            self._offset_us = lag_us
        if lag_us - self._offset_us > self.max_lag_us:
            self._offset_us = lag_us - self.max_lag_us
        local_us = sent_us + self._offset_us
        self._least_us = lag_us if self._count == 0 else min(self._least_us, lag_us)
        self._count += 1
        if self._count == self.convergence_loops:
            self._offset_us, self._count = max(self._offset_us, self._least_us), 0
        return local_us


@dataclass(slots=True)
class ArduPilotRules(Rules):
    """ArduPilot with VISO_TYPE 1 and EKF3 with external position and yaw. Parameters have their ArduPilot names."""

    viso_pos_m_nse: float = 0.2
    viso_yaw_m_nse: float = 0.2
    viso_qual_min: int = 0
    viso_delay_ms: int = 10
    gate: float = 5.0  # EK3_POS_I_GATE 500
    interval_ms: int = 20  # extNavIntervalMin_ms
    health_ms: int = 300  # AP_VISUALODOM_TIMEOUT_MS
    retry_s: float = 7.0  # posRetryTimeNoVel_ms: after this time outside the gate it resets to the pose
    _jitter: JitterCorrection = field(default_factory=JitterCorrection)
    _last_ms: int | None = None

    def healthy(self, now_ns: int) -> bool:
        """AP_VisualOdom_Backend::healthy; messages that are not fused count too."""
        return self._last_received_ns is not None and now_ns - self._last_received_ns < self.health_ms * MS

    def fusing(self, now_ns: int) -> bool:
        """Whether it is not in constant position mode."""
        return self._last_fused_ns is not None and now_ns - self._last_fused_ns < self.retry_s * 1e9

    def report(self, now_ns: int) -> Any:
        """EKF_STATUS_REPORT."""
        position, yaw = self.ratios
        return mavlink.MAVLink_ekf_status_report_message(self._flags(now_ns), 0.0, position, position, yaw, 0.0, 0.0)

    def _process(self, message: Any, now_ns: int) -> PoseResult:
        odometry = message.get_type() == "ODOMETRY"
        if odometry and (message.frame_id != LOCAL_FRD or message.child_frame_id != BODY_FRD):
            return PoseResult.WRONG_FRAME  # returns early: does not count for health
        sent_us = message.time_usec if odometry else message.usec
        time_ms = self._jitter.local_us(sent_us, now_ns // US) // 1000
        xyz, R, velocity, upper = pose_of(message)
        self._last_received_ns = now_ns
        quality = message.quality if odometry else 0
        if quality < self.viso_qual_min:
            return PoseResult.LOW_QUALITY
        position_error, angle_error = (0.0, 0.0) if math.isnan(upper[0]) else map(_cube_root, variances_of(upper))
        if not np.isfinite(xyz).all() or math.isnan(position_error):
            return PoseResult.NOT_FINITE
        if self._last_ms is not None and time_ms - self._last_ms < self.interval_ms:
            return PoseResult.TOO_SOON
        self._last_ms = time_ms
        pose = ExternalPose(
            time_ms * MS - self.viso_delay_ms * MS,
            xyz,
            yaw_of(R),
            velocity,
            min(max(position_error, self.viso_pos_m_nse), 100.0),
            max(min(max(angle_error, self.viso_yaw_m_nse), 1.5), math.radians(5.0)),
            message.reset_counter,
            quality,
        )
        return self._fuse(pose, now_ns)

    def _fuse(self, pose: ExternalPose, now_ns: int) -> PoseResult:
        previous_counter, self._reset_counter = self._reset_counter, pose.reset_counter
        if self.estimate is None or previous_counter != pose.reset_counter or not math.isfinite(pose.yaw_rad):
            return self._reset_to(pose, now_ns) if math.isfinite(pose.yaw_rad) else PoseResult.NOT_FINITE
        self.ratios = self.estimate.ratios(pose, self.gate)
        if max(self.ratios) > 1:
            return PoseResult.GATED if self.fusing(now_ns) else self._reset_to(pose, now_ns)
        self.estimate.fuse(pose)
        self._last_fused_ns = now_ns
        return PoseResult.FUSED


def _cube_root(variances: list[float]) -> float:
    """Error that handle_odometry computes from three variances: cbrt(a^2 + b^2 + c^2)."""
    return math.cbrt(sum(v * v for v in variances))

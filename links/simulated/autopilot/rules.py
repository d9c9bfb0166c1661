"""How an autopilot uses an external pose: what the rules of ArduPilot and PX4 have in common.

`ardupilot_rules.py` and `px4_rules.py` follow their sources: frames, NaNs, gaps, gates, resets, health. They are not
filters: position and yaw are predicted at constant velocity with a variance that grows by `DRIFT_MPS` and
`DRIFT_RADPS`, which is enough for the gates. Airframe, IMU and barometer are not modelled.

Source: ours; fields of the messages: https://mavlink.io/en/messages/common.html#ODOMETRY.
"""

from __future__ import annotations

import enum
import math
from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from stages.geometry.frames import Array64, rotation_from_quaternion_xyzw, rotation_from_rpy_deg

mavlink: Any = ardupilotmega

DRIFT_MPS, DRIFT_RADPS = 1.0, 0.02  # one sigma of the prediction per second
LOCAL_NED, LOCAL_FRD, BODY_FRD = 1, 20, 12
MS, US = 1_000_000, 1_000


class PoseResult(enum.Enum):
    """What the autopilot did with a message."""

    FUSED = "fused"
    RESET = "state reset to it"
    GATED = "outside the gate"
    WRONG_FRAME = "frames not supported"
    WRONG_ESTIMATOR = "estimator type not supported"
    NOT_FINITE = "not finite"
    TOO_SOON = "too soon after the previous one"
    LOW_QUALITY = "quality too low"
    NOT_STARTED = "waits for messages without gaps"
    NOT_A_POSE = "not a pose"


@dataclass(slots=True)
class ExternalPose:
    """An external pose as the autopilot reads it: local axes (north or forward, right, down)."""

    time_ns: int  # on the autopilot's clock
    xyz_m: Array64
    yaw_rad: float
    velocity_mps: Array64 | None
    position_sigma_m: float
    yaw_sigma_rad: float
    reset_counter: int
    quality: int


@dataclass(slots=True)
class PoseEstimate:
    """Position and yaw, predicted with constant velocity."""

    time_ns: int
    xyz_m: Array64
    velocity_mps: Array64
    yaw_rad: float
    position_var: float
    yaw_var: float

    def ratios(self, pose: ExternalPose, gate: float) -> tuple[float, float]:
        """Predict to the pose; innovation over gate of position and yaw, 1 at the gate."""
        dt_s = max((pose.time_ns - self.time_ns) * 1e-9, 0.0)
        self.time_ns = max(self.time_ns, pose.time_ns)
        self.xyz_m = self.xyz_m + dt_s * self.velocity_mps
        self.position_var += (DRIFT_MPS * dt_s) ** 2
        self.yaw_var += (DRIFT_RADPS * dt_s) ** 2
        position = float(np.abs(pose.xyz_m - self.xyz_m).max())
        yaw_innovation = abs(math.remainder(pose.yaw_rad - self.yaw_rad, math.tau))
        return (
            position / (gate * math.sqrt(self.position_var + pose.position_sigma_m**2)),
            yaw_innovation / (gate * math.sqrt(self.yaw_var + pose.yaw_sigma_rad**2)),
        )

    def fuse(self, pose: ExternalPose) -> None:
        """Kalman update, each axis on its own."""
        gain = self.position_var / (self.position_var + pose.position_sigma_m**2)
        yaw_gain = self.yaw_var / (self.yaw_var + pose.yaw_sigma_rad**2)
        self.xyz_m = self.xyz_m + gain * (pose.xyz_m - self.xyz_m)
        self.yaw_rad += yaw_gain * math.remainder(pose.yaw_rad - self.yaw_rad, math.tau)
        self.position_var *= 1 - gain
        self.yaw_var *= 1 - yaw_gain
        if pose.velocity_mps is not None:
            self.velocity_mps = pose.velocity_mps


def initial_estimate(pose: ExternalPose) -> PoseEstimate:
    """The estimate after a reset to a pose."""
    velocity = np.zeros(3) if pose.velocity_mps is None else pose.velocity_mps
    variances = pose.position_sigma_m**2, pose.yaw_sigma_rad**2
    return PoseEstimate(pose.time_ns, pose.xyz_m, velocity, pose.yaw_rad, *variances)


def pose_of(message: Any) -> tuple[Array64, Array64, Array64 | None, Any]:
    """(position, R_local_body, velocity in local axes or None, 21 covariances) of a message."""
    xyz = np.array([message.x, message.y, message.z], dtype=np.float64)
    if message.get_type() == "ODOMETRY":
        w, x, y, z = message.q
        length = math.hypot(w, x, y, z)
        finite = math.isfinite(length) and length > 0
        R = rotation_from_quaternion_xyzw((x, y, z, w)) if finite else np.full((3, 3), np.nan)
        velocity = R @ np.array([message.vx, message.vy, message.vz])
        return xyz, R, velocity if np.isfinite(velocity).all() else None, message.pose_covariance
    degrees = [math.degrees(a) for a in (message.roll, message.pitch, message.yaw)]
    R = rotation_from_rpy_deg((degrees[0], degrees[1], degrees[2]))
    return xyz, R, None, message.covariance


def yaw_of(R: Array64) -> float:
    return math.atan2(R[1, 0], R[0, 0])


def variances_of(upper: Any) -> tuple[list[float], list[float]]:
    """Variances of position (3) and angles (3) among the 21 values of MAVLink."""
    return [upper[i] for i in (0, 6, 11)], [upper[i] for i in (15, 18, 20)]


@dataclass(slots=True)
class Rules:
    """State that both kinds share: counts of results, the estimate, and times of messages."""

    results: Counter[PoseResult] = field(default_factory=Counter[PoseResult])
    estimate: PoseEstimate | None = None
    ratios: tuple[float, float] = (0.0, 0.0)  # of the newest pose
    _last_received_ns: int | None = None  # of a message that counts for health
    _last_fused_ns: int | None = None
    _reset_counter: int | None = None

    def receive(self, message: Any, now_ns: int) -> PoseResult:
        """Process a message that arrives now, on the autopilot's clock."""
        pose = message.get_type() in ("ODOMETRY", "VISION_POSITION_ESTIMATE")
        fate = self._process(message, now_ns) if pose else PoseResult.NOT_A_POSE
        self.results[fate] += 1
        return fate

    def healthy(self, now_ns: int) -> bool:
        """Whether it reports that external poses arrive."""
        raise NotImplementedError

    def fusing(self, now_ns: int) -> bool:
        """Whether its position depends on external poses."""
        raise NotImplementedError

    def report(self, now_ns: int) -> Any:
        """The message that reports its estimator."""
        raise NotImplementedError

    def _process(self, message: Any, now_ns: int) -> PoseResult:
        raise NotImplementedError

    def _flags(self, now_ns: int) -> int:
        """EKF_STATUS_FLAGS: attitude; then velocities, relative position and height, or constant position."""
        return 1 | (2 | 4 | 8 | 32 | 256 if self.fusing(now_ns) else 128 | 32)

    def _reset_to(self, pose: ExternalPose, now_ns: int) -> PoseResult:
        self.estimate, self._last_fused_ns = initial_estimate(pose), now_ns
        return PoseResult.RESET

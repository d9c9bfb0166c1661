"""The autopilot's own estimate as the output uses it: newest attitude and position, resets of its yaw, and its boots.

Positions without yaw are in the autopilot's axes as they were when the telemetry was independent. If its EKF resets its
yaw later (compass anomaly, GSF), those axes are no longer known. A change of yaw that the reported rates do not explain
is such a reset. Across a gap of the messages it cannot be detected.

The thresholds are those of a real flight without a reset: over 1998 intervals of 0.34 s of dronekit-python
(copter_flight_part1.tlog, ATTITUDE) the rates explain the yaw to 5.7 deg plus 0.3 of the turn.

Boots: time since boot that runs backwards, in any message that has it. Frames that arrive late run back by less.

Without aiding ArduPilot sends no position. PX4 sends one all the same, dead-reckoned or held; its ESTIMATOR_STATUS then
lacks ESTIMATOR_PRED_POS_HORIZ_REL (256).

Source: ours; https://mavlink.io/en/messages/common.html#ATTITUDE; PX4 mavlink/streams/LOCAL_POSITION_NED.hpp and
ODOMETRY.hpp, Ekf::get_ekf_soln_status (pred_pos_horiz_rel: isHorizontalAidingActive).
"""

from __future__ import annotations

import enum
import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from links.mavlink.ned_frd import flip_yz
from links.mavlink.readers import PREDICTED_RELATIVE
from stages.geometry.frames import Array64

MIN_YAW_RESET_RAD, UNEXPLAINED_SHARE = math.radians(8.0), 0.3  # unexplained change of yaw, and share of the turn
MAX_ATTITUDE_GAP_MS = 1000  # the rates do not explain the yaw over a longer gap
MIN_BOOT_STEP_MS = 1000  # time since boot that runs backwards by more is another boot; by less, a late frame
STEEP_RAD = math.radians(60.0)  # pitch or roll beyond which yaw is not evaluated
MAX_ATTITUDE_AGE_NS = 1_000_000_000  # of its attitude against a pose
MAX_POSITION_AGE_NS = 300_000_000  # of its position against a pose; it is extrapolated by its velocity


def position_is_aided(message: Any) -> bool | None:
    """What a status of PX4's EKF says of the position that it sends; None: another message."""
    return bool(message.flags & PREDICTED_RELATIVE) if message.get_type() == "ESTIMATOR_STATUS" else None


@dataclass(frozen=True, slots=True)
class AutopilotAttitude:
    """The autopilot's attitude as it reported it: NED, FRD."""

    roll_rad: float
    pitch_rad: float
    yaw_rad: float
    arrival_ns: int


@dataclass(frozen=True, slots=True)
class AutopilotPosition:
    """The autopilot's own position as it reported it, in grd's axes."""

    arrival_ns: int
    xyz_odom_m: Array64
    velocity_odom_mps: Array64

    def at(self, stamp_ns: int, max_age_ns: int = MAX_POSITION_AGE_NS) -> Array64 | None:
        """Position (3,) at a time; None: too old."""
        since_ns = stamp_ns - self.arrival_ns
        return None if abs(since_ns) > max_age_ns else self.xyz_odom_m + 1e-9 * since_ns * self.velocity_odom_mps


class EstimateEvent(enum.Enum):
    """What a message shows in addition to the estimate."""

    BOOTED = enum.auto()
    YAW_RESET = enum.auto()


class AutopilotEstimate:
    """Evaluates the autopilot's messages in order."""

    def __init__(self) -> None:
        self.attitude: AutopilotAttitude | None = None
        self.position: AutopilotPosition | None = None
        self._newest_ms: dict[str, int] = {}  # time since boot: of any message, and of replies to TIMESYNC
        self._attitude_ms = 0  # the same of the attitude
        self._yaw_rate = 0.0
        self._aided = True

    def add(self, message: Any, arrival_ns: int) -> EstimateEvent | None:
        """Add a message; a late one, and values that are not finite, are ignored."""
        aided = position_is_aided(message)
        self._aided = self._aided if aided is None else aided
        boot_ms = getattr(message, "time_boot_ms", None)
        if boot_ms is None:
            return None
        event = self._on_time("messages", boot_ms)
        kind, yaw_reset = message.get_type(), False
        if kind == "ATTITUDE":
            yaw_reset = self._add_attitude(message, arrival_ns)
        elif kind == "LOCAL_POSITION_NED" and self._aided:
            values = np.array([message.x, message.y, message.z, message.vx, message.vy, message.vz])
            if np.isfinite(values).all():
                self.position = AutopilotPosition(arrival_ns, flip_yz(values[:3]), flip_yz(values[3:]))
        return event or (EstimateEvent.YAW_RESET if yaw_reset else None)

    def on_timesync(self, device_ms: int) -> EstimateEvent | None:
        """Add the autopilot's time of a reply to TIMESYNC: for seconds after a boot nothing else may have a time."""
        return self._on_time("TIMESYNC", device_ms)

    def _on_time(self, source: str, device_ms: int) -> EstimateEvent | None:
        newest_ms = self._newest_ms.get(source, device_ms)
        self._newest_ms[source] = max(device_ms, newest_ms)
        if device_ms >= newest_ms - MIN_BOOT_STEP_MS:
            return None
        self._newest_ms = {source: device_ms}
        self.attitude = self.position = None
        return EstimateEvent.BOOTED

    def _add_attitude(self, message: Any, arrival_ns: int) -> bool:
        """Whether the yaw was reset since the attitude before."""
        values = (message.roll, message.pitch, message.yaw, message.pitchspeed, message.yawspeed)
        if not all(map(math.isfinite, values)):
            return False
        last, elapsed_ms = self.attitude, message.time_boot_ms - self._attitude_ms
        if last is not None and elapsed_ms <= 0:
            return False
        rate = _yaw_rate(*values[:2], *values[3:])
        turn = 0.5e-3 * elapsed_ms * (rate + self._yaw_rate)
        self.attitude = AutopilotAttitude(message.roll, message.pitch, message.yaw, arrival_ns)
        self._attitude_ms, self._yaw_rate = message.time_boot_ms, rate
        if last is None or elapsed_ms > MAX_ATTITUDE_GAP_MS:
            return False
        steep = max(abs(message.roll), abs(message.pitch), abs(last.roll_rad), abs(last.pitch_rad)) > STEEP_RAD
        unexplained = abs(math.remainder(message.yaw - last.yaw_rad - turn, math.tau))
        return not steep and unexplained > MIN_YAW_RESET_RAD + UNEXPLAINED_SHARE * abs(turn)


def _yaw_rate(roll: float, pitch: float, pitch_rate: float, yaw_rate: float) -> float:
    """Rate of the Euler angle yaw [rad/s] of body rates."""
    return (pitch_rate * math.sin(roll) + yaw_rate * math.cos(roll)) / max(math.cos(pitch), 0.1)

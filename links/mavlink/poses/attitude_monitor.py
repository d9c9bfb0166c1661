"""The autopilot's ATTITUDE as the output uses it: its newest value, resets of its yaw, and its reboots.

Positions without yaw are in the autopilot's axes as they were when the telemetry was independent. If its EKF resets its
yaw later (compass anomaly, GSF), those axes are no longer known. A change of yaw that the reported rates do not explain
is such a reset. Across a gap of the messages it cannot be detected.

Source: ours; https://mavlink.io/en/messages/common.html#ATTITUDE.
"""

from __future__ import annotations

import enum
import math
from typing import Any

from links.mavlink.poses.position_messages import OwnAttitude

JUMP_RAD, JUMP_SHARE = math.radians(8.0), 0.3  # unexplained change of yaw, and share of the turn
GAP_MS = 1000  # the rates do not explain the yaw over a longer gap
BOOT_MS = 1000  # time since boot that runs backwards by more is another boot; by less, a late frame
STEEP_RAD = math.radians(60.0)  # pitch or roll beyond which yaw is not evaluated


class AttitudeEvent(enum.Enum):
    """Event that an ATTITUDE shows in addition to the attitude."""

    BOOTED = enum.auto()
    YAW_RESET = enum.auto()


class AttitudeMonitor:
    """Evaluates ATTITUDE messages in order."""

    def __init__(self) -> None:
        self.newest: OwnAttitude | None = None
        self._boot_ms = 0
        self._yaw_rate = 0.0

    def add(self, message: Any, arrival_ns: int) -> AttitudeEvent | None:
        """Add an ATTITUDE; a late one and one that is not finite are ignored."""
        values = (message.roll, message.pitch, message.yaw, message.pitchspeed, message.yawspeed)
        if not all(map(math.isfinite, values)):
            return None
        last, elapsed_ms = self.newest, message.time_boot_ms - self._boot_ms
        if last is not None and -BOOT_MS <= elapsed_ms <= 0:
            return None
        rate = _yaw_rate(*values[:2], *values[3:])
        turn = 0.5e-3 * elapsed_ms * (rate + self._yaw_rate)
        self.newest = OwnAttitude(message.roll, message.pitch, message.yaw, arrival_ns)
        self._boot_ms, self._yaw_rate = message.time_boot_ms, rate
        if last is None:
            return None
        if elapsed_ms < 0:
            return AttitudeEvent.BOOTED
        steep = max(abs(message.roll), abs(message.pitch), abs(last.roll_rad), abs(last.pitch_rad)) > STEEP_RAD
        unexplained = abs(math.remainder(message.yaw - last.yaw_rad - turn, math.tau))
        jumped = unexplained > JUMP_RAD + JUMP_SHARE * abs(turn)
        return AttitudeEvent.YAW_RESET if jumped and not steep and elapsed_ms <= GAP_MS else None


def _yaw_rate(roll: float, pitch: float, pitch_rate: float, yaw_rate: float) -> float:
    """Rate of the Euler angle yaw [rad/s] of body rates."""
    return (pitch_rate * math.sin(roll) + yaw_rate * math.cos(roll)) / max(math.cos(pitch), 0.1)

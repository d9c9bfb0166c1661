"""What each kind of autopilot needs set, and why: the tables that preflight checks and people read.

Both kinds: the pose's local frame is the vehicle's start frame, with x where the vehicle looked and not north, so the
autopilot's yaw must come from us alone; with its compass it would turn our positions by the street's heading.

ArduPilot (4.3 and later; EKF3)
- ODOMETRY only in LOCAL_FRD / BODY_FRD, at 4 Hz or more; healthy for 300 ms after each; at most one each 20 ms is
  fused (two nearer than that: the second is dropped). 25 to 50 Hz is right.
- It reads the covariance as cbrt(a^2 + b^2 + c^2) of the three variances, not as a sigma (0.1 m each gives 0.067 m,
  0.5 m gives 0.57 m), and never below VISO_POS_M_NSE and VISO_YAW_M_NSE; velocity always has VISO_VEL_M_NSE.
- time_usec is mapped by the promptest message (JitterCorrection): a constant delay is invisible to it; ours is the
  line's alone, since poses are predicted to the time they are sent.
- A change of reset_counter moves its position to ours at once.
- It accepts quality -1 and 0 for its health: a bad pose must not be sent at all.

PX4 (1.14 and later; EKF2)
- starts when two messages are less than 200 ms apart, stops after 400 ms without; 30 to 50 Hz is right.
- VISION_POSITION_ESTIMATE is read as north-oriented, LANDING_TARGET only in its local NED: neither is ours to say.
- time_usec is mapped by its own TIMESYNC requests, which are answered; until they have converged (500 of them) it
  takes the time of arrival.
- estimator_type must be VIO or VISION: a LIDAR's is refused.

Source: ArduPilot libraries/AP_VisualOdom/*.cpp, GCS_MAVLINK::handle_odometry, NavEKF3_core::writeExtNavData,
https://ardupilot.org/dev/docs/mavlink-nongps-position-estimation.html; PX4 mavlink_receiver.cpp
(handle_message_odometry, _vision_position_estimate, _landing_target), EKF2 aid_sources/external_vision/*.cpp,
https://docs.px4.io/main/en/ros/external_position_estimation.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

ProfileName = Literal["ardupilot", "px4"]
WIRE_ERROR = 1e-6


@dataclass(frozen=True, slots=True)
class Wanted:
    """One parameter: the values that are right, best first, or a range; and why."""

    name: str
    values: tuple[float, ...] = ()
    at_least: float = -math.inf
    at_most: float = math.inf
    bits: int = 0  # all of these must be set
    why: str = ""

    def fits(self, value: float) -> bool:
        """Whether a value is right, as far as the wire's 32 bits tell."""
        if not math.isfinite(value):
            return False
        if self.values and not any(abs(value - v) <= WIRE_ERROR * max(1.0, abs(v)) for v in self.values):
            return False
        within = self.at_least - WIRE_ERROR <= value <= self.at_most + WIRE_ERROR
        return within and round(value) & self.bits == self.bits

    def __str__(self) -> str:
        if self.values:
            return " or ".join(f"{v:g}" for v in self.values)
        if self.bits:
            return f"with bits {self.bits}"
        return f"{self.at_least:g} to {self.at_most:g}"


@dataclass(frozen=True, slots=True)
class Profile:
    """One kind of autopilot."""

    name: ProfileName
    wanted: tuple[Wanted, ...]
    refuses: Mapping[str, str] = field(default_factory=dict[str, str])  # message -> why it is not sent
    integers_bytewise: bool = False  # PARAM_VALUE holds an integer's bytes, not its value


_ZERO_OFFSET = "what is sent is the pose of the drone's body, not of a camera on it"

ARDUPILOT = Profile(
    name="ardupilot",
    wanted=(
        Wanted("AHRS_EKF_TYPE", (3.0,), why="EKF3 is what takes an external pose"),
        Wanted("EK3_ENABLE", (1.0,), why="EKF3 must run"),
        Wanted("VISO_TYPE", (1.0,), why="MAVLink; 3 (VOXL) would hide our resets behind an offset of its own"),
        Wanted("EK3_SRC1_POSXY", (6.0,), why="horizontal position from us"),
        Wanted("EK3_SRC1_VELXY", (6.0, 0.0), why="velocity from us where it is known, or none; not GPS"),
        Wanted("EK3_SRC1_POSZ", (6.0, 1.0), why="height from us, or the barometer"),
        Wanted("EK3_SRC1_VELZ", (6.0, 0.0), why="climb rate from us where it is known, or none"),
        Wanted("EK3_SRC1_YAW", (6.0,), why="yaw from us: our frame does not look north, a compass would turn it"),
        Wanted("VISO_POS_X", (0.0,), why=_ZERO_OFFSET),
        Wanted("VISO_POS_Y", (0.0,), why=_ZERO_OFFSET),
        Wanted("VISO_POS_Z", (0.0,), why=_ZERO_OFFSET),
        Wanted("VISO_ORIENT", (0.0,), why=_ZERO_OFFSET),
        Wanted("VISO_SCALE", (1.0,), why="metres are metres"),
        Wanted("VISO_DELAY_MS", at_least=0.0, at_most=50.0, why="the line's delay alone: poses are predicted to now"),
        Wanted("VISO_POS_M_NSE", at_least=0.05, at_most=0.5, why="floor of the position's sigma; ours is 0.1 to 0.3 m"),
        Wanted("VISO_YAW_M_NSE", at_least=0.05, at_most=0.3, why="floor of the yaw's sigma"),
        Wanted("VISO_VEL_M_NSE", at_least=0.1, at_most=1.0, why="sigma of every velocity: it does not read ours"),
        Wanted("VISO_QUAL_MIN", at_least=0.0, at_most=50.0, why="-1 would take failed poses too"),
    ),
)

_NOT_NORTH = "PX4 reads it as north-oriented, and our frame is not; send odometry"
PX4 = Profile(
    name="px4",
    wanted=(
        Wanted("EKF2_EV_CTRL", bits=1 | 8, why="1: horizontal position, 8: yaw; 2 (height) and 4 (velocity) as wished"),
        Wanted("EKF2_HGT_REF", (3.0, 0.0), why="height from us, or the barometer"),
        Wanted("EKF2_GPS_CTRL", (0.0,), why="with GPS it refuses the yaw of a frame that does not look north"),
        Wanted("EKF2_MAG_TYPE", (5.0,), why="no compass: the yaw is ours"),
        Wanted("EKF2_EV_NOISE_MD", (0.0,), why="use the covariance that is sent"),
        Wanted("EKF2_EV_DELAY", at_least=0.0, at_most=50.0, why="the line's delay alone: poses are predicted to now"),
        Wanted("EKF2_EVP_NOISE", at_least=0.01, at_most=0.3, why="floor of the position's sigma"),
        Wanted("EKF2_EVA_NOISE", at_least=0.01, at_most=0.2, why="floor of the angles' sigma"),
        Wanted("EKF2_EVV_NOISE", at_least=0.05, at_most=0.5, why="floor of the velocity's sigma"),
        Wanted("EKF2_EV_QMIN", at_least=0.0, at_most=50.0, why="1 at our limits, 100 at best"),
        Wanted("EKF2_EV_POS_X", (0.0,), why=_ZERO_OFFSET),
        Wanted("EKF2_EV_POS_Y", (0.0,), why=_ZERO_OFFSET),
        Wanted("EKF2_EV_POS_Z", (0.0,), why=_ZERO_OFFSET),
    ),
    refuses={
        "vision_position_estimate": _NOT_NORTH,
        "landing_target": "PX4 takes it in its local NED frame alone, which may not be ours",
    },
    integers_bytewise=True,
)

PROFILES: dict[ProfileName, Profile] = {"ardupilot": ARDUPILOT, "px4": PX4}


def findings(profile: Profile, values: Mapping[str, float]) -> list[str]:
    """What is wrong or missing, one sentence each; empty: all is as it must be."""
    found: list[str] = []
    for wanted in profile.wanted:
        value = values.get(wanted.name)
        if value is None:
            found.append(f"{wanted.name} did not answer; it must be {wanted} ({wanted.why})")
        elif not wanted.fits(value):
            found.append(f"{wanted.name} is {value:g}, and must be {wanted} ({wanted.why})")
    return found

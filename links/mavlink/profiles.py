"""Parameters that each autopilot needs, and why. Preflight checks them.

Both autopilots: the local frame of the poses is the vehicle's start frame, with x in the vehicle's forward direction
and not north. Therefore the autopilot's yaw must come from grd alone; with the compass it would rotate the positions by
the vehicle's initial heading.

ArduPilot (4.3 and later; EKF3)
- ODOMETRY only in LOCAL_FRD / BODY_FRD, at 4 Hz or more; healthy for 300 ms after each message. At most one per 20 ms
  is fused (of two closer ones the second is dropped): 25 to 50 Hz is suitable.
- It converts the covariance to cbrt(a^2 + b^2 + c^2) of the three variances, not to a sigma (0.1 m each gives 0.067 m,
  0.5 m gives 0.57 m), and never below VISO_POS_M_NSE and VISO_YAW_M_NSE; velocity always has VISO_VEL_M_NSE.
- time_usec is converted by the fastest message (JitterCorrection): a constant delay is not corrected. For grd it is
  only the transmission delay, because poses are predicted to the time of sending.
- A change of reset_counter resets its position to the message's immediately.
- Its health check accepts quality -1 and 0: a bad pose must not be sent.

PX4 (1.14 and later; EKF2)
- Fusion starts when two messages are less than 200 ms apart and stops after 400 ms without one; 30 to 50 Hz is
  suitable.
- VISION_POSITION_ESTIMATE is assumed north-aligned, LANDING_TARGET is accepted only in its local NED: grd knows
  neither.
- time_usec is converted by its own TIMESYNC requests, which grd answers; until they have converged (500 requests) it
  uses the arrival time.
- estimator_type must be VIO or VISION; LIDAR is rejected.

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
WIRE_ERROR = 1e-6  # relative: parameters are 32-bit floats


@dataclass(frozen=True, slots=True)
class RequiredParameter:
    """One parameter: its allowed values, best first, or a range or bits; and the reason."""

    name: str
    values: tuple[float, ...] = ()
    at_least: float = -math.inf
    at_most: float = math.inf
    bits: int = 0  # all of these must be set
    why: str = ""

    def fits(self, value: float) -> bool:
        """Whether a value is allowed, within the precision of 32 bits."""
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
    """Requirements of one autopilot."""

    name: ProfileName
    required: tuple[RequiredParameter, ...]
    unsupported: Mapping[str, str] = field(default_factory=dict[str, str])  # message -> why it is not sent
    integers_bytewise: bool = False  # PARAM_VALUE holds an integer's bytes, not its value


_ZERO_OFFSET = "grd sends the pose of the drone's body, not of a camera"

ARDUPILOT = Profile(
    name="ardupilot",
    required=(
        RequiredParameter("AHRS_EKF_TYPE", (3.0,), why="only EKF3 fuses an external pose"),
        RequiredParameter("EK3_ENABLE", (1.0,), why="EKF3 must run"),
        RequiredParameter("VISO_TYPE", (1.0,), why="MAVLink; 3 (VOXL) would hide resets behind an offset"),
        RequiredParameter("EK3_SRC1_POSXY", (6.0,), why="horizontal position from grd"),
        RequiredParameter("EK3_SRC1_VELXY", (6.0, 0.0), why="velocity from grd if known, or none; not GPS"),
        RequiredParameter("EK3_SRC1_POSZ", (6.0, 1.0), why="height from grd, or the barometer"),
        RequiredParameter("EK3_SRC1_VELZ", (6.0, 0.0), why="climb rate from grd if known, or none"),
        RequiredParameter(
            "EK3_SRC1_YAW", (6.0,), why="yaw from grd: its frame is not north-aligned, a compass would rotate it"
        ),
        RequiredParameter("VISO_POS_X", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_POS_Y", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_POS_Z", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_ORIENT", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_SCALE", (1.0,), why="positions are in metres"),
        RequiredParameter(
            "VISO_DELAY_MS",
            at_least=0.0,
            at_most=50.0,
            why="transmission delay only: poses are predicted to the time of sending",
        ),
        RequiredParameter(
            "VISO_POS_M_NSE", at_least=0.05, at_most=0.5, why="minimum position sigma; grd's is 0.1 to 0.3 m"
        ),
        RequiredParameter("VISO_YAW_M_NSE", at_least=0.05, at_most=0.3, why="minimum yaw sigma"),
        RequiredParameter(
            "VISO_VEL_M_NSE", at_least=0.1, at_most=1.0, why="sigma of every velocity: the message's is not used"
        ),
        RequiredParameter("VISO_QUAL_MIN", at_least=0.0, at_most=50.0, why="-1 would accept failed poses"),
    ),
)

_NOT_NORTH = "PX4 assumes a north-aligned frame, and grd's is not; send odometry"
PX4 = Profile(
    name="px4",
    required=(
        RequiredParameter(
            "EKF2_EV_CTRL", bits=1 | 8, why="1: horizontal position, 8: yaw; 2 (height) and 4 (velocity) are optional"
        ),
        RequiredParameter("EKF2_HGT_REF", (3.0, 0.0), why="height from grd, or the barometer"),
        RequiredParameter(
            "EKF2_GPS_CTRL", (0.0,), why="with GPS it rejects the yaw of a frame that is not north-aligned"
        ),
        RequiredParameter("EKF2_MAG_TYPE", (5.0,), why="no compass: the yaw is from grd"),
        RequiredParameter("EKF2_EV_NOISE_MD", (0.0,), why="use the message's covariance"),
        RequiredParameter(
            "EKF2_EV_DELAY",
            at_least=0.0,
            at_most=50.0,
            why="transmission delay only: poses are predicted to the time of sending",
        ),
        RequiredParameter("EKF2_EVP_NOISE", at_least=0.01, at_most=0.3, why="minimum position sigma"),
        RequiredParameter("EKF2_EVA_NOISE", at_least=0.01, at_most=0.2, why="minimum angle sigma"),
        RequiredParameter("EKF2_EVV_NOISE", at_least=0.05, at_most=0.5, why="minimum velocity sigma"),
        RequiredParameter("EKF2_EV_QMIN", at_least=0.0, at_most=50.0, why="quality is 1 at grd's limits, 100 at best"),
        RequiredParameter("EKF2_EV_POS_X", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("EKF2_EV_POS_Y", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("EKF2_EV_POS_Z", (0.0,), why=_ZERO_OFFSET),
    ),
    unsupported={
        "vision_position_estimate": _NOT_NORTH,
        "landing_target": "PX4 accepts it only in its local NED frame, which grd does not know",
    },
    integers_bytewise=True,
)

PROFILES: dict[ProfileName, Profile] = {"ardupilot": ARDUPILOT, "px4": PX4}


def findings(profile: Profile, values: Mapping[str, float]) -> list[str]:
    """One sentence per wrong or missing parameter; empty: all are correct."""
    found: list[str] = []
    for parameter in profile.required:
        value = values.get(parameter.name)
        if value is None:
            found.append(f"{parameter.name} was not received; it must be {parameter} ({parameter.why})")
        elif not parameter.fits(value):
            found.append(f"{parameter.name} is {value:g}, but must be {parameter} ({parameter.why})")
    return found

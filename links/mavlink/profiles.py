"""Parameters that each autopilot needs, and why. Preflight checks them.

They depend on what the poses contain (`yaw` of the link):

    none      positions in the autopilot's own axes: its yaw must come from its compass (or GPS), never from grd, and in
              both source sets from the same one: another resets its yaw
    measured  poses in axes that are constant, parallel to the autopilot's when the first was sent: the yaw must come
              from grd alone; with the compass it would turn against the positions as the error of the compass changes

grd is one source set of ArduPilot (`source_set`, EK3_SRC2_* by default); set 1 is the source that flies without grd.

ArduPilot (4.6; EKF3)
- ODOMETRY only in LOCAL_FRD / BODY_FRD, at 4 Hz or more; healthy for 300 ms after each message. At most one per 20 ms
  is fused (of two closer ones the second is dropped): 25 to 50 Hz is suitable.
- EK3_SRC_OPTIONS bit 0, on by default, fuses the velocities of all source sets: one of an external pose in another
  frame is a fly-away of a drone that flies by GPS. grd sends no velocity; the bit must be off all the same.
- With VISO_TYPE set, arming is refused ("VisOdom: not healthy") until poses arrive, and grd sends none before the drone
  has moved: the check of visual odometry (ARMING_CHECK bit 18) must be off, and with it bit 0 (all checks).
- It converts the covariance to cbrt(a^2 + b^2 + c^2) of the three variances, not to a sigma (0.1 m each gives 0.067 m,
  0.5 m gives 0.57 m), and never below VISO_POS_M_NSE and VISO_YAW_M_NSE.
- With a GPS receiver it uses neither for the horizontal position, but the accuracy that GPS reports, at least
  EK3_POSNE_M_NSE (0.5 m), also with the source set of grd, and up to 4.6 at least: where GPS is bad, poses of grd weigh
  little. Calculated for 3 m: the position follows them over 3.5 s, and an error of 1 m/s^2 moves it by 12 m.
- Aiding that begins with grd (set 1 without position) sets the height to grd's, even if it comes from the barometer.
- Position times out 7 s after the last fused pose; the EKF failsafe lands 1 s later. Until then it says nothing.
- time_usec is converted by the fastest message (JitterCorrection): a constant delay is not corrected. For grd it is
  only the transmission delay, because poses are predicted to the time of sending.
- A change of reset_counter resets its position to the message's immediately.
- Its health check accepts quality -1 and 0: a bad pose must not be sent.

PX4 (1.14 and later; EKF2)
- Fusion starts when two messages are less than 200 ms apart and stops after 400 ms without one; 30 to 50 Hz is
  suitable.
- A position in LOCAL_NED needs no rotation, and with GPS its offset to it is estimated; in LOCAL_FRD without external
  yaw the position is rotated by the message's rotation.
- VISION_POSITION_ESTIMATE contains angles, which cannot be left out; LANDING_TARGET is accepted only in its local NED.
- time_usec is converted by its own TIMESYNC requests, which grd answers; until they have converged (500 requests) it
  uses the arrival time.
- estimator_type must be VIO or VISION; LIDAR is rejected.
- A pose with yaw in LOCAL_FRD leaves the yaw "not aligned" for the rest of the flight, so grd sends LOCAL_NED.
- When GPS stops, the position is reset to grd's, and grd's offset to GPS is forgotten.
- Its ESTIMATOR_STATUS has one test ratio of position, the larger one of GPS and grd.
- HIGHRES_IMU lacks the biases that EKF2 estimates (`readers.py`): it is not independent of poses to that extent.

Source: ArduPilot libraries/AP_VisualOdom/*.cpp, GCS_MAVLINK::handle_odometry, NavEKF3_core::writeExtNavData,
NavEKF3_core::FuseVelPosNED (gpsPosAccuracy), setAidingMode, SelectMagFusion (yaw_source_reset),
AP_NavEKF_Source::useVelXYSource, AP_Arming::visodom_checks,
https://ardupilot.org/dev/docs/mavlink-nongps-position-estimation.html; PX4 mavlink_receiver.cpp
(handle_message_odometry, _vision_position_estimate, _landing_target), EKF2 aid_sources/external_vision/*.cpp (yaw
variance: max(variance, EKF2_EVA_NOISE), not squared), Ekf::get_innovation_test_status,
https://docs.px4.io/main/en/ros/external_position_estimation.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Literal

ProfileName = Literal["ardupilot", "px4"]
YawOutput = Literal["none", "measured"]
WIRE_ERROR = 1e-6  # relative: parameters are 32-bit floats


@dataclass(frozen=True, slots=True)
class RequiredParameter:
    """One parameter: its allowed values, best first, or a range, or bits that are on or off; and the reason."""

    name: str
    values: tuple[float, ...] = ()
    at_least: float = -math.inf
    at_most: float = math.inf
    bits: int = 0  # all of these must be set
    bits_off: int = 0  # none of these may be set
    why: str = ""
    when: Mapping[str, float] = field(default_factory=dict[str, float])  # only while other parameters have these values

    def applies(self, values: Mapping[str, float]) -> bool:
        """Whether it is required, given the values of all parameters."""
        return all(values.get(name) == value for name, value in self.when.items())

    def fits(self, value: float) -> bool:
        """Whether a value is allowed, within the precision of 32 bits."""
        if not math.isfinite(value):
            return False
        if self.values and not any(abs(value - v) <= WIRE_ERROR * max(1.0, abs(v)) for v in self.values):
            return False
        within = self.at_least - WIRE_ERROR <= value <= self.at_most + WIRE_ERROR
        return within and round(value) & self.bits == self.bits and not round(value) & self.bits_off

    @property
    def best(self) -> float:
        """An allowed value: the first, or the middle of the range, or the bits."""
        if self.values:
            return self.values[0]
        if self.bits or self.bits_off:
            return float(self.bits)
        return 0.5 * (self.at_least + self.at_most)

    def __str__(self) -> str:
        if self.values:
            return " or ".join(f"{v:g}" for v in self.values)
        if self.bits or self.bits_off:
            on, off = f"with bits {self.bits}" * bool(self.bits), f"without bits {self.bits_off}" * bool(self.bits_off)
            return " and ".join(filter(None, (on, off)))
        return f"{self.at_least:g} to {self.at_most:g}"


ARDUPILOT_STREAMS = {
    "ATTITUDE": "SRn_EXTRA1",
    "LOCAL_POSITION_NED": "SRn_POSITION",
    "RAW_IMU": "SRn_RAW_SENS",
    "EKF_STATUS_REPORT": "SRn_EXTRA3",
    "ODOMETRY": "in no stream: MAV_CMD_SET_MESSAGE_INTERVAL",
}
"""Stream rate that each message depends on; n is the number of the port. Source: ArduCopter GCS_Mavlink.cpp."""


@dataclass(frozen=True, slots=True)
class Profile:
    """What one autopilot supports."""

    name: ProfileName
    unsupported: Mapping[str, str] = field(default_factory=dict[str, str])  # message -> why it is not sent
    integers_bytewise: bool = False  # PARAM_VALUE holds an integer's bytes, not its value
    least_version: tuple[int, int] = (0, 0)
    least_version_why: str = ""
    unknown_version: tuple[int, int] | None = None  # from this one on it is not supported
    unknown_version_why: str = ""


_ZERO_OFFSET = "grd sends the pose of the drone's body, not of a camera"
_DELAY = "transmission delay only: poses are predicted to the time of sending"
GPS, EXTERNAL = 3.0, 6.0  # of EK3_SRCn_POSXY; the latter, ExternalNav, of the others, too
VISUAL_ODOMETRY_CHECK = 1 << 18  # of ARMING_CHECK

_NO_ROTATION = "its angles cannot be left out, so it cannot be a position without yaw; send odometry"
ARDUPILOT = Profile(
    name="ardupilot",
    least_version=(4, 6),
    least_version_why="earlier ones reset the position to GPS while the source set of grd is used",
    unknown_version=(4, 7),
    unknown_version_why="ARMING_SKIPCHK replaces ARMING_CHECK there, and the rules of grd were not compared with it",
)
PX4 = Profile(
    name="px4",
    unsupported={
        "vision_position_estimate": _NO_ROTATION,
        "landing_target": "PX4 accepts it only in its local NED frame, and grd has it in the body frame",
    },
    integers_bytewise=True,
    least_version=(1, 14),
    least_version_why="earlier ones have other parameters of external vision",
)

PROFILES: dict[ProfileName, Profile] = {"ardupilot": ARDUPILOT, "px4": PX4}


def required_parameters(profile: ProfileName, yaw: YawOutput, source_set: int = 2) -> tuple[RequiredParameter, ...]:
    """The parameters that an autopilot needs for these poses; `source_set`: that of grd (ArduPilot)."""
    return _ardupilot(yaw, source_set) if profile == "ardupilot" else _px4(yaw)


def _ardupilot_yaw(yaw: YawOutput, own: str) -> tuple[RequiredParameter, ...]:
    """What depends on the yaw; `own`: prefix of grd's source set."""
    velocity = "grd sends no velocity"
    if yaw == "measured":
        return (
            RequiredParameter(own + "VELXY", (0.0, 5.0), why=f"{velocity}; GPS velocity is in another frame"),
            RequiredParameter(own + "VELZ", (0.0,), why=velocity),
            RequiredParameter(
                own + "YAW", (EXTERNAL,), why="yaw from grd: its frame is not north-aligned, a compass would rotate it"
            ),
            RequiredParameter("VISO_YAW_M_NSE", at_least=0.05, at_most=0.3, why="minimum yaw sigma"),
        )
    same_yaw = (
        RequiredParameter(
            own + "YAW",
            (source,),
            when={"EK3_SRC1_YAW": source},
            why="as EK3_SRC1_YAW: a change of the source resets the yaw, and grd then knows the axes no more",
        )
        for source in (1.0, 2.0, 3.0)
    )
    return (
        RequiredParameter(own + "VELXY", (0.0, 3.0, 5.0), why=velocity),
        RequiredParameter(own + "VELZ", (0.0, 3.0), why=velocity),
        RequiredParameter(
            own + "YAW", (1.0, 2.0, 3.0), why="compass or GPS: grd sends no yaw, but positions in its axes"
        ),
        *same_yaw,
    )


def _other_sets(source_set: int) -> tuple[RequiredParameter, ...]:
    """Of the source sets without grd."""
    without_grd = "set 1 flies without grd"
    other = (
        RequiredParameter("EK3_SRC1_POSXY", (GPS, 0.0), why=f"{without_grd}: GPS, or none where there is no GPS"),
        RequiredParameter("EK3_SRC1_VELXY", (3.0, 0.0, 5.0), why=without_grd),
        RequiredParameter("EK3_SRC1_POSZ", (1.0, 2.0, 3.0), why=without_grd),
        RequiredParameter("EK3_SRC1_VELZ", (3.0, 0.0), why=without_grd),
        RequiredParameter("EK3_SRC1_YAW", (1.0, 2.0, 3.0), why=without_grd),
    )
    spare = f"EK3_SRC{5 - source_set}_"  # selected by the third position of the switch
    hit_by_mistake = "the pilot's switch can select it, and a set without sources loses position and yaw"
    not_grd = "grd's poses belong in its own set"
    spare_set = (
        RequiredParameter(
            spare + "POSXY",
            (GPS, 4.0),
            when={"EK3_SRC1_POSXY": GPS, spare + "VELXY": 0.0},
            why=f"as set 1: {hit_by_mistake}",
        ),
        RequiredParameter(spare + "POSXY", (GPS, 0.0, 4.0), why=not_grd),
        RequiredParameter(spare + "VELXY", (3.0, 0.0, 4.0, 5.0, 7.0), why=not_grd),
        RequiredParameter(spare + "YAW", (1.0, 2.0, 3.0, 8.0), why=f"as set 1: {hit_by_mistake}"),
    )
    return *other, *spare_set


def _ardupilot(yaw: YawOutput, source_set: int) -> tuple[RequiredParameter, ...]:
    own = f"EK3_SRC{source_set}_"
    return (
        RequiredParameter("AHRS_EKF_TYPE", (3.0,), why="only EKF3 fuses an external pose"),
        RequiredParameter("EK3_ENABLE", (1.0,), why="EKF3 must run"),
        RequiredParameter("EK3_SRC_OPTIONS", bits_off=1, why="1 fuses the velocities of all source sets: a fly-away"),
        RequiredParameter(
            "INS_ACCEL_FILTER",
            at_least=10.0,
            at_most=30.0,
            why="Hz: with more, vibration is aliased into the IMU stream; with less, samples are older than assumed",
        ),
        RequiredParameter("VISO_TYPE", (1.0,), why="MAVLink; 3 (VOXL) would hide resets behind an offset"),
        RequiredParameter(own + "POSXY", (EXTERNAL,), why="horizontal position from grd"),
        RequiredParameter(own + "POSZ", (EXTERNAL, 1.0), why="height from grd, or the barometer"),
        RequiredParameter(
            own + "POSZ",
            (EXTERNAL,),
            when={"EK3_SRC1_POSXY": 0.0},
            why="without a position in set 1 the switch sets the height to grd's, and the barometer would pull it back",
        ),
        *_ardupilot_yaw(yaw, own),
        *(_other_sets(source_set) if source_set != 1 else ()),
        RequiredParameter(
            "ARMING_CHECK",
            bits_off=1 | VISUAL_ODOMETRY_CHECK,
            why="the check of visual odometry refuses arming before grd sends, and grd sends after the drone has moved",
        ),
        RequiredParameter("VISO_POS_X", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_POS_Y", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_POS_Z", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_ORIENT", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("VISO_SCALE", (1.0,), why="positions are in metres"),
        RequiredParameter("VISO_DELAY_MS", at_least=0.0, at_most=50.0, why=_DELAY),
        RequiredParameter(
            "VISO_POS_M_NSE", at_least=0.05, at_most=0.5, why="minimum position sigma; grd's is 0.1 to 0.3 m"
        ),
        RequiredParameter("VISO_QUAL_MIN", at_least=0.0, at_most=50.0, why="-1 would accept failed poses"),
    )


def _px4(yaw: YawOutput) -> tuple[RequiredParameter, ...]:
    measured = (
        RequiredParameter(
            "EKF2_EV_CTRL",
            bits=1 | 8,
            bits_off=4,
            why="1: horizontal position, 8: yaw; 2 (height) is optional, 4 (velocity) is not sent",
        ),
        RequiredParameter("EKF2_GPS_CTRL", (0.0,), why="the yaw of grd is not that of the true north, as GPS needs"),
        RequiredParameter("EKF2_MAG_TYPE", (5.0,), why="no compass: the yaw is from grd"),
        RequiredParameter("EKF2_EVA_NOISE", at_least=0.05, at_most=0.1, why="minimum variance of the yaw, unsquared"),
    )
    without_yaw = (
        RequiredParameter(
            "EKF2_EV_CTRL",
            bits=1,
            bits_off=4 | 8,
            why="1: horizontal position; 2 (height) is optional, 4 (velocity) and 8 (yaw) are not sent",
        ),
        RequiredParameter("EKF2_MAG_TYPE", (0.0, 1.0), why="yaw from the compass: grd sends none"),
    )
    return (
        *(measured if yaw == "measured" else without_yaw),
        RequiredParameter("EKF2_HGT_REF", (0.0, 3.0, 1.0), why="height from the barometer, grd or GPS"),
        RequiredParameter("EKF2_EV_NOISE_MD", (0.0,), why="use the message's covariance"),
        RequiredParameter(
            "EKF2_EV_DELAY", at_least=0.0, at_most=20.0, why="TIMESYNC already removes the delay of the link"
        ),
        RequiredParameter("EKF2_EVP_NOISE", at_least=0.01, at_most=0.3, why="minimum position sigma"),
        RequiredParameter("EKF2_EV_QMIN", at_least=0.0, at_most=50.0, why="quality is 1 at grd's limits, 100 at best"),
        RequiredParameter("EKF2_EV_POS_X", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("EKF2_EV_POS_Y", (0.0,), why=_ZERO_OFFSET),
        RequiredParameter("EKF2_EV_POS_Z", (0.0,), why=_ZERO_OFFSET),
    )


def best_values(required: Sequence[RequiredParameter]) -> dict[str, float]:
    """Values with which all fit."""
    conditional_first = sorted(required, key=lambda parameter: not parameter.when)
    values = {parameter.name: parameter.best for parameter in conditional_first}
    return values | {parameter.name: parameter.best for parameter in required if parameter.applies(values)}


def findings(required: Sequence[RequiredParameter], values: Mapping[str, float]) -> list[str]:
    """One sentence per wrong or missing parameter; empty: all are correct."""
    found: dict[str, str] = {}
    for parameter in (one for one in required if one.applies(values)):
        value = values.get(parameter.name)
        if value is None:
            text = f"{parameter.name} was not received; it must be {parameter} ({parameter.why})"
        elif not parameter.fits(value):
            text = f"{parameter.name} is {value:g}, but must be {parameter} ({parameter.why})"
        else:
            continue
        found.setdefault(parameter.name, text)
    return list(found.values())

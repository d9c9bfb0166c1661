"""Requests the autopilot's EKF to use the source set of grd, and set 1 again when poses end (`switch_source`).

The switch to grd's set is requested (MAV_CMD_SET_EKF_SOURCE_SET) while all of this holds:

    armed, in a mode that holds or is flown by hand
    its parameters are as `profiles.py` requires; they are read once after each boot
    poses have been sent for MIN_SENDING_NS, and the newest contains a LiDAR position of the last second
    its EKF reports its state, and no test ratio of position or velocity above MAX_RATIO. That of the compass must be
        below the threshold of the EKF failsafe: it is kept where grd's yaw replaces the compass (`getVariances`)
    the poses move as its own estimate does (`poses/agreement.py`), and are no more than FAR_M away from it, unless its
        EKF has no position to compare
    it is slow enough for the angle between both axes, see below

A request that is denied, or that is not acknowledged three times, is not repeated until the autopilot boots. Nor is any
after somebody else has selected another set, or has commanded one from another station, as far as that is seen:
ArduPilot names a set that its remote control selects in a STATUSTEXT. It acknowledges a command without a text, and
reports nowhere which set is in use: after a boot, a start of grd, a silence, or a command of another station it is
unknown until a text or an acknowledgement, and so it is after a request of ours until it is acknowledged.

Set 1 is requested FALLBACK_AFTER_NS after the last pose, once a second until it is acknowledged, if its position is
from another source than grd, and GPS (its first receiver) has a 3D fix; with one worse than MAX_GPS_SIGMA_M only
GPS_WAIT_NS after the last pose. ArduPilot alone does not return to it, and checks nothing at the command. On grd's set
it flies on for 7 s without a position: poses that return within that time are better than a set 1 without GPS. Without
a connection, or after the end of grd, nothing is requested: the pilot has to switch. Neither does grd that was
restarted in flight request set 1 before it has requested its own set again, because it does not know which set is in
use.

Poses with yaw are in axes parallel to those that the autopilot had at the first one. If its EKF has reset its yaw
since, they are not parallel any more. With the source of the yaw the EKF turns its axes, but not its velocity:
NavEKF3_core::SelectVelPosFusion resets the position alone, and a velocity that is wrong by less than the gate (5 sigma,
some 4 m/s) is not reset either but flown with. So no set is requested, set 1 neither, while the velocity in the turned
axes would be wrong by more than MAX_TURNED_MPS.

Source: ours; ArduPilot GCS_MAVLINK::handle_command_set_ekf_source_set, RC_Channel::do_aux_function (EKF_SOURCE_SET),
ArduCopter mode.h (numbers of modes), ekf_check.cpp (FS_EKF_THRESH), NavEKF3_core::send_status_report, getVariances,
calcGpsGoodToAlign (horizontal accuracy).
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from links.mavlink.commands import ACCEPTED, ACK_TIMEOUT_NS, IN_PROGRESS, TEMPORARILY_REJECTED, command_long, is_answer
from links.mavlink.poses.agreement import MotionAgreement
from links.mavlink.poses.autopilot_estimate import AutopilotEstimate
from links.mavlink.poses.sent_frame import FAR_M, SentFrame
from links.mavlink.profiles import EXTERNAL, GPS, RequiredParameter, findings
from links.mavlink.readers import CONSTANT_POSITION, FIX_3D, HORIZONTAL_RELATIVE
from links.mavlink.transport.framing import dialect
from stages.messages import RelativePose

SET_EKF_SOURCE_SET = 42007  # MAV_CMD
FIRST_SET = 1  # flies without grd
MODES = {0, 2, 4, 5, 16, 17}  # ArduCopter: Stabilize, AltHold, Guided, Loiter, PosHold, Brake
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
MIN_SENDING_NS = 5_000_000_000  # ours: poses that are often interrupted cause no switch
FALLBACK_AFTER_NS = 500_000_000  # without a pose; ArduPilot's position times out after 7 s
MAX_FIX_AGE_NS = 1_000_000_000  # age of the LiDAR position in a pose
MAX_STATUS_AGE_NS = 2_000_000_000  # age of the EKF's status
MAX_RATIO = 0.5  # test ratio; above 1 the EKF rejects
FAILSAFE_RATIO = 0.8  # FS_EKF_THRESH
MAX_GPS_SIGMA_M = 5.0  # as EKF3 requires before it begins to use GPS
GPS_WAIT_NS, MAX_GPS_AGE_NS = 4_000_000_000, 2_500_000_000  # ours: before the EKF's 7 s; two messages of 1 Hz
GPS_STATUS_HZ = 1.0  # rate at which GPS_RAW_INT is requested for it
MAX_TURNED_MPS = 1.0  # ours, chosen: error of the EKF's velocity after a change of axes
HYSTERESIS_M = 2.0  # below FAR_M, from which a switch is requested again
TRIES = 3
PARAMETER_PERIOD_NS, PARAMETER_RETRY_PERIOD_NS = 200_000_000, 10_000_000_000  # of requests, and after TRIES of each
USING = re.compile(r"Using EKF Source Set (\d)")


class SourceSwitch:
    """The source set that one ArduPilot uses, in one run of grd; with `enabled` it also requests sets."""

    def __init__(
        self,
        source_set: int,
        enabled: bool,
        required: Sequence[RequiredParameter],
        target: tuple[int, int],
        own: tuple[int, int],
        warn: Callable[[str], None],
        pose_sigma_m: float,
    ) -> None:
        self.requests = 0
        """How often a set was requested."""
        self.agreement = MotionAgreement(pose_sigma_m)
        self._set, self._enabled, self._required = source_set, enabled, required
        self._target, self._own, self._warn = target, own, warn
        self.on_boot()

    def on_boot(self) -> None:
        """The autopilot has booted, or may have: its parameters may have changed.

        It uses set 1, unless the switch of the remote control selects another one at once.
        """
        self.active: int | None = FIRST_SET if self._set == FIRST_SET else None
        """The set in use; None: not known."""
        self._may_be_own = False  # grd's set was requested, and it is not known whether it is in use
        self._before: int | None = None  # set in use before that request
        self._values: dict[str, float] = {}
        self._parameter_requests, self._parameter_ns = 0, 0
        self._armed, self._mode = False, -1
        self._status: tuple[int, Any] | None = None  # arrival and message
        self._gps: tuple[int, Any] | None = None  # arrival and newest GPS_RAW_INT
        self._position_ns = 0  # newest LOCAL_POSITION_NED
        self._speed_mps = 0.0  # of it, horizontal
        self._step_m: float | None = None  # of the position at a switch, if it is too large
        self._turn_rad = math.pi  # of the axes of the poses against those of its own sources; at first unknown
        self._warned = ""  # why set 1, which is due, is not requested
        self._blocked = ""  # why grd's set is not requested any more
        self._pending: tuple[int, int] | None = None  # the set requested, and when
        self._tries = 0
        self._sending_ns: int | None = None  # since when poses are sent
        self._sent: RelativePose | None = None  # newest sent pose
        self._sent_ns = 0
        self.agreement.restart()

    @property
    def status(self) -> str | None:
        """Why no switch is requested any more, or what is wrong with the parameters; None: nothing to report."""
        if not self._enabled:
            return None
        if self._blocked:
            return f"source set {self._set} is not requested: {self._blocked}"
        read = not self._missing() or self._parameter_requests >= TRIES * len(self._required)
        wrong = findings(self._required, self._values) if read else []
        ratio = math.nan if self._status is None else float(self._status[1].compass_variance)
        if ratio >= FAILSAFE_RATIO and self.active != self._set:
            wrong.append(f"the EKF's test ratio of the compass is {ratio:.1f}; switch by hand, or move away from steel")
        if self._step_m is not None and self.active != self._set:
            wrong.append(f"the position would move by {self._step_m:.0f} m; land and reboot the autopilot")
        return f"source set {self._set} is not requested: {wrong[0]}" if wrong else None

    @property
    def uses_grd(self) -> bool | None:
        """Whether the set in use is that of grd; None: not known."""
        return None if self.active is None else self.active == self._set

    def on_message(self, message: Any, arrival_ns: int) -> None:
        """Take a message of the autopilot."""
        kind = message.get_type()
        if kind == "STATUSTEXT":
            self._on_text(message.text)
        elif kind == "COMMAND_ACK" and message.command == SET_EKF_SOURCE_SET:
            self._on_result(message.result, is_answer(message, SET_EKF_SOURCE_SET, self._own))
        elif not self._enabled:
            return
        elif kind == "HEARTBEAT":
            self._armed, self._mode = bool(message.base_mode & ARMED), message.custom_mode
        elif kind == "EKF_STATUS_REPORT":
            self._status = arrival_ns, message
        elif kind == "LOCAL_POSITION_NED":
            self._position_ns, self._speed_mps = arrival_ns, math.hypot(message.vx, message.vy)
        elif kind == "PARAM_VALUE" and message.param_id in self._missing():
            self._values[message.param_id] = float(message.param_value)
        elif kind == "GPS_RAW_INT":
            self._gps = arrival_ns, message

    def on_silence(self) -> None:
        """The autopilot was silent: a selection of another set may have been missed."""
        if self.active != self._set:
            self.active = FIRST_SET if self._set == FIRST_SET else None

    def on_sent(
        self,
        pose: RelativePose,
        frame: SentFrame,
        turn_rad: float | None,
        autopilot: AutopilotEstimate,
        now_ns: int,
    ) -> None:
        """A pose was sent in a frame; `autopilot`: its newest estimate.

        `turn_rad`: angle of the frame's axes against the autopilot's own; None: not known.
        """
        if not self._enabled:
            return
        if self._sending_ns is None or now_ns - self._sent_ns > FALLBACK_AFTER_NS:
            self._sending_ns = now_ns
            self.agreement.restart()
        self._sent, self._sent_ns, self._warned = pose, now_ns, ""
        if self.active != self._set and turn_rad is not None:
            self._turn_rad = turn_rad
        off_m = self.agreement.add(pose, frame, autopilot)
        if off_m is not None and self.active != self._set:
            self._warn(f"pose and autopilot differ by {off_m:.1f} m")
        own_m = None if autopilot.position is None else autopilot.position.at(pose.stamp_ns)
        if own_m is None or pose.xyz_map_m is None:
            self._step_m = None
            return
        step_m, limit_m = float(np.linalg.norm(frame.position(pose.xyz_map_m) - own_m)), FAR_M
        if self._step_m is not None:
            limit_m -= HYSTERESIS_M
        elif step_m > limit_m and self.active != self._set:
            self._warn(f"no source switch: position would move {step_m:.0f} m")
        self._step_m = step_m if step_m > limit_m else None

    def due(self, now_ns: int) -> Any | None:
        """The message to send now, if one is due."""
        if not self._enabled:
            return None
        if self._pending is not None:
            return self._repeated(*self._pending, now_ns)
        ended = self._sent is not None and now_ns - self._sent_ns > FALLBACK_AFTER_NS
        may_be_own = self.active == self._set or (self.active is None and self._may_be_own)
        if may_be_own and ended and self._has_other_position():
            reason = self._why_not_first_set(now_ns)
            if not reason:
                return self._request(FIRST_SET, now_ns)
            if reason != self._warned:
                self._warned = reason
                self._warn(reason)
        if self._missing():
            return self._parameter_request(now_ns)
        if self.active != self._set and not self._blocked and self._is_ready(now_ns):
            return self._request(self._set, now_ns)
        return None

    def on_not_sent(self) -> None:
        """The message of `due` could not be sent: it is due again at once."""
        if self._pending is not None:
            self._pending = self._pending[0], -ACK_TIMEOUT_NS
            self._tries -= 1
        self._parameter_ns = 0

    def _is_ready(self, now_ns: int) -> bool:
        """Whether everything holds that the switch to grd's set requires."""
        pose = self._sent
        if pose is None or self._sending_ns is None or now_ns - self._sent_ns > FALLBACK_AFTER_NS:
            return False
        if now_ns - self._sending_ns < MIN_SENDING_NS or not self._armed or self._mode not in MODES:
            return False
        if pose.measured_ns is None or pose.stamp_ns - pose.measured_ns > MAX_FIX_AGE_NS:
            return False
        if findings(self._required, self._values) or not self._is_slow() or self._step_m is not None:
            return False
        if self._status is None or now_ns - self._status[0] > MAX_STATUS_AGE_NS:
            return False
        status = self._status[1]
        ratios = status.pos_horiz_variance, status.velocity_variance
        if any(math.isfinite(ratio) and ratio > MAX_RATIO for ratio in ratios):
            return False
        if math.isfinite(status.compass_variance) and status.compass_variance >= FAILSAFE_RATIO:
            return False
        has_position = status.flags & HORIZONTAL_RELATIVE and not status.flags & CONSTANT_POSITION
        return self.agreement.agrees(now_ns) if has_position else now_ns - self._position_ns > MAX_STATUS_AGE_NS

    def _is_slow(self) -> bool:
        """Whether the velocity that the EKF keeps is nearly right in the axes of the other set."""
        return 2.0 * abs(math.sin(0.5 * self._turn_rad)) * self._speed_mps < MAX_TURNED_MPS

    def _has_other_position(self) -> bool:
        """Whether set 1 has a position of another source than grd."""
        return self._values.get("EK3_SRC1_POSXY", 0.0) not in (0.0, EXTERNAL)

    def _why_not_first_set(self, now_ns: int) -> str:
        """Why set 1 is worse than grd's without poses; empty: it is not, as far as is known."""
        if self._values.get("EK3_SRC1_POSXY") == GPS and self._gps and now_ns - self._gps[0] < MAX_GPS_AGE_NS:
            gps = self._gps[1]
            waits = now_ns - self._sent_ns < GPS_WAIT_NS
            if gps.fix_type < FIX_3D or (waits and 1e-3 * gps.h_acc > MAX_GPS_SIGMA_M):  # 0: not reported
                return "GPS unusable: source set 1 is not requested"
        return "" if self._is_slow() else "too fast for source set 1: slow down"

    def _missing(self) -> list[str]:
        names = dict.fromkeys(parameter.name for parameter in self._required if parameter.applies(self._values))
        return [name for name in names if name not in self._values]

    def _parameter_request(self, now_ns: int) -> Any | None:
        first = self._parameter_requests < TRIES * len(self._required)
        if now_ns - self._parameter_ns < (PARAMETER_PERIOD_NS if first else PARAMETER_RETRY_PERIOD_NS):
            return None
        missing = self._missing()
        name = missing[self._parameter_requests % len(missing)]
        self._parameter_requests += 1
        self._parameter_ns = now_ns
        return dialect().MAVLink_param_request_read_message(*self._target, name.encode("ascii"), -1)

    def _request(self, number: int, now_ns: int) -> Any:
        self.requests += self._pending is None
        if number == self._set and self.active is not None:
            self._before, self.active = self.active, None
        self._may_be_own = number == self._set or self._may_be_own
        self._pending = number, now_ns
        self._tries += 1
        return command_long(self._target, SET_EKF_SOURCE_SET, float(number))

    def _repeated(self, number: int, sent_ns: int, now_ns: int) -> Any | None:
        """Repeat a request without acknowledgement; one for grd's set ends after TRIES, or without reason."""
        if now_ns - sent_ns < ACK_TIMEOUT_NS:
            return None
        if number == self._set and (self._tries >= TRIES or not self._is_ready(now_ns)):
            if self._tries >= TRIES:
                self._block("not acknowledged")
            self._pending, self._tries = None, 0
            return None
        return self._request(number, now_ns)

    def _on_result(self, result: int, ours: bool) -> None:
        if not ours or self._pending is None:
            if result == ACCEPTED:  # of another station, or to a request that was given up
                self.active, self._may_be_own = None, True
                if not ours and self._enabled:
                    self._block("another station chose a set")
            return
        if result in (IN_PROGRESS, TEMPORARILY_REJECTED):
            return
        number, self._pending, self._tries = self._pending[0], None, 0
        if result == ACCEPTED:
            self.active, self._may_be_own = number, False
            self._warn(f"autopilot uses source set {number}")
        elif number == self._set:
            self.active, self._may_be_own = self._before, False
            self._block(f"rejected, MAV_RESULT {result}")
        else:
            self.active = None  # not known
            self._blocked = f"the autopilot rejected source set {number} (MAV_RESULT {result})"
            self._warn(f"source set {number} rejected: switch now")

    def _on_text(self, text: str) -> None:
        found = USING.search(text)
        if found is None:
            return
        usual = None if self._armed else FIRST_SET  # before take-off it is the position of the switch at power-on
        number, requested = int(found[1]), self._pending[0] if self._pending else self.active or usual
        if self._enabled and number not in (self._set, requested):
            self._pending, self._tries = None, 0
            self._block(f"the pilot selected set {number}")
        self.active, self._may_be_own = number, False

    def _block(self, reason: str) -> None:
        self._blocked = reason
        self._warn(f"no source switch: {reason}")

"""Messages and texts to the autopilot about the poses: which, when, and with which reset counter. No socket, no clock.

`yaw` decides what ODOMETRY and VISION_POSITION_ESTIMATE contain, and which yaw source the autopilot needs:

    none      a position in the autopilot's own axes; its yaw comes from its compass. It needs no rotation of the drone
    cameras   a pose in `map` with yaw, while cameras measure it; its yaw comes from grd alone

The reset counter is incremented with every jump of the pose, every change of the drone, and after every pause that the
autopilot noticed, so that it resets to the new pose instead of gating it. Its initial value is arbitrary: after a
restart of grd it should differ from the previous one.

STATUSTEXT reports when sending stops (critical) and resumes (notice), and changes of the pose state. At most one text
per half second is sent, the newest of its kind; a text is kept until it was sent or replaced.

Source: ours; ArduPilot AP_VisualOdom (300 ms health), PX4 EKF2 EV_MAX_INTERVAL (200 ms to start, 400 ms to stop).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from links.mavlink.poses.gate import PoseLimits, RejectReason, reject_reason, yaw_reason
from links.mavlink.poses.pose_messages import landing_target, odometry, vision_position_estimate
from links.mavlink.poses.position_gate import position_reason
from links.mavlink.poses.position_messages import OwnAttitude, position_odometry, position_vision_estimate
from links.mavlink.profiles import ProfileName, YawOutput
from links.mavlink.transport.framing import SEQUENCE, dialect
from stages.messages import PoseState, RelativePose

PoseMessage = Literal["odometry", "vision_position_estimate", "landing_target"]
TextKind = Literal["output", "link", "state"]  # in order of priority; the newest text of each kind is kept

SILENCE_NS = 300_000_000  # the autopilot's timeout for poses
ATTITUDE_NS = 1_000_000_000  # largest age of the autopilot's attitude
TEXT_NS = 500_000_000  # minimum interval of texts
TEXT_BYTES = 50  # size of STATUSTEXT's text field
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY
SEVERITY = {PoseState.FULL: INFO, PoseState.COASTING: WARNING}  # of a state change; other states: warning


@dataclass(frozen=True, slots=True)
class SentPose:
    """The pose that was sent last."""

    at_ns: int
    stamp_ns: int
    resets: int
    track_id: int


class PoseSender:
    """Converts poses to messages, or rejects them and reports why. Call `due_texts` about ten times per second."""

    def __init__(
        self,
        kinds: Sequence[PoseMessage],
        limits: PoseLimits,
        reset_counter: int = 0,
        *,
        yaw: YawOutput,
        profile: ProfileName = "ardupilot",
    ) -> None:
        self.rejected: Counter[RejectReason] = Counter()
        self.reset_counter = reset_counter % SEQUENCE
        self._kinds: tuple[PoseMessage, ...] = tuple(kinds)
        self._limits = limits
        self._yaw: YawOutput = yaw
        self._profile: ProfileName = profile
        self._attitude: OwnAttitude | None = None
        self._poses_sent = self._yaw_reset = False  # since the autopilot's boot
        self._sent: SentPose | None = None
        self._incremented = False  # the reset counter, since `_sent`
        self._sending = False
        self._state: PoseState | None = None
        self._texts: dict[TextKind, tuple[int, str]] = {}  # waiting: severity and text
        self._text_ns: int | None = None
        self._offered: tuple[TextKind, int, str] | None = None  # the newest result of `due_texts`

    @property
    def sending(self) -> bool:
        """Whether poses are being sent."""
        return self._sending

    def messages(self, pose: RelativePose, now_ns: int, link_reason: RejectReason | None = None) -> list[Any]:
        """Messages of one pose; none if the gate rejects it, or with a `link_reason`. Then call `on_sent`."""
        if pose.state is not self._state:
            self._state = pose.state
            self._texts["state"] = SEVERITY.get(pose.state, WARNING), f"{pose.state.name}: {pose.reason}"
        reasons: dict[PoseMessage, RejectReason | None] = {
            kind: self._reason(kind, pose, now_ns) or link_reason for kind in self._kinds
        }
        self.rejected.update({reason for reason in reasons.values() if reason is not None})
        sendable: list[PoseMessage] = [kind for kind, reason in reasons.items() if reason is None]
        if not sendable:
            reason = next(iter(reasons.values()), None)
            if reason is not None and reason is not RejectReason.NOT_NEWER:  # a newer one was sent
                self._stop(reason.value)
            return []
        self._update_reset_counter(pose, now_ns)
        return [self._message(kind, pose) for kind in sendable]

    def on_attitude(self, attitude: OwnAttitude) -> None:
        """The autopilot's own attitude: positions for ArduPilot contain it."""
        self._attitude = attitude

    def on_yaw_reset(self) -> None:
        """The autopilot has reset its yaw. Once its telemetry contains our poses, its axes are then unknown."""
        self._yaw_reset = self._yaw_reset or self._poses_sent

    def on_boot(self) -> None:
        """The autopilot has booted."""
        self._poses_sent = self._yaw_reset = False

    def on_sent(self, pose: RelativePose, now_ns: int) -> None:
        """A message of this pose was sent."""
        self._sent = SentPose(now_ns, pose.stamp_ns, pose.resets, pose.track_id)
        self._incremented, self._poses_sent = False, True
        if not self._sending:
            self._sending = True
            self._texts["output"] = NOTICE, "sending poses"

    def due_texts(self, now_ns: int) -> list[Any]:
        """The STATUSTEXT that is due, if any. Also detects that no pose has been sent for SILENCE_NS."""
        if self._sending and self._sent is not None and now_ns - self._sent.at_ns > SILENCE_NS:
            self._stop("no poses sent")
        return self._next_text(now_ns)

    def warn(self, text: str) -> None:
        """Queue a warning about the link."""
        self._texts["link"] = WARNING, text

    def on_text_not_sent(self) -> None:
        """The text of `due_texts` could not be sent: queue it again. To be called before a newer text is queued."""
        if self._offered is not None:
            kind, severity, text = self._offered
            self._texts[kind] = severity, text
            self._offered = self._text_ns = None

    def _stop(self, reason: str) -> None:
        if self._sending:
            self._sending = False
            self._texts["output"] = CRITICAL, f"STOPPED: {reason}"

    def _update_reset_counter(self, pose: RelativePose, now_ns: int) -> None:
        last = self._sent
        if last is None or self._incremented:
            return
        if now_ns - last.at_ns > SILENCE_NS or pose.resets != last.resets or pose.track_id != last.track_id:
            self.reset_counter = (self.reset_counter + 1) % SEQUENCE
            self._incremented = True

    def _reason(self, kind: PoseMessage, pose: RelativePose, now_ns: int) -> RejectReason | None:
        if kind == "landing_target" or self._yaw == "cameras":
            reason = reject_reason(pose, now_ns, self._limits)
            if reason is None and kind != "landing_target":
                reason = yaw_reason(pose, self._limits)
        else:
            reason = position_reason(pose, now_ns, self._limits)
            if reason is None and self._yaw_reset:
                reason = RejectReason.ODOM_YAW_RESET
            own = self._attitude
            old = own is None or now_ns - own.arrival_ns > ATTITUDE_NS
            if reason is None and old and self._profile == "ardupilot":
                reason = RejectReason.NO_ATTITUDE
        if reason is None and self._sent is not None and pose.stamp_ns <= self._sent.stamp_ns:
            reason = RejectReason.NOT_NEWER
        return reason

    def _message(self, kind: PoseMessage, pose: RelativePose) -> Any:
        if kind != "landing_target" and self._yaw == "none":
            return self._position_message(kind, pose)
        if kind == "odometry":
            return odometry(pose, self.reset_counter, self._limits)
        if kind == "vision_position_estimate":
            return vision_position_estimate(pose, self.reset_counter)
        return landing_target(pose)

    def _position_message(self, kind: PoseMessage, pose: RelativePose) -> Any:
        own = self._attitude if self._profile == "ardupilot" else None
        if kind == "odometry":
            return position_odometry(pose, self.reset_counter, self._limits, own)
        assert own is not None  # PX4 has no VISION_POSITION_ESTIMATE
        return position_vision_estimate(pose, self.reset_counter, own)

    def _next_text(self, now_ns: int) -> list[Any]:
        if not self._texts or (self._text_ns is not None and 0 <= now_ns - self._text_ns < TEXT_NS):
            return []
        self._text_ns = now_ns
        kind: TextKind = next(kind for kind in get_args(TextKind) if kind in self._texts)
        severity, text = self._texts.pop(kind)
        self._offered = kind, severity, text
        data = f"grd: {text}".encode("ascii", "replace")[:TEXT_BYTES]
        return [dialect().MAVLink_statustext_message(severity, data)]

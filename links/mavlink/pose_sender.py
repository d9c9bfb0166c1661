"""Messages and texts to the autopilot about the poses: which, when, and with which reset counter. No socket, no clock.

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

from links.mavlink.gate import PoseLimits, RejectReason, reject_reason
from links.mavlink.pose_messages import landing_target, odometry, vision_position_estimate
from links.mavlink.transport.framing import SEQUENCE, dialect
from stages.messages import PoseState, RelativePose

PoseMessage = Literal["odometry", "vision_position_estimate", "landing_target"]
TextKind = Literal["output", "link", "state"]  # in order of priority; the newest text of each kind is kept

SILENCE_NS = 300_000_000  # the autopilot's timeout for poses
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

    def __init__(self, kinds: Sequence[PoseMessage], limits: PoseLimits, reset_counter: int = 0) -> None:
        self.rejected: Counter[RejectReason] = Counter()
        self.reset_counter = reset_counter % SEQUENCE
        self._kinds, self._limits = tuple(kinds), limits
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
        reason = reject_reason(pose, now_ns, self._limits)
        if reason is None and self._sent is not None and pose.stamp_ns <= self._sent.stamp_ns:
            reason = RejectReason.NOT_NEWER
        reason = reason or link_reason
        if reason is not None:
            self.rejected[reason] += 1
            if reason is not RejectReason.NOT_NEWER:  # a newer one was sent
                self._stop(reason.value)
            return []
        self._update_reset_counter(pose, now_ns)
        return [self._message(kind, pose) for kind in self._kinds]

    def on_sent(self, pose: RelativePose, now_ns: int) -> None:
        """A message of this pose was sent."""
        self._sent = SentPose(now_ns, pose.stamp_ns, pose.resets, pose.track_id)
        self._incremented = False
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

    def _message(self, kind: PoseMessage, pose: RelativePose) -> Any:
        if kind == "odometry":
            return odometry(pose, self.reset_counter, self._limits)
        if kind == "vision_position_estimate":
            return vision_position_estimate(pose, self.reset_counter)
        return landing_target(pose)

    def _next_text(self, now_ns: int) -> list[Any]:
        if not self._texts or (self._text_ns is not None and 0 <= now_ns - self._text_ns < TEXT_NS):
            return []
        self._text_ns = now_ns
        kind: TextKind = next(kind for kind in get_args(TextKind) if kind in self._texts)
        severity, text = self._texts.pop(kind)
        self._offered = kind, severity, text
        data = f"grd: {text}".encode("ascii", "replace")[:TEXT_BYTES]
        return [dialect().MAVLink_statustext_message(severity, data)]

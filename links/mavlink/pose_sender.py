"""What is said to the autopilot about the poses, and when: messages, texts, reset counter. No socket, no clock.

The reset counter changes (by one) with every jump of the pose, every other drone, and after every silence of ours that
the autopilot noticed, so that it begins anew from what comes instead of gating it. It starts anywhere: after our own
restart it should differ from what the autopilot heard before.

What is not sent is told: STATUSTEXT when sending stops (critical) and goes on (notice), and when the state changes. At
most one text each half second goes out, the newest of its kind, and none is lost that is still true.

Source: ours; ArduPilot AP_VisualOdom (300 ms health), PX4 EKF2 EV_MAX_INTERVAL (200 ms to start, 400 ms to stop).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

from links.mavlink.framing import SEQUENCE, dialect
from links.mavlink.gate import PoseLimits, RejectReason, reject_reason
from links.mavlink.pose_messages import landing_target, odometry, vision_position_estimate
from stages.messages import PoseState, RelativePose

Kind = Literal["odometry", "vision_position_estimate", "landing_target"]
Text = Literal["output", "line", "state"]  # of each kind the newest waits; the first goes first

SILENCE_NS = 300_000_000  # the autopilot takes us for gone
TEXT_NS = 500_000_000  # between two texts
TEXT_BYTES = 50  # STATUSTEXT's field
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY
SEVERITY = {PoseState.FULL: INFO, PoseState.COASTING: WARNING}  # of being in that state; all others: warning


@dataclass(frozen=True, slots=True)
class Sent:
    """The pose that went out last."""

    at_ns: int
    stamp_ns: int
    resets: int
    track_id: int


class PoseSender:
    """Turns poses into messages, or refuses them and says so. Ask for `texts` between them, some ten times a second."""

    def __init__(self, kinds: Sequence[Kind], limits: PoseLimits, reset_counter: int = 0) -> None:
        self.refused: Counter[RejectReason] = Counter()
        self.reset_counter = reset_counter % SEQUENCE
        self._kinds, self._limits = tuple(kinds), limits
        self._sent: Sent | None = None
        self._counted = False  # the counter has changed since `_sent`
        self._sending = False
        self._state: PoseState | None = None
        self._texts: dict[Text, tuple[int, str]] = {}  # severity and text, waiting
        self._text_ns: int | None = None
        self._offered: tuple[Text, int, str] | None = None  # by `texts`, last

    @property
    def sending(self) -> bool:
        """Whether poses are going out now."""
        return self._sending

    def speak(self, pose: RelativePose, now_ns: int, line: RejectReason | None = None) -> list[Any]:
        """Messages for one pose: those chosen; none where it, or `line`, is refused. Say `went_out` when they have."""
        if pose.state is not self._state:
            self._state = pose.state
            self._texts["state"] = SEVERITY.get(pose.state, WARNING), f"{pose.state.name}: {pose.reason}"
        why = reject_reason(pose, now_ns, self._limits)
        if why is None and self._sent is not None and pose.stamp_ns <= self._sent.stamp_ns:
            why = RejectReason.NOT_NEWER
        why = why or line
        if why is not None:
            self.refused[why] += 1
            if why is not RejectReason.NOT_NEWER:  # the newer one went out
                self._stop(why.value)
            return []
        self._count_reset(pose, now_ns)
        return [self._message(kind, pose) for kind in self._kinds]

    def went_out(self, pose: RelativePose, now_ns: int) -> None:
        """The messages of `speak` have left."""
        self._sent = Sent(now_ns, pose.stamp_ns, pose.resets, pose.track_id)
        self._counted = False
        if not self._sending:
            self._sending = True
            self._texts["output"] = NOTICE, "sending poses"

    def texts(self, now_ns: int) -> list[Any]:
        """The text that is due now, if any; notices when no pose has gone out for a while."""
        if self._sending and self._sent is not None and now_ns - self._sent.at_ns > SILENCE_NS:
            self._stop("no pose goes out")
        return self._due(now_ns)

    def warn(self, text: str) -> None:
        """Say something of the line."""
        self._texts["line"] = WARNING, text

    def unsaid(self) -> None:
        """The text of `texts` could not be sent: it waits again. To be said at once, before a newer one comes."""
        if self._offered is not None:
            kind, severity, text = self._offered
            self._texts[kind] = severity, text
            self._offered = self._text_ns = None

    def _stop(self, why: str) -> None:
        if self._sending:
            self._sending = False
            self._texts["output"] = CRITICAL, f"STOPPED: {why}"

    def _count_reset(self, pose: RelativePose, now_ns: int) -> None:
        last = self._sent
        if last is None or self._counted:
            return
        if now_ns - last.at_ns > SILENCE_NS or pose.resets != last.resets or pose.track_id != last.track_id:
            self.reset_counter = (self.reset_counter + 1) % SEQUENCE
            self._counted = True

    def _message(self, kind: Kind, pose: RelativePose) -> Any:
        if kind == "odometry":
            return odometry(pose, self.reset_counter, self._limits)
        if kind == "vision_position_estimate":
            return vision_position_estimate(pose, self.reset_counter)
        return landing_target(pose)

    def _due(self, now_ns: int) -> list[Any]:
        """The next text."""
        if not self._texts or (self._text_ns is not None and 0 <= now_ns - self._text_ns < TEXT_NS):
            return []
        self._text_ns = now_ns
        kind: Text = next(kind for kind in get_args(Text) if kind in self._texts)
        severity, text = self._texts.pop(kind)
        self._offered = kind, severity, text
        data = f"grd: {text}".encode("ascii", "replace")[:TEXT_BYTES]
        return [dialect().MAVLink_statustext_message(severity, data)]

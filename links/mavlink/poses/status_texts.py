"""STATUSTEXT about the output: which text, when, and short enough.

    output   "STOPPED: " and the reason (critical) as soon as poses stop, three times while they do, since a full radio
             link loses texts; "sending poses" (notice) after 1 s of them
    link     warnings about the link and the autopilot
    state    state of the pose and the first clause of its reason, once it has lasted for 1 s

At most one text in 2 s is sent, the newest of the most important kind; a text is kept until it was sent or replaced. A
text ends at a word within the 50 bytes of the field; run.log has all of it.

Source: ours; https://mavlink.io/en/messages/common.html#STATUSTEXT.
"""

from __future__ import annotations

import re
from collections.abc import Collection
from typing import Any, Literal, get_args

from links.mavlink.transport.framing import dialect
from stages.messages import PoseState

TextKind = Literal["output", "link", "state"]  # in order of priority

MIN_TEXT_INTERVAL_NS = 2_000_000_000  # minimum interval of texts
MIN_STATE_DURATION_NS = 1_000_000_000  # a state, or sending, is reported after it has lasted so long
STOPPED_REPEATS = 2  # of "STOPPED: "
TEXT_BYTES = 50  # size of STATUSTEXT's text field
PREFIX = "grd: "
CRITICAL, WARNING, NOTICE, INFO = 2, 4, 5, 6  # MAV_SEVERITY
CLAUSE = re.compile(r"[;:,]")


def fitted(text: str) -> bytes:
    """The text with its prefix as ASCII, cut after a word to fit the field."""
    data = f"{PREFIX}{text}".encode("ascii", "replace")
    if len(data) <= TEXT_BYTES:
        return data
    cut = data[: TEXT_BYTES + 1]
    return cut.rpartition(b" ")[0] if b" " in cut[len(PREFIX) :] else data[:TEXT_BYTES]


class StatusTexts:
    """Waiting texts. Call `due` about ten times per second."""

    def __init__(self, sufficient: Collection[PoseState] = (PoseState.FULL,)) -> None:
        """`sufficient`: states in which poses are sent; the others are warnings."""
        self._sufficient = frozenset(sufficient)
        self._waiting: dict[TextKind, tuple[int, str]] = {}  # severity and text
        self._text_ns: int | None = None
        self._offered: tuple[TextKind, int, str] | None = None  # the newest result of `due`
        self._state: tuple[PoseState, str, int] | None = None  # with the reason and the time of its start
        self._reported: PoseState | None = None
        self._sending_ns: int | None = None  # start of sending; None: not sending
        self._sending_reported = False
        self._stopped, self._repeats = "", 0  # newest "STOPPED: ", and how often it is still to be repeated

    def on_state(self, state: PoseState, reason: str, now_ns: int) -> None:
        """The state of the newest pose."""
        if self._state is None or self._state[0] is not state:
            self._state = state, CLAUSE.split(reason)[0], now_ns

    def on_sending(self, now_ns: int) -> None:
        """Poses are sent from now on."""
        self._sending_ns = now_ns

    def on_stopped(self, reason: str) -> None:
        """No poses are sent from now on."""
        self._sending_ns = None
        if self._sending_reported:
            self._sending_reported = False
            self._stopped, self._repeats = f"STOPPED: {reason}", STOPPED_REPEATS
            self._waiting["output"] = CRITICAL, self._stopped

    def warn(self, text: str) -> None:
        """Queue a warning about the link or the autopilot."""
        self._waiting["link"] = WARNING, text

    def due(self, now_ns: int) -> list[Any]:
        """The STATUSTEXT to send now, if any."""
        self._queue(now_ns)
        repeats = self._repeats > 0 and self._sending_ns is None
        if not (self._waiting or repeats):
            return []
        if self._text_ns is not None and 0 <= now_ns - self._text_ns < MIN_TEXT_INTERVAL_NS:
            return []
        if not self._waiting:
            self._waiting["output"] = CRITICAL, self._stopped
            self._repeats -= 1
        self._text_ns = now_ns
        kind: TextKind = next(kind for kind in get_args(TextKind) if kind in self._waiting)
        severity, text = self._waiting.pop(kind)
        self._offered = kind, severity, text
        return [dialect().MAVLink_statustext_message(severity, fitted(text))]

    def on_not_sent(self) -> None:
        """The text of `due` could not be sent: queue it again, unless a newer one replaced it."""
        if self._offered is not None:
            kind, severity, text = self._offered
            self._waiting.setdefault(kind, (severity, text))
            self._offered = self._text_ns = None

    def _queue(self, now_ns: int) -> None:
        sending_ns = self._sending_ns
        if sending_ns is not None and not self._sending_reported and now_ns - sending_ns >= MIN_STATE_DURATION_NS:
            self._sending_reported, self._repeats = True, 0
            self._waiting["output"] = NOTICE, "sending poses"
        if self._state is None:
            return
        state, reason, since_ns = self._state
        if state is not self._reported and now_ns - since_ns >= MIN_STATE_DURATION_NS:
            self._reported = state
            self._waiting["state"] = INFO if state in self._sufficient else WARNING, f"{state.name}: {reason}"

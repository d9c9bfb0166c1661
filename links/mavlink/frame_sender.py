"""Frames to the autopilot: packed, numbered, signed, sent, and kept as records.

Each pose is reported to `Independence` and to `SentState`, so that live, replay and a restart know of it.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from typing import Any

from flow.link import Record
from links.mavlink.poses.independence import POSES, Independence
from links.mavlink.poses.sent_state import SentState
from links.mavlink.transport.connection import Connection
from links.mavlink.transport.framing import dialect, packed
from links.mavlink.transport.signing import Signer

EARLIER_POSE = "ODOMETRY"  # of an earlier run
SENT, NOT_SENT, POSE_REJECTED = "sent", "not sent", "pose rejected"  # groups of the link's counters
SENT_RECORDS = 4096  # kept until `records` is called


class FrameSender:
    """Sends over one connection. Not thread-safe: the session holds its lock."""

    def __init__(
        self,
        connection: Connection,
        own: tuple[int, int],
        signer: Signer | None,
        now_ns: Callable[[], int],
        topic: str,
        independence: Independence,
        sent_state: SentState,
    ) -> None:
        self.sent: Counter[str] = Counter()  # by message
        self.not_sent: Counter[str] = Counter()  # the line was full or down
        self._connection, self._signer, self._now_ns, self._topic = connection, signer, now_ns, topic
        self._independence, self._sent_state = independence, sent_state
        self._mav = dialect().MAVLink(None, srcSystem=own[0], srcComponent=own[1])
        self._records: deque[Record] = deque(maxlen=SENT_RECORDS)

    def report_earlier(self) -> tuple[int, bytes | None] | None:
        """Report the newest pose of an earlier run; returns its time, and the frame odom in `map` then."""
        earlier = self._sent_state.take_earlier()
        if earlier is None:
            return None
        earlier_ns, pose, odom = earlier
        self._independence.on_sent(EARLIER_POSE, earlier_ns)
        self._records.append(Record(self._topic, self._now_ns(), earlier_ns, pose))
        return earlier_ns, odom

    def send(self, message: Any, odom: Callable[[], bytes | None] | None = None) -> bool:
        """Whether a message was sent; `odom`: of a pose, makes the frame odom in `map` (see SentState)."""
        now_ns = self._now_ns()
        if self._signer is not None:
            self._signer.sign_for(self._mav, now_ns)
        frame = packed(message, self._mav)
        kind = message.get_type()
        if not self._connection.send(frame):
            self.not_sent[kind] += 1
            return False
        self.sent[kind] += 1
        self._independence.on_sent(kind, now_ns)
        if kind in POSES and odom is not None:
            self._sent_state.on_sent(frame, now_ns, odom)
        self._records.append(Record(self._topic, now_ns, now_ns, frame))
        return True

    def records(self) -> list[Record]:
        """Records of the frames sent since the previous call."""
        records = list(self._records)
        self._records.clear()
        return records

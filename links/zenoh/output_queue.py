"""Send queue of one output to another host, and the thread that sends from it.

Zenoh is configured to block (BLOCK) when the connection is full, so messages wait in this queue, where old ones can be
dropped: `latest` keeps one message, `drop_oldest` up to `depth` and none beyond the edge's deadline, but always the
newest. Messages also wait while the other end has no subscriber. Small messages (of fixed size: fixes, poses, states)
are sent between two of Zenoh's fragments of a large message; an image does not delay them.
"""

from __future__ import annotations

import contextlib
import threading
from collections import deque
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from flow.message import Message, array_fields
from flow.remote.codec import encode
from flow.remote.codec_fields import CodecError
from links.clock.host_time import now_ns
from links.zenoh.connection import ZenohConnection
from links.zenoh.envelope import RUN, Envelope

if TYPE_CHECKING:
    import zenoh

WAKE_S = 0.2  # how often an empty queue checks whether it was closed
LISTENER_S = 0.02  # how often a queue with messages checks for a subscriber


@dataclass(slots=True)
class Counts:
    """Counters of a queue."""

    sent: int = 0
    sent_bytes: int = 0
    dropped: int = 0  # replaced by a newer one
    late: int = 0  # waited longer than the edge's deadline
    failed: int = 0  # not as its class declares


class OutputQueue:
    """Queue of one output to one host."""

    def __init__(self, key: str, message: type[Message], depth: int, deadline_ns: int) -> None:
        self.key = key
        self.counts = Counts()
        self.has_subscriber = False
        """Whether the other end has a subscriber."""
        self.status: str | None = None
        self._depth, self._deadline_ns = depth, deadline_ns
        self._small = not any(isinstance(dim, str) for _, _, shape in array_fields(message) for dim in shape.dims)
        self._waiting: deque[tuple[int, Message]] = deque()  # (time of `put`, message)
        self._changed = threading.Condition()
        self._number = 0  # number of the next message

    def put(self, message: Message) -> None:
        """Append a message; a full queue drops its oldest."""
        with self._changed:
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self.counts.dropped += 1
            self._waiting.append((now_ns(), message))
            self._changed.notify()

    def run(self, connection: ZenohConnection, closing: threading.Event) -> None:
        """Send until closed; runs in the queue's thread."""
        import zenoh

        while not closing.is_set():
            opened = connection.opened(WAKE_S)
            if opened is None:
                continue
            with contextlib.suppress(zenoh.ZError):  # the session has closed; the connection reports it
                publisher = self._publisher(opened.session)
                while not (closing.is_set() or opened.ended.is_set()):
                    self._send_one(publisher, closing)
            self.has_subscriber = False

    def _publisher(self, session: zenoh.Session) -> zenoh.Publisher:
        import zenoh

        return session.declare_publisher(
            self.key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH if self._small else zenoh.Priority.DATA,
            express=self._small,
        )

    def _send_one(self, publisher: zenoh.Publisher, closing: threading.Event) -> None:
        """Send the oldest message if there are one and a subscriber; otherwise wait."""
        with self._changed:
            has_message = self._changed.wait_for(lambda: bool(self._waiting), WAKE_S)
        self.has_subscriber = _has_subscriber(publisher)
        if not self.has_subscriber:
            closing.wait(LISTENER_S)
        elif has_message:
            self._send(publisher, self._take())

    def _send(self, publisher: zenoh.Publisher, message: Message) -> None:
        try:
            data = encode(message)
        except CodecError as error:
            self.counts.failed += 1
            self.status = str(error)
            return
        self._number += 1  # incremented before sending: a message lost with the connection leaves a gap
        publisher.put(data, attachment=Envelope(RUN, self._number - 1, now_ns(), message.stamp_ns).pack())
        self.counts.sent += 1
        self.counts.sent_bytes += len(data)

    def _take(self) -> Message:
        with self._changed:
            too_old_ns = now_ns() - self._deadline_ns
            while len(self._waiting) > 1 and self._waiting[0][0] < too_old_ns:
                self._waiting.popleft()
                self.counts.late += 1
            return self._waiting.popleft()[1]


def _has_subscriber(publisher: Any) -> bool:
    """Whether there is a subscriber. Zenoh 1.10 declares a bool; it is an object that is always true."""
    return publisher.matching_status.matching

"""One output's way to another host: what waits to be sent, and the thread that sends it.

Zenoh is told to wait (BLOCK) when the line is full, so what waits, waits here, where the newest can be had: `latest`
keeps one message, `drop_oldest` up to `depth` and none for longer than the edge's deadline, but always the newest.
While nobody listens at the other end they wait as well. Small messages (of a fixed size: fixes, poses, states) overtake
the others between two of Zenoh's fragments; a picture on the line does not hold them up.

Source: ours.
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
from links.host_time import now_ns
from links.zenoh.connection import Connection
from links.zenoh.wire import RUN, Envelope

if TYPE_CHECKING:
    import zenoh

WAKE_S = 0.2  # a lane without messages looks this often whether it was closed
LISTENER_S = 0.02  # and one with messages, whether somebody listens


@dataclass(slots=True)
class Counts:
    """What became of the messages of a lane."""

    sent: int = 0
    sent_bytes: int = 0
    dropped: int = 0  # a newer one took its place
    late: int = 0  # waited longer than the edge's deadline
    failed: int = 0  # not what its class declares


class Lane:
    """One output to one host."""

    def __init__(self, key: str, message: type[Message], depth: int, deadline_ns: int) -> None:
        self.key = key
        self.counts = Counts()
        self.heard = False
        """Whether somebody listens at the other end."""
        self.status: str | None = None
        self._depth, self._deadline_ns = depth, deadline_ns
        self._small = not any(isinstance(dim, str) for _, _, shape in array_fields(message) for dim in shape.dims)
        self._waiting: deque[tuple[int, Message]] = deque()  # (since when, message)
        self._changed = threading.Condition()
        self._number = 0  # of the next message

    def put(self, message: Message) -> None:
        """Let a message wait; a full lane drops its oldest."""
        with self._changed:
            if len(self._waiting) >= self._depth:
                self._waiting.popleft()
                self.counts.dropped += 1
            self._waiting.append((now_ns(), message))
            self._changed.notify()

    def send_on(self, connection: Connection, closing: threading.Event) -> None:
        """Send until closed; the lane's thread runs this."""
        import zenoh

        while not closing.is_set():
            opened = connection.opened(WAKE_S)
            if opened is None:
                continue
            with contextlib.suppress(zenoh.ZError):  # the session has closed; the connection says so
                publisher = self._publisher(opened.session)
                while not (closing.is_set() or opened.over.is_set()):
                    self._send_one(publisher, closing)
            self.heard = False

    def _publisher(self, session: zenoh.Session) -> zenoh.Publisher:
        import zenoh

        return session.declare_publisher(
            self.key,
            congestion_control=zenoh.CongestionControl.BLOCK,
            priority=zenoh.Priority.INTERACTIVE_HIGH if self._small else zenoh.Priority.DATA,
            express=self._small,
        )

    def _send_one(self, publisher: zenoh.Publisher, closing: threading.Event) -> None:
        """Send what waits first, when there is something and somebody listens; else wait a little."""
        with self._changed:
            anything = self._changed.wait_for(lambda: bool(self._waiting), WAKE_S)
        self.heard = _matching(publisher)
        if not self.heard:
            closing.wait(LISTENER_S)
        elif anything:
            self._send(publisher, self._take())

    def _send(self, publisher: zenoh.Publisher, message: Message) -> None:
        try:
            data = encode(message)
        except CodecError as error:
            self.counts.failed += 1
            self.status = str(error)
            return
        self._number += 1  # counted before it is sent: one that is lost with the line leaves a gap
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


def _matching(publisher: Any) -> bool:
    """Whether somebody listens. Zenoh 1.10 types this as bool; it is an object that is always true."""
    return publisher.matching_status.matching

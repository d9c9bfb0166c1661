"""Inbox: the queues of one node of a live run. Many threads put messages; one takes them in the order of putting.

Each port has its own bound, so that a flood on one edge drops nothing of another.

Source: ours.
"""

from __future__ import annotations

import select
import socket
import threading
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from flow.config.edge import QueueSettings
from flow.link import Readable
from flow.message import Message

WAKEUP_BYTES = 64  # more than wait at a time: one for each wait


class Item(NamedTuple):
    """One queued message."""

    order: int  # of putting, over all ports
    port: int
    number: int  # of the message among those of its output, from 0; a gap: messages were dropped
    arrival_ns: int
    message: Message


class Wakeup:
    """Wakes the thread that takes from one or several inboxes when a message arrives or an inbox closes."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self._someone_waits = False

    def wait(self, inboxes: Sequence[Inbox], timeout_s: float) -> None:
        """Wait until one of the inboxes has a message or is closed, at most `timeout_s`."""
        with self.changed:
            self._someone_waits = True
            self.changed.wait_for(lambda: any(inbox.has_work for inbox in inboxes), timeout_s)
            self._someone_waits = False

    def notify(self) -> None:
        """A message has arrived, or an inbox has closed. `changed` is held."""
        if self._someone_waits:
            self.changed.notify_all()


class PolledWakeup(Wakeup):
    """A wakeup of a thread that waits for files too."""

    def __init__(self) -> None:
        super().__init__()
        self._receiver, self._sender = socket.socketpair()
        self._receiver.setblocking(False)
        self._sender.setblocking(False)
        self._woken = False

    def wait(self, inboxes: Sequence[Inbox], timeout_s: float) -> None:
        """See Wakeup."""
        self.wait_for_files(inboxes, (), timeout_s)

    def wait_for_files(self, inboxes: Sequence[Inbox], files: Sequence[Readable], timeout_s: float) -> list[Readable]:
        """Wait for one of the inboxes or of the files; those files that are readable."""
        with self.changed:
            waits = timeout_s > 0.0 and not self._woken and not any(inbox.has_work for inbox in inboxes)
            self._someone_waits, self._woken = waits, False
        ready, _, _ = select.select([self._receiver, *files], [], [], timeout_s if waits else 0.0)
        with self.changed:
            self._someone_waits = False
        if self._receiver in ready:
            self._receiver.recv(WAKEUP_BYTES)
            ready.remove(self._receiver)
        return ready

    def notify(self) -> None:
        """See Wakeup."""
        if self._someone_waits:
            self._someone_waits = False
            self._sender.send(b"\0")

    def wake(self) -> None:
        """End the wait, or the next one."""
        with self.changed:
            self._woken = True
            self.notify()

    def close(self) -> None:
        """Close the sockets, as the thread ends."""
        with self.changed:
            self._someone_waits = False
            self._receiver.close()
            self._sender.close()


class Inbox:
    """Bounded queues of a node's ports, taken from as one. Inboxes of one thread share a wakeup."""

    def __init__(self, ports: Sequence[QueueSettings], wakeup: Wakeup | None = None) -> None:
        self._ports: list[deque[Item]] = [deque() for _ in ports]
        self._depths = [port.depth for port in ports]
        self._order = 0
        self.wakeup = wakeup or Wakeup()
        self._changed = self.wakeup.changed
        self._closed = False
        self._close_reported = False
        self.dropped = [0] * len(self._ports)
        """Messages of each port that were never taken."""

    def put(self, port: int, number: int, arrival_ns: int, message: Message) -> None:
        """Add a message. A full port drops its oldest."""
        with self._changed:
            queue = self._ports[port]
            if self._closed:
                self.dropped[port] += 1
                return
            if len(queue) >= self._depths[port]:
                queue.popleft()
                self.dropped[port] += 1
            queue.append(Item(self._order, port, number, arrival_ns, message))
            self._order += 1
            self.wakeup.notify()

    def take(self) -> Item | None:
        """The queued message that was put first; None: no message is queued."""
        if not any(self._ports):  # most often; only the caller takes, so it needs no lock
            return None
        with self._changed:
            queue = self._first()
            return None if queue is None else queue.popleft()

    def take_all(self) -> list[Item]:
        """All queued messages, in the order of putting."""
        with self._changed:
            items = sorted(item for queue in self._ports for item in queue)
            for queue in self._ports:
                queue.clear()
        return items

    def _first(self) -> deque[Item] | None:
        first: deque[Item] | None = None
        for queue in self._ports:
            if queue and (first is None or queue[0] < first[0]):
                first = queue
        return first

    def close(self) -> None:
        """Drop whatever is put from now on; queued messages can still be taken."""
        with self._changed:
            self._closed = True
            self.wakeup.notify()

    def clear(self) -> None:
        """Drop all queued messages."""
        with self._changed:
            for port, queue in enumerate(self._ports):
                self.dropped[port] += len(queue)
                queue.clear()
            self.wakeup.notify()

    @property
    def has_work(self) -> bool:
        """Whether a message is queued, or the inbox has closed (True once)."""
        if self._closed and not self._close_reported:
            self._close_reported = True
            return True
        return any(self._ports)

    @property
    def done(self) -> bool:
        """Whether it is closed and empty. Nothing is put after it has closed, so this needs no lock."""
        return self._closed and not any(self._ports)

    def waiting(self, port: int) -> int:
        """Number of queued messages of a port."""
        return len(self._ports[port])

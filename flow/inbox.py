"""An inbox: what waits for one node of a live run. Many threads put, one takes, in the order of putting over all ports.

Each port keeps to its own bound, so that a flood on one edge drops nothing of another.

Source: ours.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Sequence
from typing import NamedTuple

from flow.edge import Waiting
from flow.message import Message


class Item(NamedTuple):
    """One message that waits."""

    order: int  # of putting, over all ports
    port: int
    number: int  # of the message among those of its output, from 0: a gap is what was dropped
    arrival_ns: int
    message: Message


class Bell:
    """Wakes who takes, from one inbox or from several, when something comes in or an inbox closes."""

    def __init__(self) -> None:
        self.changed = threading.Condition()
        self.someone_waits = False

    def wait(self, inboxes: Sequence[Inbox], timeout_s: float) -> None:
        """Until one of the inboxes has a message or is closed, but no longer than that."""
        with self.changed:
            self.someone_waits = True
            self.changed.wait_for(lambda: any(inbox.rings for inbox in inboxes), timeout_s)
            self.someone_waits = False


class Inbox:
    """Bounded queues of a node's ports, taken from as one. Inboxes that one thread takes from share a bell."""

    def __init__(self, ports: Sequence[Waiting], bell: Bell | None = None) -> None:
        self._ports: list[deque[Item]] = [deque() for _ in ports]
        self._depths = [port.depth for port in ports]
        self._order = 0
        self.bell = bell or Bell()
        self._changed = self.bell.changed
        self._closed = False
        self._told = False  # that it is closed
        self.dropped = [0] * len(self._ports)
        """Messages of each port that were never taken."""

    def put(self, port: int, number: int, arrival_ns: int, message: Message) -> None:
        """Add a message. A full port drops its oldest."""
        with self._changed:
            waiting = self._ports[port]
            if self._closed:
                self.dropped[port] += 1
                return
            if len(waiting) >= self._depths[port]:
                waiting.popleft()
                self.dropped[port] += 1
            waiting.append(Item(self._order, port, number, arrival_ns, message))
            self._order += 1
            if self.bell.someone_waits:
                self._changed.notify_all()

    def take(self) -> Item | None:
        """The message put first of those that wait; None: none does."""
        with self._changed:
            port = self._first()
            return None if port is None else port.popleft()

    def take_all(self) -> list[Item]:
        """All that waits, in the order of putting."""
        with self._changed:
            items = sorted(item for port in self._ports for item in port)
            for port in self._ports:
                port.clear()
        return items

    def _first(self) -> deque[Item] | None:
        first: deque[Item] | None = None
        for port in self._ports:
            if port and (first is None or port[0] < first[0]):
                first = port
        return first

    def close(self) -> None:
        """Nothing more comes in: what is put from now on is dropped; what waits can still be taken."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

    def clear(self) -> None:
        """Drop all that waits."""
        with self._changed:
            for port, waiting in enumerate(self._ports):
                self.dropped[port] += len(waiting)
                waiting.clear()
            self._changed.notify_all()

    @property
    def rings(self) -> bool:
        """Whether who takes has something to do here: a message waits, or (said once) the inbox is closed."""
        if self._closed and not self._told:
            self._told = True
            return True
        return any(self._ports)

    @property
    def done(self) -> bool:
        """Closed and empty."""
        with self._changed:
            return self._closed and not any(self._ports)

    def waiting(self, port: int) -> int:
        """How many messages of a port wait now."""
        return len(self._ports[port])

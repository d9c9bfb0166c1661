"""Stages that yield (`yields: true`): on a host too slow for everything they take fewer pictures, and others lose less.

Of a picture's edge only the newest waits, so a stage that is slow there loses nothing that is missed for long; a queue
that runs over does. After each picture such a stage rests while a queue of a stage that does not yield is half full or
has dropped something: longer each time, up to MOST_S; then shorter each time, until it rests no more.

Source: ours; as TCP does it (Jacobson, Congestion avoidance and control, 1988), the other way round.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from flow.inbox import Inbox

FIRST_S, MOST_S = 0.05, 0.4
EASE = 0.7  # of the rest before
LEAST_S = 0.01  # less is none


class Queue(NamedTuple):
    """A port of a stage that does not yield, and how many messages may wait there."""

    name: str
    inbox: Inbox
    port: int
    depth: int


class Rest:
    """How long one thread rests after its next picture."""

    def __init__(self, queues: Sequence[Queue]) -> None:
        self._queues = queues
        self._dropped = 0
        self.rest_s = 0.0

    def next_s(self) -> float:
        """Ask after each picture."""
        dropped = sum(queue.inbox.dropped[queue.port] for queue in self._queues)
        if dropped > self._dropped or self.fullest() is not None:
            self.rest_s = min(max(FIRST_S, 2.0 * self.rest_s), MOST_S)
        else:
            self.rest_s *= EASE
            self.rest_s *= self.rest_s > LEAST_S
        self._dropped = dropped
        return self.rest_s

    def fullest(self) -> str | None:
        """A queue that is half full or more; None: none is."""
        return next((q.name for q in self._queues if 2 * q.inbox.waiting(q.port) >= q.depth), None)

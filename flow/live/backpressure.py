"""Backpressure on stages of low priority (`low_priority: true`): on a host too slow for all they take fewer images.

An edge of images keeps only the newest, so a slow stage of images misses nothing that matters for long. A queue that
overflows does lose messages. After each image a stage of low priority pauses while a queue of another stage is half
full or has dropped messages: each pause is twice as long as the one before, up to MAX_PAUSE_S. Then pauses shrink.

Source: ours; as TCP's congestion control (Jacobson, Congestion avoidance and control, 1988), with pauses instead of
rates.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

from flow.live.inbox import Inbox

FIRST_PAUSE_S, MAX_PAUSE_S = 0.05, 0.4
DECAY = 0.7  # of the pause, after an image without overload
MIN_PAUSE_S = 0.01  # a shorter pause is none


class MonitoredQueue(NamedTuple):
    """A port of a stage without low priority, and the depth of its queue."""

    name: str
    inbox: Inbox
    port: int
    depth: int


class Throttle:
    """The pauses of one thread after each image."""

    def __init__(self, queues: Sequence[MonitoredQueue]) -> None:
        self._queues = queues
        self._dropped = 0
        self.pause_s = 0.0

    def next_pause_s(self) -> float:
        """The pause after an image; call it once for each image."""
        dropped = sum(queue.inbox.dropped[queue.port] for queue in self._queues)
        if dropped > self._dropped or self.overloaded() is not None:
            self.pause_s = min(max(FIRST_PAUSE_S, 2.0 * self.pause_s), MAX_PAUSE_S)
        else:
            self.pause_s *= DECAY
            self.pause_s *= self.pause_s > MIN_PAUSE_S
        self._dropped = dropped
        return self.pause_s

    def overloaded(self) -> str | None:
        """A queue that is half full or more; None: no queue is."""
        return next((q.name for q in self._queues if 2 * q.inbox.waiting(q.port) >= q.depth), None)

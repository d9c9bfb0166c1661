"""A bounded box between the run and the logging thread: a live run never waits on it, a replay loses nothing.

Source: ours. Rerun's log() can block (a stalled viewer, a slow disk), so no stage may call it.
"""

from __future__ import annotations

import threading
import time
from collections import Counter, deque
from typing import Generic, TypeVar

T = TypeVar("T")

POLL_S = 0.05  # the taker looks this often: waking it for every message would cost the run more than the message


class Mailbox(Generic[T]):
    """Keep at most `size` items. Full: drop the oldest, or, when `lossless`, let `put` wait.

    A wait ends after `patience_s` even then: the taker is stalled, and dropping (counted) beats a hang.
    """

    def __init__(self, size: int, *, lossless: bool, patience_s: float) -> None:
        self._size = size
        self._lossless = lossless
        self._patience_s = patience_s
        self._stalled = False
        self._closed = False
        self._items: deque[tuple[str, T]] = deque()
        self._changed = threading.Condition()
        self.dropped: Counter[str] = Counter()  # by tag

    def put(self, tag: str, item: T) -> None:
        """Add an item; `tag` names it in the count of what was dropped."""
        with self._changed:
            if len(self._items) >= self._size and self._lossless and not self._stalled:
                self._changed.notify_all()
                self._stalled = not self._changed.wait_for(
                    lambda: len(self._items) < self._size or self._closed, self._patience_s
                )
            if self._closed:
                self.dropped[tag] += 1
                return
            if len(self._items) >= self._size:
                self.dropped[self._items.popleft()[0]] += 1
            self._items.append((tag, item))

    def take(self) -> list[tuple[str, T]] | None:
        """All items so far, oldest first; waits at most `POLL_S`. None: closed and empty."""
        with self._changed:
            deadline = time.monotonic() + POLL_S
            while not self._closed and len(self._items) < self._size:
                if not self._changed.wait(max(0.0, deadline - time.monotonic())):
                    break
            items = list(self._items)
            self._items.clear()
            self._stalled = False
            self._changed.notify_all()
            return None if self._closed and not items else items

    def close(self) -> None:
        """No more items: `put` counts them as dropped, `take` hands out the rest."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()

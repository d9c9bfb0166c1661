"""The thread of stages and of the sources that share it: one loop, as a replay is one.

A thread that waits for packets beside one that computes takes Python's lock from it for each packet, and both pay for
the change. Here the sources are asked between two messages of the stages.

Source: ours.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from flow.live.inbox import PolledWakeup
from flow.live.source import PolledSource, SourceRun
from flow.live.threads import WAIT_S, Shared, StageRun, StageThread

POLL_S = 0.002  # interval at which the sources are asked while messages are queued


class SharedThread(StageThread):
    """Runs stages, and listens to sources between their messages."""

    def __init__(
        self, name: str, stages: list[StageRun], sources: Sequence[SourceRun], wakeup: PolledWakeup, shared: Shared
    ) -> None:
        super().__init__(name, stages, wakeup, shared)
        self._sources = [PolledSource(source) for source in sources]
        self._poll_wakeup = wakeup

    def run(self) -> None:
        poll_s = 0.0
        while self._running or self._sources:
            if self.shared.stopping.is_set() and self._sources:
                for source in self._sources:
                    source.end()
                self._sources = []
            worked, now_s = self.step(), time.monotonic()
            if not worked or now_s >= poll_s:
                self._poll(0.0 if worked else WAIT_S, now_s)
                poll_s = time.monotonic() + POLL_S
        self._poll_wakeup.close()

    def wake(self) -> None:
        """Check at once whether the run stops; any thread may call this."""
        self._poll_wakeup.wake()

    def _poll(self, timeout_s: float, now_s: float) -> None:
        """Wait for messages and sources, at most so long, and take what the sources have."""
        files = [file for source in self._sources for file in source.files]
        due_s = min((source.due_s for source in self._sources), default=now_s + timeout_s)
        ready = self._poll_wakeup.wait_for_files(self._inboxes, files, max(0.0, min(timeout_s, due_s - now_s)))
        now_s = time.monotonic()
        for source in self._sources:
            if source.due_s <= now_s or any(file in ready for file in source.files):
                source.step()

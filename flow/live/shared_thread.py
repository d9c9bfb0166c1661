"""The thread of stages and of the sources that share it: one loop, as a replay is one.

A thread that waits for packets beside one that computes takes Python's lock from it for each packet, and each switch
costs CPU time in both. Here the sources are polled between two messages of the stages. So a stage that computes for
long delays them: packets then wait in the kernel's buffer (`net.core.rmem_max`), and the servo's worker stops the servo
when nothing polls it for half a second.

Source: ours.
"""

from __future__ import annotations

import time
from collections.abc import Sequence

from flow.live.inbox import PolledWakeup
from flow.live.source import PolledSource, SourceRun
from flow.live.threads import WAIT_S, Shared, StageRun, StageThread
from flow.ports import RunError, named

POLL_S = 0.002  # shortest interval of polls while messages are queued; the stages get at least as long as a poll took


class SharedThread(StageThread):
    """Runs stages, and listens to sources between their messages."""

    def __init__(
        self, name: str, stages: list[StageRun], sources: Sequence[SourceRun], wakeup: PolledWakeup, shared: Shared
    ) -> None:
        super().__init__(name, stages, wakeup, shared)
        self._sources = [PolledSource(source) for source in sources]
        self._poll_wakeup = wakeup

    def run(self) -> None:
        try:
            with named(self.name):
                self._loop()
        except RunError as error:
            self.shared.events.report(self.name, f"{error}: none of its stages and sources works any more")
        finally:
            self._end_sources()
            self._poll_wakeup.close()

    def _loop(self) -> None:
        poll_s = 0.0
        while self._running or self._sources:
            if self.shared.stopping.is_set():
                self._end_sources()
            worked, now_s = self.step(), time.monotonic()
            if not worked or now_s >= poll_s:
                took_s = self._poll(0.0 if worked else WAIT_S, now_s)
                poll_s = time.monotonic() + max(POLL_S, took_s)

    def _end_sources(self) -> None:
        for source in self._sources:
            source.end()
        self._sources = []

    def wake(self) -> None:
        """Check at once whether the run stops; any thread may call this."""
        self._poll_wakeup.wake()

    def _poll(self, timeout_s: float, now_s: float) -> float:
        """Wait for messages and sources, at most so long, and take what the sources have: for how long [s]."""
        files = [file for source in self._sources for file in source.files]
        due_s = min((source.due_s for source in self._sources), default=now_s + timeout_s)
        ready = self._poll_wakeup.wait_for_files(self._inboxes, files, max(0.0, min(timeout_s, due_s - now_s)))
        now_s = time.monotonic()
        for source in self._sources:
            if source.due_s <= now_s or any(file in ready for file in source.files):
                source.step()
        return time.monotonic() - now_s

"""The host's clock as a source: periodic ticks, so that a run continues when every sensor is silent.

A tick's stamp is its nominal time, its arrival the time when the thread woke up; on a busy machine they differ. Nominal
times are integer multiples of the period, like the stamps of fused poses, so that a pose does not wait for the next
tick. Missed ticks are skipped. A replay uses the recorded ticks.

Source: ours; `links.clock.host_time` (a step of the wall clock moves no tick).
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pydantic import Field

from flow.link import Record, Source, SourceSettings
from links.clock import host_time
from stages.messages import Tick


class ClockSettings(SourceSettings):
    """Settings of `Clock`."""

    topic: str = "/clock"
    rate_hz: float = Field(50.0, ge=0.1, le=1000)


class Clock(Source[ClockSettings]):
    """Ticks at `rate_hz`."""

    def __init__(self, settings: ClockSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._missed: int = 0

    @property
    def counters(self) -> dict[str, int]:
        """Ticks skipped because the machine was busy."""
        return {"missed": self._missed}

    def decode(self, record: Record) -> Tick:
        """The Tick of one record."""
        return Tick(stamp_ns=record.stamp_ns)

    @contextmanager
    def listen(self) -> Iterator[Iterator[Record]]:
        """Ticks from now on: `with clock.listen() as records`."""
        closed = threading.Event()
        try:
            yield self._ticks(closed)
        finally:
            closed.set()

    def _ticks(self, closed: threading.Event) -> Iterator[Record]:
        period_ns = round(1e9 / self.settings.rate_hz)
        due_ns = (host_time.now_ns() // period_ns + 1) * period_ns
        while not closed.wait(max(0, due_ns - host_time.now_ns()) * 1e-9):
            now_ns = host_time.now_ns()
            if now_ns < due_ns:
                continue
            missed = (now_ns - due_ns) // period_ns
            self._missed += missed
            due_ns += missed * period_ns
            yield Record(self.settings.topic, now_ns, due_ns, b"")
            due_ns += period_ns

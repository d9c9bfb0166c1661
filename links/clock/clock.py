"""The host's clock as a source: a tick so many times a second, so that a run goes on though every sensor is silent.

A tick's stamp is the moment that was meant, its arrival when the thread came to it; a busy machine makes them differ.
The moments are whole multiples of the period, as those of the fused poses are: a pose does not wait for the next tick.
Ticks that it missed altogether are left out, not made up for. A replay takes the recorded ticks.

Source: ours; links/host_time.py (a wall clock that is set moves no tick).
"""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from pydantic import Field

from flow.link import Record, Source, SourceSettings
from links import host_time
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
        """Ticks left out because the machine was busy."""
        return {"missed": self._missed}

    def decode(self, record: Record) -> Tick:
        """The time of a tick."""
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

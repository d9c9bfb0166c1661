"""The host's clock as a source: periodic ticks, so that a run continues when every sensor is silent.

A tick's stamp is its nominal time, its arrival the time when the thread woke up; on a busy machine they differ. Nominal
times are integer multiples of the period, like the stamps of fused poses, so that a pose does not wait for the next
tick. Missed ticks are skipped. A replay uses the recorded ticks.

Source: ours; `links.clock.host_time` (a step of the wall clock moves no tick).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any, ClassVar

from pydantic import Field

from flow.link import WAKE_S, PolledRecords, Record, Source, SourceSettings
from links.clock import host_time
from stages.messages import Tick


class ClockSettings(SourceSettings):
    """Settings of `Clock`."""

    topic: str = "/clock"
    rate_hz: float = Field(50.0, ge=0.1, le=1000)


class Clock(Source[ClockSettings]):
    """Ticks at `rate_hz`."""

    polled: ClassVar[bool] = True

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
    def listen(self) -> Iterator[PolledRecords]:
        """Ticks from now on: `with clock.listen() as records`."""
        ticks = Ticks(self.settings, self._count_missed)
        try:
            yield ticks
        finally:
            ticks.closed.set()

    def _count_missed(self, ticks: int) -> None:
        self._missed += ticks


class Ticks(PolledRecords):
    """Records of the ticks from now on."""

    def __init__(self, settings: ClockSettings, on_missed: Callable[[int], None]) -> None:
        super().__init__()
        self._topic, self._period_ns, self._on_missed = settings.topic, round(1e9 / settings.rate_hz), on_missed
        self._due_ns = (host_time.now_ns() // self._period_ns + 1) * self._period_ns

    @property
    def wait_s(self) -> float:
        """See PolledRecords."""
        return min(max(0, self._due_ns - host_time.now_ns()) * 1e-9, WAKE_S)

    def pending(self) -> list[Record]:
        """See PolledRecords."""
        now_ns = host_time.now_ns()
        if now_ns < self._due_ns:
            return []
        missed = (now_ns - self._due_ns) // self._period_ns
        self._on_missed(missed)
        stamp_ns = self._due_ns + missed * self._period_ns
        self._due_ns = stamp_ns + self._period_ns
        return [Record(self._topic, now_ns, stamp_ns, b"")]

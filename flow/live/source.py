"""A source in a live run: it listens, records, decodes and publishes, and reopens a link that fails.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager
from time import perf_counter_ns

from flow.link import LinkError, PolledRecords, Readable, Record, Source
from flow.live.report import LinkReport, LinkState
from flow.live.threads import Feed, RunThread, Shared
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, RunError, decoded, named

FIRST_PAUSE_S, MAX_PAUSE_S = 0.5, 8.0  # before a link is reopened; it doubles each time


class SourceRun:
    """A source through all its openings: what is done with its records, and with its failures."""

    def __init__(self, name: str, source: Source, outputs: dict[type[Message], Output[Feed]], shared: Shared) -> None:
        self.node, self.source, self.shared = name, source, shared
        self.compute = Latency()
        self.report = LinkReport()
        self.first_ns = self.last_ns = 0
        self.polled_s: float | None = None
        """When it was last polled, monotonic; None: a thread of its own waits for its records."""
        self.ended = threading.Event()
        self._outputs = outputs
        self._topics = source.replay_topics
        self._pause_s, self._records_before = FIRST_PAUSE_S, 0
        self._last_change = 0, 0.0  # number of records, and the time [s] when `silence` first found that number
        self._lock = threading.Lock()
        self._opened: AbstractContextManager[Iterator[Record]] | None = None

    def open(self) -> Iterator[Record]:
        """Open the link. LinkError: it cannot be opened."""
        self._records_before = self.report.records
        opened = self.source.listen()
        records = opened.__enter__()
        with self._lock:
            self._opened = opened
        self.report.openings += 1
        if self.report.openings == 1:
            self.report.state = LinkState.OPEN
        return records

    def close(self) -> None:
        """End the listening, from any thread."""
        with self._lock:
            opened, self._opened = self._opened, None
        if opened is not None:
            opened.__exit__(None, None, None)

    def failed(self, reason: str) -> float:
        """Report a link that has failed, unless the run stops; the pause before it is reopened [s]."""
        if self.shared.stopping.is_set():
            return 0.0
        self.report.reason = reason
        self.report.state = LinkState.FAILED
        gave_records = self.report.records > self._records_before
        self._pause_s = FIRST_PAUSE_S if gave_records else min(2 * self._pause_s, MAX_PAUSE_S)
        self.shared.events.report(self.node, f"{reason}; it is reopened")
        return self._pause_s

    def end(self) -> None:
        """The run stops."""
        self.report.state = LinkState.CLOSED
        self.ended.set()

    def silence(self) -> str | None:
        """A text when the source has sent records and then none for `silent_after_s`. One thread calls it regularly."""
        after_s, records, now_s = self.source.silent_after_s, self.report.records, time.monotonic()
        if records != self._last_change[0]:
            self._last_change = records, now_s
        if (
            after_s is None
            or not records
            or self.report.state is not LinkState.OPEN
            or now_s < self._last_change[1] + after_s
        ):
            return None
        if self.polled_s is not None and now_s > self.polled_s + after_s:
            return f"is not read for {after_s:g} s: a stage in its thread computes for too long"
        return f"has sent nothing for {after_s:g} s: is it powered, and its cable plugged in?"

    def take(self, record: Record) -> None:
        """Record it, decode it, and publish its messages."""
        if self.report.state is not LinkState.OPEN:
            self.report.state = LinkState.OPEN
            self.shared.events.report(self.node, "records arrive again", resolved=True)
        if record.arrival_ns < self.last_ns:  # a recording is read in the order of arrival, so it must not go back
            record = dataclasses.replace(record, arrival_ns=self.last_ns)
        self.first_ns, self.last_ns = self.first_ns or record.arrival_ns, record.arrival_ns
        self.report.records += 1
        self.shared.record(record)
        if record.topic not in self._topics:
            return
        begin = perf_counter_ns()
        try:
            for output, message in decoded(self.node, self.source, record, self._outputs, self.shared.strict):
                self.shared.publish(output, message, record.arrival_ns)
        except (LinkError, RunError) as error:
            self.report.undecoded += 1
            self.shared.events.report(self.node, str(error))
        self.compute.add(perf_counter_ns() - begin)


class SourceThread(RunThread):
    """Listens to one source, which may block."""

    def __init__(self, source: SourceRun, shared: Shared) -> None:
        super().__init__(f"listen {source.node}", shared)
        self.source = source

    def run(self) -> None:
        stopping = self.shared.stopping
        while not stopping.is_set():
            try:
                self._listen()
                reason = "its records have ended"
            except (LinkError, RunError) as error:
                reason = str(error)
            stopping.wait(self.source.failed(reason))
        self.source.end()

    def _listen(self) -> None:
        """From opening to the end of the records. LinkError, or RunError for what no link should raise."""
        with named(f"{self.source.node}.listen"):
            records = self.source.open()
            try:
                if self.shared.stopping.is_set():  # `close` came too early to close it
                    return
                for record in records:
                    if self.shared.stopping.is_set():
                        return
                    self.source.take(record)
            finally:
                self.source.close()


class PolledSource:
    """Listens to one source (`Source.polled`) in a thread that does other work too, one `step` after another."""

    def __init__(self, source: SourceRun) -> None:
        self.source = source
        self._records: PolledRecords | None = None
        self._due_s = 0.0  # of the next step, monotonic

    @property
    def files(self) -> Sequence[Readable]:
        """A step is due when one of these is readable."""
        return () if self._records is None else self._records.files

    @property
    def due_s(self) -> float:
        """A step is due at this time, monotonic."""
        return self._due_s

    def step(self) -> None:
        """Take what has arrived; open the link first if it is closed."""
        self.source.polled_s = time.monotonic()
        try:
            with named(f"{self.source.node}.listen"):
                if self._records is None:
                    records = self.source.open()
                    if not isinstance(records, PolledRecords):
                        kind = type(self.source.source).__name__
                        raise LinkError(f"{kind}.listen gives no PolledRecords: leave 'thread' out of its declaration")
                    self._records = records
                for record in self._records.pending():
                    self.source.take(record)
                self._due_s = time.monotonic() + self._records.wait_s
        except (LinkError, RunError) as error:
            self._close()
            self._due_s = time.monotonic() + self.source.failed(str(error))

    def end(self) -> None:
        """The run stops."""
        self._close()
        self.source.end()

    def _close(self) -> None:
        self._records = None
        try:
            with named(f"{self.source.node}.close"):
                self.source.close()
        except (LinkError, RunError) as error:
            self.source.shared.events.report(self.source.node, str(error))

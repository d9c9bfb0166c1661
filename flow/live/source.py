"""The thread of a source in a live run: it listens, records, decodes and publishes, and reopens a link that fails.

Source: ours.
"""

from __future__ import annotations

import dataclasses
import threading
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager
from time import perf_counter_ns

from flow.link import LinkError, Record, Source
from flow.live.report import LinkReport, LinkState
from flow.live.threads import Feed, RunThread, Shared
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, RunError, decoded, named

FIRST_PAUSE_S, MAX_PAUSE_S = 0.5, 8.0  # before a link is reopened; it doubles each time


class SourceThread(RunThread):
    """Listens to one source."""

    def __init__(self, name: str, source: Source, outputs: dict[type[Message], Output[Feed]], shared: Shared) -> None:
        super().__init__(f"listen {name}", shared)
        self.node, self.source = name, source
        self.compute = Latency()
        self.report = LinkReport()
        self.first_ns = self.last_ns = 0
        self._outputs = outputs
        self._last_change = 0, 0.0  # number of records, and the time [s] when `silence` first found that number
        self._lock = threading.Lock()
        self._opened: AbstractContextManager[Iterator[Record]] | None = None

    def run(self) -> None:
        stopping, pause_s = self.shared.stopping, FIRST_PAUSE_S
        while not stopping.is_set():
            records_before = self.report.records
            try:
                self._listen()
                reason = "its records have ended"
            except (LinkError, RunError) as error:
                reason = str(error)
            if stopping.is_set():
                break
            self.report.reason = reason
            self.report.state = LinkState.FAILED
            pause_s = FIRST_PAUSE_S if self.report.records > records_before else min(2 * pause_s, MAX_PAUSE_S)
            self.shared.events.report(self.node, f"{reason}; it is reopened")
            stopping.wait(pause_s)
        self.report.state = LinkState.CLOSED

    def close(self) -> None:
        """End the listening, from any thread."""
        with self._lock:
            opened, self._opened = self._opened, None
        if opened is not None:
            opened.__exit__(None, None, None)

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
        return f"has sent nothing for {after_s:g} s: is it powered, and its cable plugged in?"

    def _listen(self) -> None:
        """From opening to the end of the records. LinkError, or RunError for what no link should raise."""
        with named(f"{self.node}.listen"):
            opened = self.source.listen()
            records = opened.__enter__()
            with self._lock:
                self._opened = opened
            self.report.openings += 1
            if self.report.openings == 1:
                self.report.state = LinkState.OPEN
            try:
                if self.shared.stopping.is_set():  # `close` came too early to close it
                    return
                for record in records:
                    if self.shared.stopping.is_set():
                        return
                    self._take(record)
            finally:
                self.close()

    def _take(self, record: Record) -> None:
        if self.report.state is not LinkState.OPEN:
            self.report.state = LinkState.OPEN
            self.shared.events.report(self.node, "records arrive again", resolved=True)
        if record.arrival_ns < self.last_ns:  # a recording is read in the order of arrival, so it must not go back
            record = dataclasses.replace(record, arrival_ns=self.last_ns)
        self.first_ns, self.last_ns = self.first_ns or record.arrival_ns, record.arrival_ns
        self.report.records += 1
        self.shared.record(record)
        if record.topic != self.source.topic:
            return
        begin = perf_counter_ns()
        try:
            for output, message in decoded(self.node, self.source, record, self._outputs, self.shared.strict):
                self.shared.publish(output, message, record.arrival_ns)
        except (LinkError, RunError) as error:
            self.report.undecoded += 1
            self.shared.events.report(self.node, str(error))
        self.compute.add(perf_counter_ns() - begin)

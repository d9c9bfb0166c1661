"""The threads of a live run that take messages: of stages, sinks and taps. Those of sources: `flow.live_source`.

Source: ours.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter_ns
from typing import NamedTuple

from flow.consumption import OrderLog
from flow.inbox import Bell, Inbox, Item
from flow.incidents import Incidents
from flow.link import Link, LinkError, Record, Tap
from flow.live_report import EdgeCount
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, RunError, call, named
from flow.stage_life import StageLife
from flow.taps import Digest
from flow.yielding import MOST_S, Rest

WAIT_S = 0.2  # a thread that waits looks this often whether the run has stopped
SENT_S = 0.05  # what a link sent by itself is fetched this often
TAP_S = 0.05  # a tap looks this often: waking it for every message would cost the run more than the message


class Feed(NamedTuple):
    """Where an output's messages go: a port of an inbox."""

    inbox: Inbox
    port: int


@dataclass(slots=True)
class Shared:
    """What all threads of a run use."""

    now_ns: Callable[[], int]
    incidents: Incidents
    recorders: Sequence[Tap]
    digest: Digest | None
    strict: bool
    stopping: threading.Event = field(default_factory=threading.Event)

    def send(self, output: Output[Feed], message: Message, arrival_ns: int) -> None:
        """Hand a message to all that take it. Each output is sent by one thread only."""
        number = output.count
        output.count += 1
        if self.digest is not None:
            self.digest.see(output.name, message, arrival_ns)
        for inbox, port in output.feeds:
            inbox.put(port, number, arrival_ns, message)

    def keep(self, record: Record) -> None:
        """Hand a record to the recorders."""
        for recorder in self.recorders:
            try:
                recorder.record(record)
            except LinkError as error:
                self.incidents.report("recording", str(error))


class Worker(threading.Thread):
    """A thread of the run; it does not keep the process alive."""

    def __init__(self, name: str, shared: Shared) -> None:
        super().__init__(name=name, daemon=True)
        self.shared = shared


class StageRun:
    """One stage with its inbox, while its thread works."""

    def __init__(
        self,
        life: StageLife,
        inbox: Inbox,
        counts: list[EdgeCount],
        order: OrderLog | None,
        shared: Shared,
        gave_up: Callable[[], None],
    ) -> None:
        """`gave_up` is called when the stage has, once."""
        self.life, self.inbox = life, inbox
        self._tell_gave_up = gave_up
        self.ended = threading.Event()
        self._ports = [(count.edge.port, count) for count in counts]
        self._order, self._shared = order, shared

    def take(self, item: Item) -> None:
        """One message, and what the stage gives for it."""
        if self._order is not None:
            self._order.add(item.port, item.number)
        port, count = self._ports[item.port]
        for output, message in self.life.take(port, item.message, item.arrival_ns):
            self._shared.send(output, message, item.arrival_ns)
        count.done(self._shared.now_ns() - item.arrival_ns)
        if self.life.gave_up:
            self.end()

    def takes_newest(self, port: int) -> bool:
        """Whether only the newest message waits there, as of pictures."""
        return self._ports[port][1].edge.waiting.policy == "latest"

    def end(self) -> None:
        """It takes nothing any more. What it still holds goes out, unless it gave up."""
        self.inbox.close()
        self.inbox.clear()
        if not self.life.gave_up:
            if self._order is not None:
                self._order.add_finish()
            for output, message in self.life.finish():
                self._shared.send(output, message, self.life.last_ns)
        else:
            self._tell_gave_up()
        self.ended.set()


class StageThread(Worker):
    """Works for one stage, or for several that share a thread: what is nearest to the end of the line first."""

    def __init__(self, name: str, stages: list[StageRun], bell: Bell, shared: Shared, rest: Rest | None = None) -> None:
        """`stages`: producers before consumers, all with this bell. `rest`: of stages that yield."""
        super().__init__(f"stage {name}", shared)
        self.stages, self._bell, self._rest = stages, bell, rest

    def run(self) -> None:
        inboxes = [stage.inbox for stage in self.stages]
        working = self.stages[::-1]
        while working:
            for stage in working:
                item = stage.inbox.take()
                if item is not None:
                    stage.take(item)
                    if self._rest is not None and stage.takes_newest(item.port):
                        self._lie_down(stage.life.name, self._rest)
                    break
                if stage.inbox.done:
                    if not stage.ended.is_set():
                        stage.end()
                    working = [other for other in working if other is not stage]
                    break
            else:
                self._bell.wait(inboxes, WAIT_S)

    def _lie_down(self, stage: str, rest: Rest) -> None:
        """After a picture, for as long as others need it."""
        full = rest.fullest()
        rest_s = rest.next_s()
        if rest_s >= MOST_S:
            most = f", {full} most" if full else ""
            self.shared.incidents.report(stage, f"takes fewer pictures: this host is too slow for all{most}")
        if rest_s > 0.0:
            self.shared.stopping.wait(rest_s)


class SinkThread(Worker):
    """Hands messages to a link that sends, and what it sent to the recorders."""

    def __init__(self, name: str, link: Link, inbox: Inbox, counts: list[EdgeCount], shared: Shared) -> None:
        super().__init__(f"send {name}", shared)
        self.node, self.link, self.inbox, self.counts = name, link, inbox, counts
        self.compute = Latency()
        self.failures = 0
        self.ended = threading.Event()
        self._orphaned: deque[tuple[str, str]] = deque()

    def orphan(self, port: str, stage: str) -> None:
        """The stage behind a port has given up; any thread may say so."""
        self._orphaned.append((port, stage))

    def run(self) -> None:
        handlers = [(f"{self.node}.{c.edge.port}", getattr(self.link, f"on_{c.edge.port}")) for c in self.counts]
        done = False
        while not done:
            orphaned = len(self._orphaned)  # looked at first: what those stages gave is all in the inbox then
            item = self.inbox.take()
            if item is None and not orphaned:
                done = self.inbox.done
                if not done:
                    self.inbox.bell.wait([self.inbox], SENT_S)
            try:
                if item is not None:
                    begin = perf_counter_ns()
                    call(*handlers[item.port], item.message, item.arrival_ns)
                    self.compute.add(perf_counter_ns() - begin)
                    self.counts[item.port].done(self.shared.now_ns() - item.arrival_ns)
                if item is None and orphaned:
                    port, stage = self._orphaned.popleft()
                    with named(f"{self.node}.orphaned"):
                        done_about_it = self.link.orphaned(port)
                    if done_about_it is not None:
                        self.shared.incidents.report(self.node, f"'{stage}' works no more: {done_about_it}")
                with named(f"{self.node}.sent"):
                    for record in self.link.sent():
                        self.shared.keep(record)
            except (LinkError, RunError) as error:
                self.failures += 1
                self.shared.incidents.report(self.node, str(error))
        self.ended.set()


class TapThread(Worker):
    """Shows one tap what it wants to see, as fast as the tap can; what is too much for it is dropped and counted."""

    def __init__(self, name: str, tap: Tap, inbox: Inbox, outputs: list[str], shared: Shared) -> None:
        super().__init__(f"tap {name}", shared)
        self.node, self.tap, self.inbox = name, tap, inbox
        self._outputs = outputs
        self._pause = threading.Event()

    def run(self) -> None:
        while not self.inbox.done:
            for _, port, _, arrival_ns, message in self.inbox.take_all():
                output = self._outputs[port]
                try:
                    with named(f"{self.node}.see({output})"):
                        self.tap.see(output, message, arrival_ns)
                except (LinkError, RunError) as error:
                    self.shared.incidents.report(self.node, str(error))
            self._pause.wait(TAP_S)

    def end(self) -> None:
        """See what waits, and nothing more."""
        self.inbox.close()
        self._pause.set()

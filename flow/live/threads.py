"""The threads of a live run that take messages: of stages, sinks and taps. Those of sources: `flow.live.source`.

Source: ours.
"""

from __future__ import annotations

import math
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter_ns
from typing import NamedTuple

from flow.events import Events
from flow.link import Link, LinkError, Record, Tap
from flow.live.backpressure import MAX_PAUSE_S, Throttle
from flow.live.inbox import Inbox, Item, Wakeup
from flow.live.input_order import OrderLog
from flow.live.report import EdgeCount
from flow.live.supervised_stage import SupervisedStage
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, RunError, call, named
from flow.taps import Digest

WAIT_S = 0.2  # the longest wait of a stage's thread, which then checks whether the run has stopped
SENT_S = 0.05  # interval at which a sink's own records are fetched
TAP_S = 0.05  # interval at which a tap takes its messages: a wakeup for each would cost more than the message
RESTING_MS = 1000.0  # so does a stage's thread if no deadline of its inputs is shorter than this


class Feed(NamedTuple):
    """Where an output's messages go: a port of an inbox."""

    inbox: Inbox
    port: int


@dataclass(slots=True)
class Shared:
    """What all threads of a run use."""

    now_ns: Callable[[], int]
    events: Events
    recorders: Sequence[Tap]
    digest: Digest | None
    strict: bool
    stopping: threading.Event = field(default_factory=threading.Event)

    def publish(self, output: Output[Feed], message: Message, arrival_ns: int) -> None:
        """Put a message into every inbox that its output feeds. Only one thread may publish on an output."""
        number = output.count
        output.count += 1
        if self.digest is not None:
            self.digest.see(output.name, message, arrival_ns)
        for inbox, port in output.feeds:
            inbox.put(port, number, arrival_ns, message)

    def record(self, record: Record) -> None:
        """Hand a record to the recorders."""
        for recorder in self.recorders:
            try:
                recorder.record(record)
            except LinkError as error:
                self.events.report("recording", str(error))


class RunThread(threading.Thread):
    """A thread of the run; it does not keep the process alive."""

    def __init__(self, name: str, shared: Shared) -> None:
        super().__init__(name=name, daemon=True)
        self.shared = shared


class StageRun:
    """One stage with its inbox, run by a `StageThread`."""

    def __init__(
        self,
        stage: SupervisedStage,
        inbox: Inbox,
        counts: list[EdgeCount],
        order: OrderLog | None,
        shared: Shared,
        on_failed: Callable[[], None],
    ) -> None:
        """`on_failed` is called when the stage was replaced by a fresh one, or switched off."""
        self.stage, self.inbox = stage, inbox
        self.ended = threading.Event()
        self._ports = [(count.edge.port, count) for count in counts]
        self._order, self._shared, self._on_failed = order, shared, on_failed
        self._restarts = 0

    def take(self, item: Item) -> None:
        """Hand the stage one message, and publish what it gives for it."""
        if self._order is not None:
            self._order.add(item.port, item.number)
        port, count = self._ports[item.port]
        for output, message in self.stage.take(port, item.message, item.arrival_ns):
            self._shared.publish(output, message, item.arrival_ns)
        count.done(self._shared.now_ns() - item.arrival_ns)
        if self.stage.switched_off:
            self.end()
        elif self.stage.restarts != self._restarts:
            self._restarts = self.stage.restarts
            self._on_failed()

    @property
    def deadline_ms(self) -> float:
        """Shortest deadline of its inputs."""
        return min((count.edge.queue.deadline_ms for _, count in self._ports), default=math.inf)

    def takes_newest(self, port: int) -> bool:
        """Whether only the newest message waits there, as of images."""
        return self._ports[port][1].edge.queue.policy == "latest"

    def end(self) -> None:
        """Take no more messages, and publish what the stage gives as it finishes, unless it is switched off."""
        self.inbox.close()
        self.inbox.clear()
        if self.stage.switched_off:
            self._on_failed()
        else:
            if self._order is not None:
                self._order.add_finish()
            for output, message in self.stage.finish():
                self._shared.publish(output, message, self.stage.last_ns)
        self.ended.set()


class StageThread(RunThread):
    """Runs one stage, or several that share the thread: consumers before producers."""

    def __init__(
        self, name: str, stages: list[StageRun], wakeup: Wakeup, shared: Shared, throttle: Throttle | None = None
    ) -> None:
        """`stages`: producers before consumers, all with this wakeup. `throttle`: of stages with low priority."""
        super().__init__(f"stage {name}", shared)
        self.stages, self._wakeup, self._throttle = stages, wakeup, throttle
        self._inboxes = [stage.inbox for stage in stages]
        self._running = stages[::-1]
        self._rests = min((stage.deadline_ms for stage in stages), default=0.0) >= RESTING_MS

    def run(self) -> None:
        while self._running:
            if not self.step():
                self.wait()

    def wait(self) -> None:
        """Wait for messages."""
        if self._rests:
            time.sleep(TAP_S)
        else:
            self._wakeup.wait(self._inboxes, WAIT_S)

    def step(self) -> bool:
        """One message of one stage. False: no message is queued."""
        for stage in self._running:
            item = stage.inbox.take()
            if item is not None:
                stage.take(item)
                if self._throttle is not None and stage.takes_newest(item.port):
                    self._pause(stage.stage.name, self._throttle)
                return True
            if stage.inbox.done:
                if not stage.ended.is_set():
                    stage.end()
                self._running = [other for other in self._running if other is not stage]
                return True
        return False

    def _pause(self, stage: str, throttle: Throttle) -> None:
        """After an image, for as long as other stages need it."""
        queue = throttle.overloaded()
        pause_s = throttle.next_pause_s()
        if pause_s >= MAX_PAUSE_S:
            most = f", {queue} most" if queue else ""
            self.shared.events.report(stage, f"takes fewer images: this host is too slow for all stages{most}")
        if pause_s > 0.0:
            self.shared.stopping.wait(pause_s)


class SinkThread(RunThread):
    """Hands messages to a sink, and what it sent to the recorders."""

    def __init__(self, name: str, link: Link, inbox: Inbox, counts: list[EdgeCount], shared: Shared) -> None:
        super().__init__(f"send {name}", shared)
        self.node, self.link, self.inbox, self.counts = name, link, inbox, counts
        self.compute = Latency()
        self.failures = 0
        self.ended = threading.Event()
        self._failed: deque[tuple[str, SupervisedStage]] = deque()

    def upstream_failed(self, port: str, stage: SupervisedStage) -> None:
        """The stage behind a port restarts or is switched off; any thread may call this."""
        self._failed.append((port, stage))

    def run(self) -> None:
        handlers = [(f"{self.node}.{c.edge.port}", getattr(self.link, f"on_{c.edge.port}")) for c in self.counts]
        done = False
        while not done:
            failed = bool(self._failed)  # read before the inbox: what those stages gave is all in the inbox then
            item = self.inbox.take()
            if item is None and not failed:
                done = self.inbox.done
                if not done:
                    self.inbox.wakeup.wait([self.inbox], SENT_S)
            try:
                if item is not None:
                    begin = perf_counter_ns()
                    call(*handlers[item.port], item.message, item.arrival_ns)
                    self.compute.add(perf_counter_ns() - begin)
                    self.counts[item.port].done(self.shared.now_ns() - item.arrival_ns)
                if item is None and failed:
                    self._upstream_failed(*self._failed.popleft())
                with named(f"{self.node}.sent"):
                    for record in self.link.sent():
                        self.shared.record(record)
            except (LinkError, RunError) as error:
                self.failures += 1
                self.shared.events.report(self.node, str(error))
        self.ended.set()

    def _upstream_failed(self, port: str, stage: SupervisedStage) -> None:
        off = stage.switched_off
        with named(f"{self.node}.upstream_{'lost' if off else 'restarted'}"):
            reaction = self.link.upstream_lost(port) if off else self.link.upstream_restarted(port)
        if reaction is not None:
            text = f"is switched off: {reaction}" if off else f"restarts: {reaction}"
            self.shared.events.report(self.node, f"'{stage.name}' {text}")


class TapThread(RunThread):
    """Hands one tap the messages that it wants; those that it is too slow for are dropped and counted."""

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
                    self.shared.events.report(self.node, str(error))
            self._pause.wait(TAP_S)

    def end(self) -> None:
        """Hand over the queued messages, and no more."""
        self.inbox.close()
        self._pause.set()

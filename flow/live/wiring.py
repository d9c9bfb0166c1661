"""A graph's nodes wired to threads for a live run.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flow.config.edge import Edge, QueueSettings, default_queue
from flow.config.node_spec import NodeSpec
from flow.events import EventMessage
from flow.graph import Graph
from flow.link import Link, Source, Tap
from flow.live.backpressure import MonitoredQueue, Throttle
from flow.live.inbox import Inbox, PolledWakeup, Wakeup
from flow.live.input_order import OrderLog
from flow.live.report import EdgeCount, EdgeReport, EdgeStatus, edge_report
from flow.live.shared_thread import SharedThread
from flow.live.source import SourceRun, SourceThread
from flow.live.supervised_stage import SupervisedStage
from flow.live.threads import Feed, Shared, SinkThread, StageRun, StageThread, TapThread
from flow.message import Message
from flow.ports import Output, RunError
from flow.remote.stage_process import Processes
from flow.stage import Stage, output_ports

TAP_IMAGES = 8  # in a tap's queue: more would take much memory, fewer would lose some of each burst


@dataclass(slots=True)
class LiveEdge:
    """One edge: its queue, its counts, and the output of its status."""

    inbox: Inbox
    port: int
    count: EdgeCount
    status: Output[Feed]

    def report(self) -> EdgeReport:
        """All counts so far."""
        return edge_report(self.count, self.inbox.dropped[self.port])

    def is_monitored(self, graph: Graph) -> bool:
        """Whether its queue throttles stages of low priority: it drops messages to a stage without low priority."""
        edge = self.count.edge
        consumer = graph.nodes[edge.consumer]
        return consumer.kind == "stages" and not consumer.low_priority and edge.queue.policy == "drop_oldest"

    def queue(self) -> MonitoredQueue:
        """Its queue, for a throttle."""
        return MonitoredQueue(self.count.edge.name, self.inbox, self.port, self.count.edge.queue.depth)

    def publish_status(self, now_ns: int) -> None:
        """Send the taps an `EdgeStatus`."""
        message = EdgeStatus(
            stamp_ns=now_ns,
            lag_ms=self.count.newest_lag_ns / 1e6,
            dropped=self.inbox.dropped[self.port],
            missed=self.count.missed,
            waiting=self.inbox.waiting(self.port),
        )
        for inbox, port in self.status.feeds:
            inbox.put(port, 0, now_ns, message)


class Wiring:
    """All threads of a run, not yet started, and what connects them."""

    def __init__(self, graph: Graph, taps: Sequence[Tap], shared: Shared) -> None:
        self.sources: list[SourceRun] = []
        self.source_threads: list[SourceThread] = []
        self.stages: list[StageRun] = []  # producers before consumers
        self.stage_threads: list[StageThread] = []
        self.shared_threads: list[SharedThread] = []  # of stages and sources
        self.sinks: list[SinkThread] = []
        self.taps: list[TapThread] = []
        self.orders: list[OrderLog] = []
        self.edges: dict[str, LiveEdge] = {}
        self.links: dict[str, Link] = {}  # taps by their class
        self.outputs: dict[str, dict[type[Message], Output[Feed]]] = {}
        self.processes = Processes()
        self._events: Output[Feed] = Output("run.events", [])
        self._shared = shared
        with_sources = {spec.thread for spec in graph.nodes.values() if spec.kind == "links" and spec.thread}
        self._wakeups: dict[str, Wakeup] = {thread: PolledWakeup() for thread in with_sources}
        for spec in graph.nodes.values():
            outputs = output_ports(spec.cls)
            self.outputs[spec.name] = {message: Output(f"{spec.name}.{name}", []) for name, message in outputs.items()}
        for spec in graph.nodes.values():
            self._add_node(spec, [edge for edge in graph.edges if edge.consumer == spec.name])
        thread_of = {spec.name: spec.thread for spec in graph.nodes.values()}
        throttled = {spec.thread for spec in graph.nodes.values() if spec.low_priority}
        queues = [edge.queue() for edge in self.edges.values() if edge.is_monitored(graph)]
        for thread, wakeup in self._wakeups.items():
            runs = [run for run in self.stages if thread_of[run.stage.name] == thread]
            if isinstance(wakeup, PolledWakeup):
                sources = [source for source in self.sources if thread_of[source.node] == thread]
                self.shared_threads.append(SharedThread(thread, runs, sources, wakeup, shared))
            else:
                throttle = Throttle(queues) if thread in throttled else None
                self.stage_threads.append(StageThread(thread, runs, wakeup, shared, throttle))
        self.stage_threads += self.shared_threads
        for tap in taps:
            self.links[type(tap).__name__.lower()] = tap
            self._add_tap(tap)

    def publish_event(self, event: EventMessage) -> None:
        """Hand an event to the taps that want it; any thread may call this."""
        for inbox, port in self._events.feeds:
            inbox.put(port, 0, event.stamp_ns, event)

    def _add_node(self, spec: NodeSpec, edges: list[Edge]) -> None:
        wakeup = self._wakeups.setdefault(spec.thread, Wakeup()) if issubclass(spec.cls, Stage) else None
        inbox, counts = Inbox([edge.queue for edge in edges], wakeup), [EdgeCount(edge) for edge in edges]
        for port, (edge, count) in enumerate(zip(edges, counts, strict=True)):
            self.outputs[edge.producer][edge.message].feeds.append(Feed(inbox, port))
            self.edges[edge.name] = LiveEdge(inbox, port, count, Output(f"run.{edge.name}", []))
        if issubclass(spec.cls, Stage):
            self._add_stage(spec, inbox, counts)
        elif not issubclass(spec.cls, Tap):
            self._add_link(spec, inbox, counts)

    def _add_stage(self, spec: NodeSpec, inbox: Inbox, counts: list[EdgeCount]) -> None:
        shared, order = self._shared, None
        if shared.recorders:
            order = OrderLog(spec.name, [count.edge.port for count in counts])
            self.orders.append(order)
        build = self.processes.build if spec.process else NodeSpec.build
        report = self._reporter(spec.name)
        stage = SupervisedStage(spec, self.outputs[spec.name], report, strict=shared.strict, build=build)
        self.stages.append(StageRun(stage, inbox, counts, order, shared, lambda: self._failed(stage)))

    def _failed(self, stage: SupervisedStage) -> None:
        """Notify the sinks that a stage feeds that it restarts, or is switched off."""
        for edge in self.edges.values():
            if edge.count.edge.producer == stage.name:
                for sink in self.sinks:
                    if sink.node == edge.count.edge.consumer:
                        sink.upstream_failed(edge.count.edge.port, stage)

    def _reporter(self, name: str) -> Callable[[str, RunError], None]:
        def report(reaction: str, error: RunError) -> None:
            self._shared.events.report(name, f"{error}; {reaction}")

        return report

    def _add_link(self, spec: NodeSpec, inbox: Inbox, counts: list[EdgeCount]) -> None:
        shared, link = self._shared, spec.build()
        assert isinstance(link, Link)
        self.links[spec.name] = link
        if isinstance(link, Source):
            if type(link).listen is Source.listen:
                shared.events.report(spec.name, f"{type(link).__name__} cannot run live: it gives nothing")
            else:
                self.sources.append(SourceRun(spec.name, link, self.outputs[spec.name], shared))
                if not spec.thread:
                    self.source_threads.append(SourceThread(self.sources[-1], shared))
        if counts or type(link).sent is not Link.sent:
            self.sinks.append(SinkThread(spec.name, link, inbox, counts, shared))

    def _add_tap(self, tap: Tap) -> None:
        """A tap's inbox, with a port for each output that it wants, each edge's status and the events."""
        wanted = [(kind, out) for outs in self.outputs.values() for kind, out in outs.items() if tap.wants(kind)]
        if tap.wants(EdgeStatus):
            wanted += [(EdgeStatus, edge.status) for edge in self.edges.values()]
        if tap.wants(EventMessage):
            wanted.append((EventMessage, self._events))
        if not wanted:
            return
        queues = [default_queue(kind) for kind, _ in wanted]
        inbox = Inbox([QueueSettings("drop_oldest", TAP_IMAGES) if q.policy == "latest" else q for q in queues])
        for port, (_, output) in enumerate(wanted):
            output.feeds.append(Feed(inbox, port))
        names = [output.name for _, output in wanted]
        self.taps.append(TapThread(type(tap).__name__.lower(), tap, inbox, names, self._shared))

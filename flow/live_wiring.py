"""A graph's nodes wired to threads for a live run: who listens, who works, who sends, who looks on.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

from flow.consumption import OrderLog
from flow.edge import Edge, Waiting, usual_waiting
from flow.graph import Graph
from flow.inbox import Bell, Inbox
from flow.incidents import IncidentTold
from flow.link import Link, Source, Tap
from flow.live_report import EdgeCount, EdgeReport, EdgeStatus, edge_report
from flow.live_source import SourceThread
from flow.live_threads import Feed, Shared, SinkThread, StageRun, StageThread, TapThread
from flow.message import Message
from flow.node_spec import NodeSpec
from flow.ports import Output, RunError
from flow.stage import Stage, output_ports
from flow.stage_life import StageLife
from flow.stage_process import Processes
from flow.yielding import Queue, Rest

TAP_PICTURES = 8  # that wait for a tap: more would be much memory, fewer would lose some of each burst


@dataclass(slots=True)
class LiveEdge:
    """One edge: where its messages wait, what its consumer counts, and the taps that are told of it."""

    inbox: Inbox
    port: int
    count: EdgeCount
    status: Output[Feed]

    def report(self) -> EdgeReport:
        """All counts so far."""
        return edge_report(self.count, self.inbox.dropped[self.port])

    def runs_over(self, graph: Graph) -> bool:
        """Whether what waits here is lost when it is too much, to a stage that does not yield."""
        consumer = graph.nodes[self.count.edge.consumer]
        return consumer.kind == "stages" and not consumer.yields and self.count.edge.waiting.policy == "drop_oldest"

    def queue(self) -> Queue:
        """For those who yield to it."""
        return Queue(self.count.edge.name, self.inbox, self.port, self.count.edge.waiting.depth)

    def tell(self, now_ns: int) -> None:
        """Send the taps how the edge does."""
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
    """All threads of a run, not yet started, and what lies between them."""

    def __init__(self, graph: Graph, taps: Sequence[Tap], shared: Shared) -> None:
        self.sources: list[SourceThread] = []
        self.stages: list[StageRun] = []  # producers before consumers
        self.stage_threads: list[StageThread] = []
        self.sinks: list[SinkThread] = []
        self.taps: list[TapThread] = []
        self.orders: list[OrderLog] = []
        self.edges: dict[str, LiveEdge] = {}
        self.links: dict[str, Link] = {}  # taps by their class
        self.outputs: dict[str, dict[type[Message], Output[Feed]]] = {}
        self.processes = Processes()
        self._incidents: Output[Feed] = Output("run.incidents", [])
        self._shared = shared
        self._bells: dict[str, Bell] = {}  # by thread
        for spec in graph.nodes.values():
            outputs = output_ports(spec.cls)
            self.outputs[spec.name] = {message: Output(f"{spec.name}.{name}", []) for name, message in outputs.items()}
        for spec in graph.nodes.values():
            self._add_node(spec, [edge for edge in graph.edges if edge.consumer == spec.name])
        names = {spec.name: spec.thread for spec in graph.nodes.values()}
        yielding = {spec.thread for spec in graph.nodes.values() if spec.yields}
        queues = [edge.queue() for edge in self.edges.values() if edge.runs_over(graph)]
        for thread, bell in self._bells.items():
            runs = [run for run in self.stages if names[run.life.name] == thread]
            rest = Rest(queues) if thread in yielding else None
            self.stage_threads.append(StageThread(thread, runs, bell, shared, rest))
        for tap in taps:
            self.links[type(tap).__name__.lower()] = tap
            self._add_tap(tap)

    def tell_incident(self, told: IncidentTold) -> None:
        """Hand an incident to the taps that want it; any thread may."""
        for inbox, port in self._incidents.feeds:
            inbox.put(port, 0, told.stamp_ns, told)

    def _add_node(self, spec: NodeSpec, edges: list[Edge]) -> None:
        bell = self._bells.setdefault(spec.thread, Bell()) if issubclass(spec.cls, Stage) else None
        inbox, counts = Inbox([edge.waiting for edge in edges], bell), [EdgeCount(edge) for edge in edges]
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
        life = StageLife(spec, self.outputs[spec.name], self._teller(spec.name), strict=shared.strict, build=build)
        self.stages.append(StageRun(life, inbox, counts, order, shared, lambda: self._orphan(spec.name)))

    def _orphan(self, stage: str) -> None:
        """Links that a stage fed learn that it has given up."""
        for edge in self.edges.values():
            if edge.count.edge.producer == stage:
                for sink in self.sinks:
                    if sink.node == edge.count.edge.consumer:
                        sink.orphan(edge.count.edge.port, stage)

    def _teller(self, name: str) -> Callable[[str, RunError], None]:
        def tell(done: str, error: RunError) -> None:
            self._shared.incidents.report(name, f"{error}; {done}")

        return tell

    def _add_link(self, spec: NodeSpec, inbox: Inbox, counts: list[EdgeCount]) -> None:
        shared, link = self._shared, spec.build()
        assert isinstance(link, Link)
        self.links[spec.name] = link
        if isinstance(link, Source):
            if type(link).listen is Source.listen:
                shared.incidents.report(spec.name, f"{type(link).__name__} cannot run live: it stays silent")
            else:
                self.sources.append(SourceThread(spec.name, link, self.outputs[spec.name], shared))
        if counts or type(link).sent is not Link.sent:
            self.sinks.append(SinkThread(spec.name, link, inbox, counts, shared))

    def _add_tap(self, tap: Tap) -> None:
        """A tap's inbox with a port for each output that it wants to see, each edge's status, and the incidents."""
        wanted = [(kind, out) for outs in self.outputs.values() for kind, out in outs.items() if tap.wants(kind)]
        if tap.wants(EdgeStatus):
            wanted += [(EdgeStatus, edge.status) for edge in self.edges.values()]
        if tap.wants(IncidentTold):
            wanted.append((IncidentTold, self._incidents))
        if not wanted:
            return
        usual = [usual_waiting(kind) for kind, _ in wanted]
        inbox = Inbox([Waiting("drop_oldest", TAP_PICTURES) if w.policy == "latest" else w for w in usual])
        for port, (_, output) in enumerate(wanted):
            output.feeds.append(Feed(inbox, port))
        names = [output.name for _, output in wanted]
        self.taps.append(TapThread(type(tap).__name__.lower(), tap, inbox, names, self._shared))

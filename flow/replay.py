"""The deterministic runner: one thread, events in the order of one heap, as fast as possible.

An event is keyed by (arrival, rank, port, sequence): arrival of the record that caused it, rank of the node that takes
it (producers before consumers), index of the port, and one running number. Two replays of one recording take the same
steps in the same order, so their messages hash to the same value.

A record that a source cannot decode (`LinkError`) is told and left out, as in a live run. Where a source gives nothing
else, in HOPELESS records or in the whole recording, this is not its recording, and the replay ends with that error.

Source: ours; after openpilot's process replay.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from heapq import heappop, heappush
from time import perf_counter_ns
from typing import Any

from flow.graph import Graph
from flow.incidents import Incident, Incidents
from flow.link import RUN_TOPICS, LinkError, Record, Source, Tap
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, admit, call
from flow.stage import Node, Stage, input_ports, output_ports

HOPELESS = 1000  # records refused, of a source that gave nothing yet: it will not


@dataclass(slots=True)
class NodeReport:
    """What one node did in a run."""

    calls: int
    compute: Latency


@dataclass(slots=True)
class RunReport:
    """What a run did."""

    records: int = 0
    first_ns: int = 0
    last_ns: int = 0
    events: int = 0
    messages: dict[str, int] = field(default_factory=dict[str, int])  # output -> how many
    unwired_topics: Counter[str] = field(default_factory=Counter[str])  # records that no source takes
    nodes: dict[str, NodeReport] = field(default_factory=dict[str, NodeReport])
    incidents: list[Incident] = field(default_factory=list[Incident])
    counters: dict[str, dict[str, int]] = field(default_factory=dict[str, dict[str, int]])  # as links and stages count


class _Port:
    """One input port of one running node, bound to its handler."""

    __slots__ = ("compute", "handler", "index", "name", "outputs", "rank")

    def __init__(
        self,
        name: str,
        rank: int,
        index: int,
        handler: Callable[[Any], Any],
        outputs: dict[type[Message], Output[_Port]],
        compute: Latency,
    ) -> None:
        self.name, self.rank, self.index, self.handler = name, rank, index, handler
        self.outputs, self.compute = outputs, compute


class Replay:
    """A graph's nodes wired together, fed with records one by one: `feed` each record, then `finish`.

    Taps see every message as it leaves its output. Sinks are not called: a replay sends nothing out.
    Sources' and stages' messages are checked against their declared arrays once per output, and always with `strict`.
    """

    def __init__(self, graph: Graph, taps: Sequence[Tap] = (), *, strict: bool = False) -> None:
        self.report = RunReport()
        self._taps, self._strict = tuple(taps), strict
        self._heap: list[tuple[int, int, int, int, _Port, Any]] = []
        self._sequence = 0
        self._incidents = Incidents(lambda: self.report.last_ns)
        self._refusals: dict[str, LinkError] = {}  # by source, the first of each
        self._refused: Counter[str] = Counter()  # how many
        self.nodes: dict[str, Node] = {spec.name: spec.build() for spec in graph.nodes.values()}
        self._outputs: dict[str, dict[type[Message], Output[_Port]]] = {}
        for name, node in self.nodes.items():
            ports = output_ports(type(node))
            self._outputs[name] = {message: Output(f"{name}.{output}", []) for output, message in ports.items()}
            self.report.nodes[name] = NodeReport(0, Latency())
        self._topics: dict[str, _Port] = {}
        self._finishers: list[_Port] = []
        for rank, (name, node) in enumerate(self.nodes.items()):
            if isinstance(node, Source):
                self._topics[node.topic] = self._port(name, "decode", 0, 0, node.decode)
            if isinstance(node, Stage):
                self._finishers.append(self._port(name, "finish", rank, 0, lambda _, node=node: node.finish()))
        for edge in graph.edges:
            node = self.nodes[edge.consumer]
            if isinstance(node, Stage):
                order = list(input_ports(type(node))).index(edge.port)
                rank = list(self.nodes).index(edge.consumer) + 1
                port = self._port(edge.consumer, edge.port, rank, order, getattr(node, f"on_{edge.port}"))
                self._outputs[edge.producer][edge.message].feeds.append(port)

    def _port(self, node: str, port: str, rank: int, index: int, handler: Callable[[Any], Any]) -> _Port:
        compute = self.report.nodes[node].compute
        return _Port(f"{node}.{port}", rank, index, handler, self._outputs[node], compute)

    def feed(self, record: Record) -> None:
        """Take one record in and run everything that follows from it."""
        report = self.report
        report.records += 1
        report.first_ns = report.first_ns or record.arrival_ns
        report.last_ns = record.arrival_ns
        port = self._topics.get(record.topic)
        if port is None:
            if not record.topic.startswith(RUN_TOPICS):
                report.unwired_topics[record.topic] += 1
            return
        try:
            given = self._run(port, record.arrival_ns, record)
        except LinkError as error:
            source = port.name.partition(".")[0]
            self._refusals.setdefault(source, error)
            self._refused[source] += 1
            if self._refused[source] >= HOPELESS and not self._gave(source):
                raise
            self._incidents.report(source, str(error))
            return
        self._send(port, record.arrival_ns, given)
        heap = self._heap
        while heap:
            arrival_ns, _, _, _, port, message = heappop(heap)
            self._send(port, arrival_ns, self._run(port, arrival_ns, message))

    def _gave(self, source: str) -> bool:
        """Whether a source has told anything yet."""
        return any(output.count for output in self._outputs[source].values())

    def finish(self) -> RunReport:
        """Let every stage give out what it still holds; producers first. LinkError of a source that gave nothing."""
        for source, error in self._refusals.items():
            if not self._gave(source):
                raise error
        for port in self._finishers:
            last_ns = self.report.last_ns
            self._send(port, last_ns, self._run(port, last_ns, None))
            while self._heap:
                arrival_ns, _, _, _, consumer, message = heappop(self._heap)
                self._send(consumer, arrival_ns, self._run(consumer, arrival_ns, message))
        for outputs in self._outputs.values():
            self.report.messages.update({output.name: output.count for output in outputs.values()})
        for node in self.report.nodes.values():
            node.calls = node.compute.count
        self.report.incidents = self._incidents.all
        self.report.counters = {name: told for name, node in self.nodes.items() if (told := dict(node.counters))}
        return self.report

    def _run(self, port: _Port, arrival_ns: int, message: Any) -> tuple[Message, ...]:
        """What a port gives for a message."""
        self.report.events += 1
        begin = perf_counter_ns()
        given = call(port.name, port.handler, message, arrival_ns)
        port.compute.add(perf_counter_ns() - begin)
        return given

    def _send(self, port: _Port, arrival_ns: int, given: tuple[Message, ...]) -> None:
        """To all that take what a port gave."""
        for item in given:
            output = admit(port.name, port.outputs, item, self._strict)
            output.count += 1
            for tap in self._taps:
                tap.see(output.name, item, arrival_ns)
            for feed in output.feeds:
                self._sequence += 1
                heappush(self._heap, (arrival_ns, feed.rank, feed.index, self._sequence, feed, item))


def replay(graph: Graph, records: Iterable[Record], taps: Sequence[Tap] = (), *, strict: bool = False) -> RunReport:
    """Run a graph over records in order of arrival. Taps must be open; the caller closes them. RunError, LinkError."""
    runner = Replay(graph, taps, strict=strict)
    for record in records:
        runner.feed(record)
    return runner.finish()

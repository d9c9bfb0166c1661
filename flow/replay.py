"""The deterministic runner: events in the order of one heap, as fast as possible.

An event is keyed by (arrival, rank, port, sequence): arrival of the record that caused it, rank of the node that takes
it (producers before consumers), index of the port, and one running number. Two replays of one recording take the same
steps in the same order, so their messages hash to the same value.

Some nodes may run in other processes, ahead of this runner (`RemoteNodes`, `flow.subprocess_replay`). What they give
for a record takes the position that their own steps have in the heap, by their ranks: outputs, order and report are
those of one process.

A record that a source cannot decode (`LinkError`) is told and left out, as in a live run. Where a source gives nothing
else, in HOPELESS records or in the whole recording, this is not its recording, and the replay ends with that error.

Source: ours; after openpilot's process replay.
"""

from __future__ import annotations

import gc
from collections import Counter
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import contextmanager
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
from flow.remote_nodes import Refusal, RemoteFailure, RemoteNodes, RemoteOutputs
from flow.stage import Node, Stage, input_ports
from flow.taps import Digest

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

    Taps see every message that they want as it leaves its output. Sinks are not called: a replay sends nothing out.
    Sources' and stages' messages are checked against their declared arrays once per output, and always with `strict`.
    """

    def __init__(
        self, graph: Graph, taps: Sequence[Tap] = (), *, strict: bool = False, remote: RemoteNodes | None = None
    ) -> None:
        """`remote`: nodes that other processes run; a digest among the taps receives the hashes of their outputs."""
        self.report = RunReport()
        self._strict, self._remote = strict, remote
        self._digests = [tap for tap in taps if isinstance(tap, Digest)]
        self._heap: list[tuple[int, int, int, int, _Port | None, Any]] = []  # no port: from a remote node
        self._sequence = 0
        self._incidents = Incidents(lambda: self.report.last_ns)
        self._refusals: dict[str, Refusal] = {}  # by source, the first of each
        self._refused: Counter[str] = Counter()  # how many
        self.running = ""
        """The port whose message was taken last."""
        remote_nodes = remote.nodes if remote else frozenset[str]()
        self.nodes: dict[str, Node] = {
            spec.name: spec.build() for spec in graph.nodes.values() if spec.name not in remote_nodes
        }
        self._ranks = {name: rank for rank, name in enumerate(graph.nodes, 1)}
        self._outputs: dict[str, dict[type[Message], Output[_Port]]] = {name: {} for name in graph.nodes}
        for name, output, message in graph.outputs():
            hashed_there = self._digests if name in remote_nodes else ()
            seen_by = tuple(tap.see for tap in taps if tap.wants(message) and tap not in hashed_there)
            self._outputs[name][message] = Output(f"{name}.{output}", [], seen_by)
        self._by_name = {output.name: output for outputs in self._outputs.values() for output in outputs.values()}
        self.report.nodes = {name: NodeReport(0, Latency()) for name in graph.nodes}
        self._topics: dict[str, _Port] = {}
        self._finishers: list[tuple[str, _Port | None]] = []  # None: of a remote node
        for name, spec in graph.nodes.items():
            node = self.nodes.get(name)
            if isinstance(node, Source):
                self._topics[node.topic] = self._port(name, "decode", 0, node.decode)
            if isinstance(node, Stage):
                self._finishers.append((name, self._port(name, "finish", 0, lambda _, node=node: node.finish())))
            elif node is None and issubclass(spec.cls, Stage):
                self._finishers.append((name, None))
        for edge in graph.edges:
            node = self.nodes.get(edge.consumer)
            if isinstance(node, Stage):
                order = list(input_ports(type(node))).index(edge.port)
                port = self._port(edge.consumer, edge.port, order, getattr(node, f"on_{edge.port}"))
                self._outputs[edge.producer][edge.message].feeds.append(port)

    def _port(self, node: str, port: str, index: int, handler: Callable[[Any], Any]) -> _Port:
        compute = self.report.nodes[node].compute
        return _Port(f"{node}.{port}", self._ranks[node], index, handler, self._outputs[node], compute)

    def feed(self, record: Record) -> None:
        """Take one record in and run everything that follows from it."""
        report = self.report
        report.records += 1
        report.first_ns = report.first_ns or record.arrival_ns
        report.last_ns = record.arrival_ns
        port = self._topics.get(record.topic)
        if port is None:
            if self._remote is not None and record.topic in self._remote.topics:
                self._add_remote(self._remote.outputs_of(record.topic), record.arrival_ns)
                self._settle()
            elif not record.topic.startswith(RUN_TOPICS):
                report.unwired_topics[record.topic] += 1
            return
        try:
            given = self._run(port, record.arrival_ns, record)
        except LinkError as error:
            source = port.name.partition(".")[0]
            self._refusals.setdefault(source, Refusal(record.arrival_ns, error))
            self._refused[source] += 1
            if self._refused[source] >= HOPELESS and not self._gave(source):
                raise
            self._incidents.report(source, str(error))
            return
        self._send(port, record.arrival_ns, given)
        self._settle()

    def deliver(self, node: str, port: str, message: Message, arrival_ns: int) -> None:
        """Hand a stage a message that no node of this graph gave, and run everything that follows from it."""
        handler = getattr(self.nodes[node], f"on_{port}")
        target = self._port(node, port, 0, handler)
        self._send(target, arrival_ns, self._run(target, arrival_ns, message))
        self._settle()

    def _settle(self) -> None:
        """Run all that follows from what was sent."""
        heap = self._heap
        while heap:
            arrival_ns, _, _, _, port, message = heappop(heap)
            if port is None:
                self._give_remote(message, arrival_ns)
            else:
                self._send(port, arrival_ns, self._run(port, arrival_ns, message))

    def _add_remote(self, outputs: RemoteOutputs, arrival_ns: int) -> None:
        """Put what remote nodes gave at its position in the heap."""
        for name, message in outputs.messages:
            self._sequence += 1
            output = self._by_name[name]
            rank = self._ranks[name.partition(".")[0]]
            heappush(self._heap, (arrival_ns, rank, -1, self._sequence, None, (output, message)))
        if (failure := outputs.failure) is not None:
            self._sequence += 1
            heappush(self._heap, (arrival_ns, self._ranks[failure.node], -1, self._sequence, None, failure))

    def _give_remote(self, given: tuple[Output[_Port], Message | None] | RemoteFailure, arrival_ns: int) -> None:
        """Hand on a remote node's message, or raise what it raised."""
        if isinstance(given, RemoteFailure):
            raise given.error from given.cause
        output, message = given
        if message is None:
            output.count += 1
        else:
            self._give(output, message, arrival_ns)

    def _gave(self, source: str) -> bool:
        """Whether a source has given any message yet."""
        return any(output.count for output in self._outputs[source].values())

    def finish(self) -> RunReport:
        """Let every stage give out what it still holds; producers first. LinkError of a source that gave nothing."""
        refusals = self.sources_without_data()
        if self._remote is not None:
            refusals += self._remote.end(self.report.last_ns)
        if refusals:
            raise min(refusals, key=lambda refusal: refusal.arrival_ns).error
        for _ in self.finishing():
            pass
        return self.sum_up()

    def sources_without_data(self) -> list[Refusal]:
        """The first refusal of each source that gave nothing but refusals."""
        return [refusal for source, refusal in self._refusals.items() if not self._gave(source)]

    def finishing(self) -> Iterator[str]:
        """Finish stage after stage; each one's name when all that follows from its end has been run."""
        last_ns = self.report.last_ns
        for name, port in self._finishers:
            if port is not None:
                self._send(port, last_ns, self._run(port, last_ns, None))
            elif self._remote is not None:
                self._add_remote(self._remote.finish(name), last_ns)
            self._settle()
            yield name

    def sum_up(self) -> RunReport:
        """The report, when all have finished."""
        report = self.report
        report.messages = {name: output.count for name, output in self._by_name.items()}
        report.incidents = self._incidents.all
        counters = self.counters()
        for partition in self._remote.reports() if self._remote is not None else ():
            report.events += partition.events
            report.nodes |= {name: NodeReport(latency.count, latency) for name, latency in partition.compute.items()}
            report.incidents += partition.incidents
            counters |= partition.counters
            for digest in self._digests:
                digest.join(partition.hashes)
        for node in report.nodes.values():
            node.calls = node.compute.count
        report.incidents.sort(key=lambda incident: incident.first_ns)
        report.counters = {name: counts for name in report.nodes if (counts := counters.get(name))}
        return report

    def counters(self) -> dict[str, dict[str, int]]:
        """Each node's counters."""
        return {name: dict(node.counters) for name, node in self.nodes.items()}

    def _run(self, port: _Port, arrival_ns: int, message: Any) -> tuple[Message, ...]:
        """What a port gives for a message."""
        self.report.events += 1
        self.running = port.name
        begin = perf_counter_ns()
        given = call(port.name, port.handler, message, arrival_ns)
        port.compute.add(perf_counter_ns() - begin)
        return given

    def _send(self, port: _Port, arrival_ns: int, given: tuple[Message, ...]) -> None:
        """To all that take what a port gave."""
        for item in given:
            self._give(admit(port.name, port.outputs, item, self._strict), item, arrival_ns)

    def _give(self, output: Output[_Port], message: Message, arrival_ns: int) -> None:
        """A message to all that take it."""
        output.count += 1
        for see in output.seen_by:
            see(output.name, message, arrival_ns)
        for feed in output.feeds:
            self._sequence += 1
            heappush(self._heap, (arrival_ns, feed.rank, feed.index, self._sequence, feed, message))


def replay(graph: Graph, records: Iterable[Record], taps: Sequence[Tap] = (), *, strict: bool = False) -> RunReport:
    """Run a graph over records in order of arrival. Taps must be open; the caller closes them. RunError, LinkError."""
    with modules_at_rest():
        runner = Replay(graph, taps, strict=strict)
        for record in records:
            runner.feed(record)
        return runner.finish()


@contextmanager
def modules_at_rest() -> Generator[None]:
    """What is in memory by now, 170 000 objects of modules, is not searched for garbage (that took 4 % of a run)."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()

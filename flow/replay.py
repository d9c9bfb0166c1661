"""The deterministic runner: one thread, every step in the order of one heap, as fast as possible.

A step hands one message to one port. Its key in the heap is (arrival, rank, port, sequence): arrival of the record that
caused it, rank of the consumer (producers before consumers), index of the port, a running number. So two replays of one
recording take the same steps in the same order, and their outputs have the same hash.

Some nodes may run in other processes, ahead of this runner (`RemoteNodes`, `flow.subprocess_replay`). What they give
for a record is put into the heap where their own steps would be, by their ranks. Outputs, order and report are those of
one process.

A record that a source cannot decode (`LinkError`) is reported and skipped, as in a live run. The replay ends with that
error when a source decodes none of MAX_REFUSALS records, or of the whole recording: it is not this source's recording.

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

from flow.counters import Counters
from flow.events import Event, Events
from flow.graph import Graph
from flow.link import RUN_TOPICS, LinkError, Record, Source, Tap
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, admit, call
from flow.remote.nodes import Refusal, RemoteFailure, RemoteNodes, RemoteOutputs
from flow.stage import Node, Stage, input_ports
from flow.taps import Digest

MAX_REFUSALS = 1000  # records that a source could not decode, before its first message


@dataclass(slots=True)
class NodeReport:
    """The calls of one node in a run."""

    calls: int
    compute: Latency


@dataclass(slots=True)
class RunReport:
    """A run in numbers."""

    records: int = 0
    first_ns: int = 0
    last_ns: int = 0
    steps: int = 0  # messages and records handed to ports
    messages: dict[str, int] = field(default_factory=dict[str, int])  # number, by output
    unwired_topics: Counter[str] = field(default_factory=Counter[str])  # number of records that no source takes
    nodes: dict[str, NodeReport] = field(default_factory=dict[str, NodeReport])
    events: list[Event] = field(default_factory=list[Event])
    counters: dict[str, Counters] = field(default_factory=dict[str, Counters])  # of links and stages


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

    Taps receive every message that they want. Sinks are not called: a replay sends nothing out. Messages are checked
    against their declared arrays once per output, and always with `strict`.
    """

    def __init__(
        self, graph: Graph, taps: Sequence[Tap] = (), *, strict: bool = False, remote: RemoteNodes | None = None
    ) -> None:
        """`remote`: nodes that other processes run. A digest among the taps receives the hashes of their outputs."""
        self.report = RunReport()
        self._strict, self._remote = strict, remote
        self._digests = [tap for tap in taps if isinstance(tap, Digest)]
        self._heap: list[tuple[int, int, int, int, _Port | None, Any]] = []  # no port: from a remote node
        self._sequence = 0
        self._events = Events(lambda: self.report.last_ns)
        self._refusals: dict[str, Refusal] = {}  # the first of each source
        self._refused: Counter[str] = Counter()  # by source
        self.running = ""
        """The port of the newest step."""
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
        self._add_ports(graph)

    def _add_ports(self, graph: Graph) -> None:
        """Bind the ports of all local nodes."""
        for name, spec in graph.nodes.items():
            node = self.nodes.get(name)
            if isinstance(node, Source):
                port = self._port(name, "decode", 0, node.decode)
                self._topics |= dict.fromkeys(node.replay_topics, port)
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
        """Take one record and run every step that follows from it."""
        report = self.report
        report.records += 1
        report.first_ns = report.first_ns or record.arrival_ns
        report.last_ns = record.arrival_ns
        port = self._topics.get(record.topic)
        if port is None:
            if self._remote is not None and record.topic in self._remote.topics:
                self._push_remote(self._remote.outputs_of(record.topic), record.arrival_ns)
                self._run_steps()
            elif not record.topic.startswith(RUN_TOPICS):
                report.unwired_topics[record.topic] += 1
            return
        try:
            given = self._step(port, record.arrival_ns, record)
        except LinkError as error:
            source = port.name.partition(".")[0]
            self._refusals.setdefault(source, Refusal(record.arrival_ns, error))
            self._refused[source] += 1
            if self._refused[source] >= MAX_REFUSALS and not self._gave(source):
                raise
            self._events.report(source, str(error))
            return
        self._publish_all(port, record.arrival_ns, given)
        self._run_steps()

    def deliver(self, node: str, port: str, message: Message, arrival_ns: int) -> None:
        """Hand a stage a message from outside the graph, and run every step that follows from it."""
        handler = getattr(self.nodes[node], f"on_{port}")
        target = self._port(node, port, 0, handler)
        self._publish_all(target, arrival_ns, self._step(target, arrival_ns, message))
        self._run_steps()

    def _run_steps(self) -> None:
        """Run steps until the heap is empty."""
        heap = self._heap
        while heap:
            arrival_ns, _, _, _, port, message = heappop(heap)
            if port is None:
                self._publish_remote(message, arrival_ns)
            elif given := self._step(port, arrival_ns, message):
                self._publish_all(port, arrival_ns, given)

    def _push_remote(self, outputs: RemoteOutputs, arrival_ns: int) -> None:
        """Put the outputs of remote nodes into the heap."""
        for name, message in outputs.messages:
            self._sequence += 1
            output = self._by_name[name]
            rank = self._ranks[name.partition(".")[0]]
            heappush(self._heap, (arrival_ns, rank, -1, self._sequence, None, (output, message)))
        if (failure := outputs.failure) is not None:
            self._sequence += 1
            heappush(self._heap, (arrival_ns, self._ranks[failure.node], -1, self._sequence, None, failure))

    def _publish_remote(self, given: tuple[Output[_Port], Message | None] | RemoteFailure, arrival_ns: int) -> None:
        """Publish a remote node's message, or raise what the node raised."""
        if isinstance(given, RemoteFailure):
            raise given.error from given.cause
        output, message = given
        if message is None:
            output.count += 1
        else:
            self._publish(output, message, arrival_ns)

    def _gave(self, source: str) -> bool:
        """Whether a source has given any message yet."""
        return any(output.count for output in self._outputs[source].values())

    def finish(self) -> RunReport:
        """Finish every stage, producers first. LinkError: a source could decode no record."""
        refusals = self.sources_without_data()
        if self._remote is not None:
            refusals += self._remote.end(self.report.last_ns)
        if refusals:
            raise min(refusals, key=lambda refusal: refusal.arrival_ns).error
        for _ in self.finishing():
            pass
        return self.final_report()

    def sources_without_data(self) -> list[Refusal]:
        """The first refusal of each source that could decode no record."""
        return [refusal for source, refusal in self._refusals.items() if not self._gave(source)]

    def finishing(self) -> Iterator[str]:
        """Finish stage after stage; gives its name when every step that follows has been run."""
        last_ns = self.report.last_ns
        for name, port in self._finishers:
            if port is not None:
                self._publish_all(port, last_ns, self._step(port, last_ns, None))
            elif self._remote is not None:
                self._push_remote(self._remote.finish(name), last_ns)
            self._run_steps()
            yield name

    def final_report(self) -> RunReport:
        """The report, when all stages have finished."""
        report = self.report
        report.messages = {name: output.count for name, output in self._by_name.items()}
        report.events = self._events.all
        counters = self.counters()
        for partition in self._remote.reports() if self._remote is not None else ():
            report.steps += partition.steps
            report.nodes |= {name: NodeReport(latency.count, latency) for name, latency in partition.compute.items()}
            report.events += partition.events
            counters |= partition.counters
            for digest in self._digests:
                digest.join(partition.hashes)
        for node in report.nodes.values():
            node.calls = node.compute.count
        report.events.sort(key=lambda event: event.first_ns)
        report.counters = {name: counts for name in report.nodes if (counts := counters.get(name))}
        return report

    def counters(self) -> dict[str, Counters]:
        """Each node's counters."""
        return {name: Counters.of(node.counters) for name, node in self.nodes.items()}

    def _step(self, port: _Port, arrival_ns: int, message: Any) -> tuple[Message, ...]:
        """Run one step: what a port gives for a message."""
        self.report.steps += 1
        self.running = port.name
        begin = perf_counter_ns()
        given = call(port.name, port.handler, message, arrival_ns)
        port.compute.add(perf_counter_ns() - begin)
        return given

    def _publish_all(self, port: _Port, arrival_ns: int, given: tuple[Message, ...]) -> None:
        """Publish what a port gave."""
        for item in given:
            self._publish(admit(port.name, port.outputs, item, self._strict), item, arrival_ns)

    def _publish(self, output: Output[_Port], message: Message, arrival_ns: int) -> None:
        """Hand a message to taps, and put a step for each consumer into the heap."""
        output.count += 1
        for see in output.seen_by:
            see(output.name, message, arrival_ns)
        for feed in output.feeds:
            self._sequence += 1
            heappush(self._heap, (arrival_ns, feed.rank, feed.index, self._sequence, feed, message))


def replay(graph: Graph, records: Iterable[Record], taps: Sequence[Tap] = (), *, strict: bool = False) -> RunReport:
    """Run a graph over records in order of arrival. Taps must be open; the caller closes them. RunError, LinkError."""
    with gc_frozen():
        runner = Replay(graph, taps, strict=strict)
        for record in records:
            runner.feed(record)
        return runner.finish()


@contextmanager
def gc_frozen() -> Generator[None]:
    """Exclude present objects from garbage collection: searching 170 000 of modules takes 4 % of a run."""
    gc.freeze()
    try:
        yield
    finally:
        gc.unfreeze()

"""The deterministic runner: events in the order of one heap, as fast as possible.

An event is keyed by (arrival, rank, port, sequence): arrival of the record that caused it, rank of the node that takes
it (producers before consumers), index of the port, and one running number. Two replays of one recording take the same
steps in the same order, so their messages hash to the same value.

Nodes may run elsewhere, ahead of this runner (`Parts`; in processes: `flow.apart`): what they told of a record takes
the place that their own steps have in the heap, by their ranks, so that nothing of a run shows it.

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
from typing import Any, NamedTuple, Protocol

from flow.graph import Graph
from flow.incidents import Incident, Incidents
from flow.link import RUN_TOPICS, LinkError, Record, Source, Tap
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, admit, call
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


class Failure(NamedTuple):
    """What a node that runs elsewhere raised."""

    node: str
    error: Exception
    cause: BaseException | None  # of the error


class Told(NamedTuple):
    """What nodes that run elsewhere gave for one record, or as one of them finished, in order."""

    messages: list[tuple[str, Message | None]]  # output, message; None: one that nobody here takes
    failure: Failure | None = None  # after the last of them


class Refusal(NamedTuple):
    """Of a source that gave nothing but refusals, the first of them."""

    arrival_ns: int
    error: LinkError


class PartReport(NamedTuple):
    """What nodes that ran elsewhere did, in the whole run."""

    report: RunReport
    hashes: dict[str, str]  # of their outputs, as `Digest` makes them


class Parts(Protocol):
    """The nodes that run elsewhere: all that one of them needs is among them."""

    nodes: frozenset[str]
    topics: frozenset[str]  # of the sources among them

    def told(self, topic: str) -> Told:
        """What they gave for the next record of one of their topics."""
        ...

    def end(self, last_ns: int) -> list[Refusal]:
        """There are no more records; the sources that gave nothing but refusals."""
        ...

    def finished(self, node: str) -> Told:
        """What they gave as a stage finished: asked of each, in order."""
        ...

    def reports(self) -> list[PartReport]:
        """Asked last."""
        ...


class Replay:
    """A graph's nodes wired together, fed with records one by one: `feed` each record, then `finish`.

    Taps see every message that they want as it leaves its output. Sinks are not called: a replay sends nothing out.
    Sources' and stages' messages are checked against their declared arrays once per output, and always with `strict`.
    """

    def __init__(
        self, graph: Graph, taps: Sequence[Tap] = (), *, strict: bool = False, parts: Parts | None = None
    ) -> None:
        """`parts`: the nodes that others run; a digest among the taps is told the hashes of their outputs."""
        self.report = RunReport()
        self._strict, self._parts = strict, parts
        self._digests = [tap for tap in taps if isinstance(tap, Digest)]
        self._heap: list[tuple[int, int, int, int, _Port | None, Any]] = []  # no port: told by the parts
        self._sequence = 0
        self._incidents = Incidents(lambda: self.report.last_ns)
        self._refusals: dict[str, Refusal] = {}  # by source, the first of each
        self._refused: Counter[str] = Counter()  # how many
        self.running = ""
        """The port whose message was taken last."""
        elsewhere = parts.nodes if parts else frozenset[str]()
        self.nodes: dict[str, Node] = {
            spec.name: spec.build() for spec in graph.nodes.values() if spec.name not in elsewhere
        }
        self._ranks = {name: rank for rank, name in enumerate(graph.nodes, 1)}
        self._outputs: dict[str, dict[type[Message], Output[_Port]]] = {name: {} for name in graph.nodes}
        for name, output, message in graph.outputs():
            taken = [tap.see for tap in taps if tap.wants(message) and not (name in elsewhere and tap in self._digests)]
            self._outputs[name][message] = Output(f"{name}.{output}", [], tuple(taken))
        self._by_name = {output.name: output for outputs in self._outputs.values() for output in outputs.values()}
        self.report.nodes = {name: NodeReport(0, Latency()) for name in graph.nodes}
        self._topics: dict[str, _Port] = {}
        self._finishers: list[tuple[str, _Port | None]] = []  # None: one of the parts
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
            if self._parts is not None and record.topic in self._parts.topics:
                self._hear(self._parts.told(record.topic), record.arrival_ns)
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

    def _settle(self) -> None:
        """Run all that follows from what was sent."""
        heap = self._heap
        while heap:
            arrival_ns, _, _, _, port, message = heappop(heap)
            if port is None:
                self._pass_on(message, arrival_ns)
            else:
                self._send(port, arrival_ns, self._run(port, arrival_ns, message))

    def _hear(self, told: Told, arrival_ns: int) -> None:
        """What the parts told takes its turn."""
        for name, message in told.messages:
            self._sequence += 1
            output = self._by_name[name]
            rank = self._ranks[name.partition(".")[0]]
            heappush(self._heap, (arrival_ns, rank, -1, self._sequence, None, (output, message)))
        if told.failure is not None:
            self._sequence += 1
            heappush(self._heap, (arrival_ns, self._ranks[told.failure.node], -1, self._sequence, None, told.failure))

    def _pass_on(self, told: tuple[Output[_Port], Message | None] | Failure, arrival_ns: int) -> None:
        """A message that the parts told; or what one of their nodes raised."""
        if isinstance(told, Failure):
            raise told.error from told.cause
        output, message = told
        if message is None:
            output.count += 1
        else:
            self._give(output, message, arrival_ns)

    def _gave(self, source: str) -> bool:
        """Whether a source has told anything yet."""
        return any(output.count for output in self._outputs[source].values())

    def finish(self) -> RunReport:
        """Let every stage give out what it still holds; producers first. LinkError of a source that gave nothing."""
        hopeless = self.hopeless()
        if self._parts is not None:
            hopeless += self._parts.end(self.report.last_ns)
        if hopeless:
            raise min(hopeless, key=lambda refusal: refusal.arrival_ns).error
        for _ in self.finishing():
            pass
        return self.sum_up()

    def hopeless(self) -> list[Refusal]:
        """The sources that gave nothing but refusals."""
        return [refusal for source, refusal in self._refusals.items() if not self._gave(source)]

    def finishing(self) -> Iterator[str]:
        """Finish stage after stage; each one's name when all that follows from its end has been run."""
        last_ns = self.report.last_ns
        for name, port in self._finishers:
            if port is not None:
                self._send(port, last_ns, self._run(port, last_ns, None))
            elif self._parts is not None:
                self._hear(self._parts.finished(name), last_ns)
            self._settle()
            yield name

    def sum_up(self) -> RunReport:
        """The report, when all have finished."""
        report = self.report
        report.messages = {name: output.count for name, output in self._by_name.items()}
        report.incidents = self._incidents.all
        counters = {name: dict(node.counters) for name, node in self.nodes.items()}
        for part, hashes in self._parts.reports() if self._parts is not None else ():
            report.events += part.events
            report.nodes |= part.nodes
            report.incidents += part.incidents
            counters |= part.counters
            for digest in self._digests:
                digest.join(hashes)
        for node in report.nodes.values():
            node.calls = node.compute.count
        report.incidents.sort(key=lambda incident: incident.first_ns)
        report.counters = {name: told for name in report.nodes if (told := counters.get(name))}
        return report

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

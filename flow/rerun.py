"""A live run taken again from its recording: each stage takes the same messages in the same order, and misses the same.

One thread. A record is decoded when it comes; a stage goes on when the message that it took next in the live run is
there. What a stage gives follows from the order of its inputs alone, so every message, and the hash over all, is that
of the live run. Where the recording ends earlier than the run (it was killed), so does the repetition.

Source: ours; Kahn, The semantics of a simple language for parallel programming (1974), with the choices recorded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from flow.consumption import FINISH, StageOrder
from flow.graph import Graph
from flow.incidents import Incidents
from flow.link import RUN_TOPICS, LinkError, Record, Source, Tap
from flow.message import Message
from flow.metrics import Latency
from flow.node_spec import NodeSpec
from flow.ports import Output, RunError, decoded
from flow.replay import NodeReport, RunReport
from flow.stage import Stage, output_ports
from flow.stage_life import StageLife

_Waiting = deque[tuple[int, Message]]  # arrival, message
_Feed = tuple[str, str]  # stage, port


class _Step:
    """A stage and what it took next in the live run."""

    __slots__ = ("_steps", "left", "life", "port", "queues", "skipped")

    def __init__(self, life: StageLife, ports: list[str], order: StageOrder) -> None:
        self.life = life
        self.queues: dict[str, _Waiting] = {port: deque() for port in ports}
        self._steps = order.steps()
        self.left = order.count
        self.port: str | None = None
        self.skipped = 0
        self.advance()

    def advance(self) -> None:
        """On to the next step; past the last one nothing that comes in is kept."""
        self.port, self.skipped = next(self._steps, (None, 0))
        if self.port is None:
            self.queues.clear()

    @property
    def ready(self) -> bool:
        """What was taken next is there."""
        return self.port == FINISH or (self.port is not None and len(self.queues[self.port]) > self.skipped)


class Rerun:
    """A graph's nodes fed with the records of a live run one by one: `feed` each, then `finish`."""

    def __init__(
        self, graph: Graph, orders: dict[str, StageOrder], taps: Sequence[Tap] = (), *, strict: bool = False
    ) -> None:
        """LinkError when the orders are of another graph than this."""
        self.report = RunReport()
        self.incidents = Incidents(lambda: self.report.last_ns)
        """What links and stages raised, as it was in the live run."""
        self._taps, self._strict = taps, strict
        self._outputs: dict[str, dict[type[Message], Output[_Feed]]] = {}
        self._sources: dict[str, tuple[str, Source]] = {}  # by topic
        self._steps: dict[str, _Step] = {}
        for spec in graph.nodes.values():
            self.report.nodes[spec.name] = NodeReport(0, Latency())
            outputs = output_ports(spec.cls)
            self._outputs[spec.name] = {message: Output(f"{spec.name}.{name}", []) for name, message in outputs.items()}
            if issubclass(spec.cls, Stage):
                self._steps[spec.name] = self._step(graph, spec, orders)
            elif issubclass(spec.cls, Source):
                source = spec.build()
                assert isinstance(source, Source)
                self._sources[source.topic] = spec.name, source
        if unknown := sorted(orders.keys() - self._steps.keys()):
            raise LinkError(f"the live run had stages that this graph has not: {', '.join(unknown)}")
        for edge in graph.edges:
            if edge.consumer in self._steps:
                self._outputs[edge.producer][edge.message].feeds.append((edge.consumer, edge.port))

    def _step(self, graph: Graph, spec: NodeSpec, orders: dict[str, StageOrder]) -> _Step:
        ports = [edge.port for edge in graph.edges if edge.consumer == spec.name]
        order = orders.get(spec.name, StageOrder([*ports, FINISH]))
        if order.ports != [*ports, FINISH]:
            raise LinkError(
                f"in the live run '{spec.name}' took {order.ports[:-1]}, in this graph it takes {ports}:"
                " only the recording's own configuration takes the same steps again"
            )

        def tell(done: str, error: RunError) -> None:
            self.incidents.report(spec.name, f"{error}; {done}")

        return _Step(StageLife(spec, self._outputs[spec.name], tell, strict=self._strict), ports, order)

    def feed(self, record: Record) -> None:
        """Take one record in, and go on as far as the live run's order lets."""
        report = self.report
        report.records += 1
        report.first_ns = report.first_ns or record.arrival_ns
        report.last_ns = record.arrival_ns
        if record.topic not in self._sources:
            if not record.topic.startswith(RUN_TOPICS):
                report.unwired_topics[record.topic] += 1
            return
        name, source = self._sources[record.topic]
        report.nodes[name].calls += 1
        try:
            given = decoded(name, source, record, self._outputs[name], self._strict)
        except (LinkError, RunError) as error:
            self.incidents.report(name, str(error))
            return
        touched: deque[_Step] = deque()
        self._hand_on(given, record.arrival_ns, touched)
        self._go_on(touched)

    def _go_on(self, touched: deque[_Step]) -> None:
        """Take every step that can be taken, of these stages and of those that they feed."""
        while touched:
            step = touched.popleft()
            while step.ready and step.port is not None:
                if step.port == FINISH:
                    given, arrival_ns = step.life.finish(), step.life.last_ns
                else:
                    queue = step.queues[step.port]
                    for _ in range(step.skipped):
                        queue.popleft()
                    arrival_ns, message = queue.popleft()
                    given = step.life.take(step.port, message, arrival_ns)
                self.report.events += 1
                step.left -= 1
                step.advance()
                self._hand_on(given, arrival_ns, touched)

    def _hand_on(self, given: Iterable[tuple[Output[_Feed], Message]], arrival_ns: int, touched: deque[_Step]) -> None:
        for output, message in given:
            output.count += 1
            for tap in self._taps:
                tap.see(output.name, message, arrival_ns)
            for consumer, port in output.feeds:
                step = self._steps[consumer]
                if step.queues:
                    step.queues[port].append((arrival_ns, message))
                    touched.append(step)

    def finish(self) -> RunReport:
        """Stages that took nothing finish now. Then the report."""
        self._go_on(deque(self._steps.values()))
        report = self.report
        for name, step in self._steps.items():
            report.nodes[name] = NodeReport(step.life.compute.count, step.life.compute)
        for outputs in self._outputs.values():
            report.messages.update({output.name: output.count for output in outputs.values()})
        report.incidents = self.incidents.all
        lives = {name: step.life for name, step in self._steps.items()}
        report.counters = {name: told for name, life in lives.items() if (told := life.counters)}
        return report

    @property
    def left(self) -> dict[str, int]:
        """Messages that stages took in the live run and that are not there: the recording lacks what made them."""
        return {name: step.left for name, step in self._steps.items() if step.left}

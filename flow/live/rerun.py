"""The repetition of a recorded live run: each stage takes the same messages in the same order, and misses the same.

It runs on one thread. A record is decoded when it comes. A stage runs when the message that it took next in the live
run is there. A stage's outputs depend only on the order of its inputs, so every message, and the hash of all, equals
that of the live run. Where the recording of a killed run ends early, so does the repetition.

Source: ours; Kahn, The Semantics of a Simple Language for Parallel Programming (1974), with the choices recorded.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Sequence

from flow.config.node_spec import NodeSpec
from flow.events import Events
from flow.graph import Graph
from flow.link import RUN_TOPICS, LinkError, Record, Source, Tap
from flow.live.input_order import FINISH, StageOrder
from flow.live.supervised_stage import SupervisedStage
from flow.message import Message
from flow.metrics import Latency
from flow.ports import Output, RunError, decoded
from flow.replay import NodeReport, RunReport
from flow.stage import Stage, output_ports

_Queue = deque[tuple[int, Message]]  # arrival, message
_Feed = tuple[str, str]  # stage, port


class _Replayed:
    """A stage and its next step in the live run."""

    __slots__ = ("_steps", "left", "port", "queues", "skipped", "stage")

    def __init__(self, stage: SupervisedStage, ports: list[str], order: StageOrder) -> None:
        self.stage = stage
        self.queues: dict[str, _Queue] = {port: deque() for port in ports}
        self._steps = order.steps()
        self.left = order.count
        self.port: str | None = None
        self.skipped = 0
        self.advance()

    def advance(self) -> None:
        """Go to the next step; after the last one the stage takes no messages."""
        self.port, self.skipped = next(self._steps, (None, 0))
        if self.port is None:
            self.queues.clear()

    @property
    def ready(self) -> bool:
        """Whether the message of the next step is there."""
        return self.port == FINISH or (self.port is not None and len(self.queues[self.port]) > self.skipped)


class Rerun:
    """A graph's nodes fed with the records of a live run one by one: `feed` each, then `finish`."""

    def __init__(
        self, graph: Graph, orders: dict[str, StageOrder], taps: Sequence[Tap] = (), *, strict: bool = False
    ) -> None:
        """LinkError: the orders are those of another graph."""
        self.report = RunReport()
        self.events = Events(lambda: self.report.last_ns)
        """What links and stages raise, as in the live run."""
        self._taps, self._strict = taps, strict
        self._outputs: dict[str, dict[type[Message], Output[_Feed]]] = {}
        self._sources: dict[str, tuple[str, Source]] = {}  # by topic
        self._stages: dict[str, _Replayed] = {}
        for spec in graph.nodes.values():
            self.report.nodes[spec.name] = NodeReport(0, Latency())
            outputs = output_ports(spec.cls)
            self._outputs[spec.name] = {message: Output(f"{spec.name}.{name}", []) for name, message in outputs.items()}
            if issubclass(spec.cls, Stage):
                self._stages[spec.name] = self._replayed(graph, spec, orders)
            elif issubclass(spec.cls, Source):
                source = spec.build()
                assert isinstance(source, Source)
                self._sources |= dict.fromkeys(source.replay_topics, (spec.name, source))
        if unknown := sorted(orders.keys() - self._stages.keys()):
            raise LinkError(f"the live run had stages that this graph does not have: {', '.join(unknown)}")
        for edge in graph.edges:
            if edge.consumer in self._stages:
                self._outputs[edge.producer][edge.message].feeds.append((edge.consumer, edge.port))

    def _replayed(self, graph: Graph, spec: NodeSpec, orders: dict[str, StageOrder]) -> _Replayed:
        ports = [edge.port for edge in graph.edges if edge.consumer == spec.name]
        order = orders.get(spec.name, StageOrder([*ports, FINISH]))
        if order.ports != [*ports, FINISH]:
            raise LinkError(
                f"in the live run '{spec.name}' took {order.ports[:-1]}, in this graph it takes {ports}:"
                " only the recording's own configuration repeats the run"
            )

        def report(reaction: str, error: RunError) -> None:
            self.events.report(spec.name, f"{error}; {reaction}")

        stage = SupervisedStage(spec, self._outputs[spec.name], report, strict=self._strict)
        return _Replayed(stage, ports, order)

    def feed(self, record: Record) -> None:
        """Take one record, and run every step that the live run's order allows."""
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
            self.events.report(name, str(error))
            return
        touched: deque[_Replayed] = deque()
        self._publish(given, record.arrival_ns, touched)
        self._run(touched)

    def _run(self, touched: deque[_Replayed]) -> None:
        """Run every step that is ready, of these stages and of those that they feed."""
        while touched:
            replayed = touched.popleft()
            while replayed.ready and replayed.port is not None:
                if replayed.port == FINISH:
                    given, arrival_ns = replayed.stage.finish(), replayed.stage.last_ns
                else:
                    queue = replayed.queues[replayed.port]
                    for _ in range(replayed.skipped):
                        queue.popleft()
                    arrival_ns, message = queue.popleft()
                    given = replayed.stage.take(replayed.port, message, arrival_ns)
                self.report.steps += 1
                replayed.left -= 1
                replayed.advance()
                self._publish(given, arrival_ns, touched)

    def _publish(
        self, given: Iterable[tuple[Output[_Feed], Message]], arrival_ns: int, touched: deque[_Replayed]
    ) -> None:
        for output, message in given:
            output.count += 1
            for tap in self._taps:
                tap.see(output.name, message, arrival_ns)
            for consumer, port in output.feeds:
                replayed = self._stages[consumer]
                if replayed.queues:
                    replayed.queues[port].append((arrival_ns, message))
                    touched.append(replayed)

    def finish(self) -> RunReport:
        """Finish stages that took no message. Then the report."""
        self._run(deque(self._stages.values()))
        report = self.report
        for name, replayed in self._stages.items():
            report.nodes[name] = NodeReport(replayed.stage.compute.count, replayed.stage.compute)
        for outputs in self._outputs.values():
            report.messages.update({output.name: output.count for output in outputs.values()})
        report.events = self.events.all
        counters = {name: replayed.stage.counters for name, replayed in self._stages.items()}
        report.counters = {name: counts for name, counts in counters.items() if counts}
        return report

    @property
    def left(self) -> dict[str, int]:
        """By stage, messages that it took in the live run and that are missing: the recording lacks their cause."""
        return {name: replayed.left for name, replayed in self._stages.items() if replayed.left}

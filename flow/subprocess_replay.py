"""A replay in several processes: stages that name a `process`, each with all that feeds it, run ahead of the rest.

A partition (`Graph.partitions`) needs nothing but its own records. Its process receives them before their turn and
sends back what each of them gave; the runner (`flow.replay`) takes that in at the position of those steps. Outputs,
order and errors are those of a replay in one process, however fast or slow each process is. What is sent ahead of its
turn, and so what waits for the runner, is bounded (MAX_RECORDS, MAX_BYTES).

Processes, not threads: half of the work, that of the LiDAR, is many short numpy calls, which hold Python's lock.
A message is sent back only where a tap or a node of another process takes it. The process hashes its outputs itself.

Source: ours; dataflow as in Kahn, The Semantics of a Simple Language for Parallel Programming (1974).
"""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from types import TracebackType

from flow.graph import Graph
from flow.link import LinkError, Record, Source, Tap
from flow.ports import RemoteError, RunError
from flow.remote.nodes import PartitionReport, Refusal, RemoteFailure, RemoteOutputs
from flow.remote.stage_process import RemotePartition, WorkerProcess
from flow.remote.stage_wire import TIME, Answer, AnswerKind, Request, record_bytes
from flow.replay import Replay, RunReport, gc_frozen, replay
from flow.taps import Digest

MAX_RECORDS, MAX_BYTES = 1024, 32 * 2**20  # that are sent ahead of their turn
BATCH_RECORDS, BATCH_BYTES = 16, 2**18  # records that are sent together


def can_use_subprocesses() -> bool:
    """Whether this host has several cores for this process, and processes can be forked."""
    return hasattr(os, "fork") and len(os.sched_getaffinity(0)) > 1


def replay_in_subprocesses(
    graph: Graph, records: Iterable[Record], taps: Sequence[Tap] = (), *, strict: bool = False
) -> RunReport:
    """As `flow.replay.replay`, with the same outputs, but each partition of the graph in a process of its own."""
    partitions = graph.partitions()
    if not partitions:
        return replay(graph, records, taps, strict=strict)
    with gc_frozen(), _Partitions(graph, partitions, taps, strict) as remote:
        runner = Replay(graph, taps, strict=strict, remote=remote)
        for record in remote.sent_ahead(records):
            runner.feed(record)
        return runner.finish()


class _Partitions:
    """All partitions, as the runner asks them: `flow.remote.nodes.RemoteNodes`."""

    def __init__(self, graph: Graph, partitions: Sequence[frozenset[str]], taps: Sequence[Tap], strict: bool) -> None:
        self.nodes = frozenset[str]().union(*partitions)
        others = [tap for tap in taps if not isinstance(tap, Digest)]
        taken = {(edge.producer, edge.message) for edge in graph.edges if edge.consumer not in self.nodes}
        wanted = [
            f"{name}.{output}"
            for name, output, message in graph.outputs()
            if (name, message) in taken or any(tap.wants(message) for tap in others)
        ]
        digest = len(others) < len(taps)
        self._partitions = [_Partition(graph.restricted_to(nodes), wanted, digest, strict) for nodes in partitions]
        self._by_topic = {topic: partition for partition in self._partitions for topic in partition.topics}
        self._by_node = {name: partition for partition in self._partitions for name in partition.graph.nodes}
        self.topics = frozenset(self._by_topic)
        self._open = ExitStack()

    def __enter__(self) -> _Partitions:
        with ExitStack() as opening:
            for partition in self._partitions:
                partition.start()
                opening.callback(partition.close)
            self._open = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    def sent_ahead(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records, each when its partition has been sent those after it as far as they may wait.

        What reading them raises comes in its turn. Those of the partitions come without their data.
        """
        source, waiting = iter(records), deque[tuple[Record, int]]()
        waiting_bytes, ended, failure = 0, False, None
        while True:
            while not ended and len(waiting) < MAX_RECORDS and waiting_bytes < MAX_BYTES:
                try:
                    record = next(source, None)
                except Exception as error:  # noqa: BLE001 - raised in its turn
                    record, failure = None, error
                if record is None:
                    ended = True
                    break
                size = len(record.data)
                partition = self._by_topic.get(record.topic)
                if partition is not None:
                    partition.add(record)
                    record = Record(record.topic, record.arrival_ns, record.stamp_ns, b"", record.sequence)
                waiting.append((record, size))
                waiting_bytes += size
            if not waiting:
                break
            record, size = waiting.popleft()
            waiting_bytes -= size
            yield record
        if failure is not None:
            raise failure

    def outputs_of(self, topic: str) -> RemoteOutputs:
        """See `RemoteNodes`."""
        return self._by_topic[topic].outputs()

    def end(self, last_ns: int) -> list[Refusal]:
        """See `RemoteNodes`."""
        for partition in self._partitions:
            partition.send(Request.END, TIME.pack(last_ns))
        heads = [partition.answer().head for partition in self._partitions]
        return [Refusal(arrival_ns, LinkError(text)) for head in heads for arrival_ns, text in head["refusals"]]

    def finish(self, node: str) -> RemoteOutputs:
        """See `RemoteNodes`."""
        partition = self._by_node[node]
        partition.send(Request.FINISH)
        return partition.outputs()

    def reports(self) -> list[PartitionReport]:
        """See `RemoteNodes`."""
        for partition in self._partitions:
            partition.send(Request.REPORT)
        return [PartitionReport.of_json(partition.answer().head) for partition in self._partitions]


class _Partition:
    """One partition in its process, sent records in batches."""

    def __init__(self, graph: Graph, wanted: Sequence[str], digest: bool, strict: bool) -> None:
        self.graph = graph
        sources = [spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Source)]
        self.topics = [source.topic for source in sources if isinstance(source, Source)]
        self._options = wanted, digest, strict
        self._batch: list[bytes] = []
        self._batch_bytes = 0

    def start(self) -> None:
        """Start the process."""
        wanted, digest, strict = self._options
        stages = ", ".join(spec.name for spec in self.graph.nodes.values() if spec.process)
        self._process = WorkerProcess(stages, forked=True)
        self._remote = RemotePartition(self._process, self.graph, wanted, digest=digest, strict=strict)

    def close(self) -> None:
        """End the process."""
        self._remote.close()
        self._process.end()

    def add(self, record: Record) -> None:
        """Send a record, with the next ones."""
        self._batch.append(record_bytes(record))
        self._batch_bytes += len(record.data)
        if len(self._batch) >= BATCH_RECORDS or self._batch_bytes >= BATCH_BYTES:
            self._flush()

    def send(self, kind: int, *body: bytes) -> None:
        """Send another request than records."""
        self._flush()
        self._remote.send(kind, *body)

    def outputs(self) -> RemoteOutputs:
        """Outputs for the next record, or of a node that finished. RunError: the process has ended."""
        answer = self._next()
        return RemoteOutputs(
            self._remote.messages(answer), _failure(answer) if answer.kind == AnswerKind.FAILED else None
        )

    def answer(self) -> Answer:
        """The answer to another request than records. Raises what a node raised."""
        answer = self._next()
        if answer.kind == AnswerKind.FAILED:
            failure = _failure(answer)
            raise failure.error from failure.cause
        return answer

    def _next(self) -> Answer:
        if not self._remote.has_answer:
            self._flush()
        try:
            return self._remote.answer()
        except RemoteError as error:
            raise RunError(
                f"{error}: is there enough memory? A replay with --single-process runs in one process"
            ) from None

    def _flush(self) -> None:
        if self._batch:
            self._remote.send(Request.RECORDS, *self._batch)
            self._batch, self._batch_bytes = [], 0


def _failure(answer: Answer) -> RemoteFailure:
    head = answer.head
    error = LinkError(head["text"]) if head["error"] == LinkError.__name__ else RunError(head["text"])
    return RemoteFailure(head["node"], error, RemoteError(head["cause"]) if head["cause"] else None)

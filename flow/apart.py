"""A replay in several processes: stages that name a `process`, each with all that it needs, run ahead of the rest.

A part is such a stage with all nodes that it hears of, directly or through others; parts that share a node or name the
same process are one. A part needs nothing but its own records, so its process goes on by itself: it is sent records
before their turn and tells what each of them gave, and the runner (`flow.replay`) takes that in where those steps would
have been. Outputs, order and errors are those of a replay in one process, however fast or slow each process is. What is
sent ahead of its turn, and so what waits for the runner, is bounded (MOST_RECORDS, MOST_BYTES).

Processes, not threads: half of the work, that of the LiDAR, is many short numpy calls, which keep Python's lock.
They are forked, since a new interpreter takes a second of a core to import what the stages need. A message crosses only
where it is taken, by a tap or a node of another process; the hashes of a part's outputs are made by the part. All goes
over pipes of `multiprocessing` that this process has with those it forked, and nobody else.

Source: ours; dataflow as in Kahn, The Semantics of a Simple Language for Parallel Programming (1974).
"""

from __future__ import annotations

import contextlib
import fcntl
import multiprocessing
import os
import signal
import sys
import threading
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from multiprocessing.connection import Connection
from queue import SimpleQueue
from types import TracebackType
from typing import Any, TypeVar

from flow.graph import Graph
from flow.link import Record, Source, Tap
from flow.message import Message
from flow.ports import RunError
from flow.replay import Failure, PartReport, Refusal, Replay, RunReport, Told, modules_at_rest, replay
from flow.taps import Digest

MOST_RECORDS, MOST_BYTES = 1024, 32 * 2**20  # that are sent ahead of their turn
AT_ONCE, AT_ONCE_BYTES = 16, 2**18  # records, or what was told of them, that cross together
PIPE_BYTES = 2**20
SWITCH_S = 0.0002  # a thread that reads or writes waits so long for Python's lock (usually .005)
PATIENCE_S = 5.0  # for a process to end

T = TypeVar("T")


def can_run_apart() -> bool:
    """Whether this host has several cores for us, and processes can be forked."""
    return "fork" in multiprocessing.get_all_start_methods() and len(os.sched_getaffinity(0)) > 1


def parts_of(graph: Graph) -> list[frozenset[str]]:
    """The nodes of each part, in rank order of their first stage that names a process."""
    needs: dict[str, set[str]] = {name: set() for name in graph.nodes}
    for edge in graph.edges:
        if graph.nodes[edge.consumer].kind == "stages":  # a sink's inputs are for live runs
            needs[edge.consumer].add(edge.producer)
    parts: list[frozenset[str]] = []
    for spec in graph.nodes.values():
        if not spec.process:
            continue
        part, asked = {spec.name}, [spec.name]
        while asked:
            new = needs[asked.pop()] - part
            part |= new
            asked += new
        alike = part | {other.name for other in graph.nodes.values() if other.process == spec.process}
        shared = [other for other in parts if other & alike]
        parts = [other for other in parts if not other & alike] + [frozenset(part).union(*shared)]
    return parts


def replay_apart(
    graph: Graph, records: Iterable[Record], taps: Sequence[Tap] = (), *, strict: bool = False
) -> RunReport:
    """As `flow.replay.replay`, and to the same outputs, with the graph's parts in processes of their own."""
    parts = parts_of(graph)
    if not parts:
        return replay(graph, records, taps, strict=strict)
    with modules_at_rest(), _Parts(graph, parts, taps, strict) as ahead:
        runner = Replay(graph, taps, strict=strict, parts=ahead)
        for record in ahead.sent_ahead(records):
            runner.feed(record)
        return runner.finish()


class Refusals(list[Refusal]):
    """What a part tells when there are no more records."""


class _Parts:
    """All parts as the runner asks them."""

    def __init__(self, graph: Graph, parts: Sequence[frozenset[str]], taps: Sequence[Tap], strict: bool) -> None:
        self.nodes = frozenset[str]().union(*parts)
        others = [tap for tap in taps if not isinstance(tap, Digest)]
        taken = {(edge.producer, edge.message) for edge in graph.edges if edge.consumer not in self.nodes}
        wanted = frozenset(
            f"{name}.{output}"
            for name, output, message in graph.outputs()
            if (name, message) in taken or any(tap.wants(message) for tap in others)
        )
        digests = len(others) < len(taps)
        self._processes = [_PartProcess(_graph_of(graph, part), wanted, digests, strict) for part in parts]
        self._by_topic = {topic: process for process in self._processes for topic in process.topics}
        self._by_node = {name: process for process in self._processes for name in process.graph.nodes}
        self.topics = frozenset(self._by_topic)
        self._open = ExitStack()

    def __enter__(self) -> _Parts:
        with ExitStack() as opening:
            for process in self._processes:
                process.start()
                opening.callback(process.close)
            self._open = opening.pop_all()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, traceback: TracebackType | None
    ) -> None:
        self._open.close()

    def sent_ahead(self, records: Iterable[Record]) -> Iterator[Record]:
        """The records, each when its part has been sent those after it as far as they may wait.

        What reading them raises comes in its turn. Those of the parts come without their data.
        """
        source, waiting = iter(records), deque[tuple[Record, int]]()
        waiting_bytes, ended, failure = 0, False, None
        while True:
            while not ended and len(waiting) < MOST_RECORDS and waiting_bytes < MOST_BYTES:
                try:
                    record = next(source, None)
                except Exception as error:  # noqa: BLE001 - raised in its turn
                    record, failure = None, error
                if record is None:
                    ended = True
                    break
                size = len(record.data)
                process = self._by_topic.get(record.topic)
                if process is not None:
                    process.send(record)
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

    def told(self, topic: str) -> Told:
        """See `flow.replay.Parts`."""
        return self._by_topic[topic].next(Told)

    def end(self, last_ns: int) -> list[Refusal]:
        """See `flow.replay.Parts`."""
        for process in self._processes:
            process.end(last_ns)
        return [refusal for process in self._processes for refusal in process.next(Refusals)]

    def finished(self, node: str) -> Told:
        """See `flow.replay.Parts`."""
        return self._by_node[node].next(Told)

    def reports(self) -> list[PartReport]:
        """See `flow.replay.Parts`."""
        return [process.next(PartReport) for process in self._processes]


class _PartProcess:
    """One part, as the process that has the rest sees it."""

    def __init__(self, graph: Graph, wanted: frozenset[str], digests: bool, strict: bool) -> None:
        self.graph = graph
        nodes = [spec.build() for spec in graph.nodes.values() if issubclass(spec.cls, Source)]
        self.topics = [node.topic for node in nodes if isinstance(node, Source)]
        self._work = wanted, digests, strict
        self._records: list[Record] = []  # to be sent
        self._bytes = 0
        self._told: deque[Any] = deque()

    def start(self) -> None:
        """Fork the process."""
        context = multiprocessing.get_context("fork")
        its_records, self._to = context.Pipe(duplex=False)
        self._from, its_told = context.Pipe(duplex=False)
        for pipe in (self._to, self._from):
            with contextlib.suppress(OSError):  # a smaller one makes more waiting, no more
                fcntl.fcntl(pipe.fileno(), fcntl.F_SETPIPE_SZ, PIPE_BYTES)
        ends = (self._to, self._from), its_records, its_told
        self._process = context.Process(target=_work, args=(self.graph, *self._work, *ends), daemon=True)
        self._process.start()
        its_records.close()
        its_told.close()

    def close(self) -> None:
        """End it, whatever it is at."""
        self._to.close()
        self._from.close()
        self._process.join(PATIENCE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()

    def send(self, record: Record) -> None:
        """A record for it, with the next ones."""
        self._records.append(record)
        self._bytes += len(record.data)
        if len(self._records) >= AT_ONCE or self._bytes >= AT_ONCE_BYTES:
            self._flush()

    def end(self, last_ns: int) -> None:
        """No more records: the run's last came at `last_ns`."""
        self._flush()
        self._send(last_ns)

    def next(self, kind: type[T]) -> T:
        """What it tells next, of this kind. RunError when it has died; what it raised instead of telling."""
        if not self._told:
            self._flush()
            try:
                self._told.extend(self._from.recv())
            except (EOFError, OSError):
                raise RunError(self._ending()) from None
        told = self._told.popleft()
        if not isinstance(told, kind):
            assert isinstance(told, Told)
            assert told.failure is not None
            raise told.failure.error from told.failure.cause
        return told

    def _flush(self) -> None:
        if self._records:
            self._send(self._records)
            self._records, self._bytes = [], 0

    def _send(self, what: list[Record] | int) -> None:
        """To the process; when it has died, `next` says so in its turn."""
        with contextlib.suppress(OSError):
            self._to.send(what)

    def _ending(self) -> str:
        self._process.join(PATIENCE_S)
        code = self._process.exitcode
        how = f"by signal {-code} ({signal.strsignal(-code)})" if code is not None and code < 0 else f"with code {code}"
        apart = [spec.name for spec in self.graph.nodes.values() if spec.process]
        return (
            f"the process of {', '.join(apart)} ended {how}: is there memory enough? One process does, too: --together"
        )


class _Teller(Tap):
    """Keeps what the part's nodes gave since it was asked last."""

    def __init__(self) -> None:
        super().__init__()
        self._wanted: frozenset[str] = frozenset()
        self._given: list[tuple[str, Message | None]] = []

    def want(self, outputs: frozenset[str]) -> None:
        """The outputs whose messages are taken elsewhere; of others only their number is told."""
        self._wanted = outputs

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Keep it."""
        self._given.append((output, message if output in self._wanted else None))

    def given(self) -> list[tuple[str, Message | None]]:
        """Hand it over."""
        given, self._given = self._given, []
        return given


def _work(
    graph: Graph,
    wanted: frozenset[str],
    digests: bool,
    strict: bool,
    parents: tuple[Connection, Connection],
    records: Connection,
    told: Connection,
) -> None:
    """The process of a part; it ends when the parent closes its ends of the pipes (`parents`, inherited).

    Two threads read and write, so that neither side's work waits for the other's. It leaves by `os._exit`: what of the
    parent's it has copies of (files, threads' locks) is not its own to close.
    """
    try:
        for end in parents:
            end.close()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C: the parent ends us
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
        if cv2 := sys.modules.get("cv2"):
            cv2.setNumThreads(0)  # its pool's threads are the parent's, and the cores are taken
        sys.setswitchinterval(SWITCH_S)
        inbox: SimpleQueue[Any] = SimpleQueue()
        outbox: SimpleQueue[Any] = SimpleQueue()
        threading.Thread(target=_listen, args=(records, inbox), daemon=True).start()
        threading.Thread(target=_tell, args=(told, outbox), daemon=True).start()
        _run_part(graph, wanted, digests, strict, inbox, outbox)
        threading.Event().wait()  # for `_listen` to end us, when all that was told has been read
    finally:
        os._exit(1)


def _listen(records: Connection, inbox: SimpleQueue[Any]) -> None:
    """Take in what is sent at once; how much that may be is the sender's to see to."""
    try:
        while True:
            inbox.put(records.recv())
    except (EOFError, OSError):
        os._exit(0)


def _tell(told: Connection, outbox: SimpleQueue[Any]) -> None:
    """Write what the part has to tell, when it is read."""
    with contextlib.suppress(OSError):  # nobody reads any more: `_listen` ends us
        while True:
            told.send(outbox.get())


def _run_part(
    graph: Graph,
    wanted: frozenset[str],
    digests: bool,
    strict: bool,
    inbox: SimpleQueue[Any],
    outbox: SimpleQueue[Any],
) -> None:
    """Run a part's graph over the records that come, and say what each gave."""
    teller, digest = _Teller(), Digest()
    teller.want(wanted)
    out: list[Any] = []

    def flush() -> None:
        if out:
            outbox.put(out.copy())
            out.clear()

    runner: Replay | None = None
    try:
        runner = Replay(graph, (teller, digest) if digests else (teller,), strict=strict)
        while not isinstance(sent := inbox.get(), int):  # when the run's last one came
            for record in sent:
                runner.feed(record)
                out.append(Told(teller.given()))
            if len(out) >= AT_ONCE or inbox.empty():
                flush()
        runner.report.last_ns = sent
        out.append(Refusals(runner.hopeless()))
        for _ in runner.finishing():
            out.append(Told(teller.given()))
        out.append(PartReport(runner.sum_up(), digest.outputs))
    except Exception as error:  # noqa: BLE001 - told, and raised there
        failed = runner.running.partition(".")[0] if runner is not None else next(iter(graph.nodes))
        cause = error.__cause__
        failure = Failure(failed, _portable(error), None if cause is None else _portable(cause))
        out.append(Told(teller.given(), failure))
    flush()


def _graph_of(graph: Graph, part: frozenset[str]) -> Graph:
    """The graph of a part alone, its nodes ranked as in the whole."""
    nodes = {name: spec for name, spec in graph.nodes.items() if name in part}
    edges = tuple(edge for edge in graph.edges if edge.consumer in part and edge.producer in part)
    return replace(graph, nodes=nodes, edges=edges)


def _portable(error: BaseException) -> Exception:
    """The error as made of what it was made of, or where that is no plain text and numbers a RunError that says it."""
    if isinstance(error, Exception) and all(isinstance(arg, str | int | float | None) for arg in error.args):
        with contextlib.suppress(Exception):  # its class takes other arguments than it keeps
            copy = type(error)(*error.args)
            if str(copy) == str(error):
                return copy
    return RunError(f"{type(error).__name__}: {error}")

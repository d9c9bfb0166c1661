"""The worker process that runs partitions of a graph for its parent; `flow.remote.stage_wire` defines the requests.

The parent forks it (`serve_forked`) or starts it as `python -m flow.remote.stage_worker FD NICE`. FD is a socket over
which the parent passes one socket for each partition. The process ends when the parent's end of FD closes.

Three threads serve a partition: one reads, one runs the nodes, one writes. So no process waits until the other reads.
The parent bounds how much it sends ahead.

Source: ours.
"""

from __future__ import annotations

import contextlib
import gc
import importlib
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Iterator
from queue import SimpleQueue
from typing import Any

from flow.config.edge import Edge, default_queue
from flow.config.node_spec import NodeSpec
from flow.graph import Graph
from flow.link import LinkError, Tap
from flow.message import Message
from flow.ports import RunError
from flow.remote.codec import decode, encode
from flow.remote.nodes import PartitionReport
from flow.remote.stage_wire import (
    CHUNK_BYTES,
    PORT,
    TIME,
    AnswerKind,
    DisconnectedError,
    Encoded,
    Frames,
    Request,
    answer_frame,
    records_of,
)
from flow.replay import Replay
from flow.stage import input_ports, output_ports
from flow.taps import Digest

MAX_ANSWERS = 16  # that wait to be written together while more requests are there
SWITCH_S = 0.0002  # a thread that reads or writes waits at most so long for Python's lock; the default is 0.005


class Collector(Tap):
    """Encodes what the nodes of a partition give."""

    def __init__(self, names: list[str], wanted: frozenset[str]) -> None:
        """The outputs in order, and those whose messages the parent wants; of others only the number counts."""
        super().__init__()
        self._indices = {name: index for index, name in enumerate(names)}
        self._wanted = wanted
        self._given: list[Encoded] = []

    def see(self, output: str, message: Message, arrival_ns: int) -> None:
        """Add a message."""
        self._given.append((self._indices[output], encode(message) if output in self._wanted else b""))

    def take(self) -> list[Encoded]:
        """What was given since the call before."""
        given, self._given = self._given, []
        return given


class Partition:
    """A partition's nodes, and the answers to requests."""

    def __init__(self, start: bytes) -> None:
        spec: dict[str, Any] = json.loads(start)
        self.graph = _graph_of(spec)
        names = [f"{node}.{output}" for node, output, _ in self.graph.outputs()]
        wanted = names if spec["wanted"] is None else spec["wanted"]
        self._collector, self._digest = Collector(names, frozenset(wanted)), Digest()
        taps = (self._collector, self._digest) if spec["digest"] else (self._collector,)
        self._runner = Replay(self.graph, taps, strict=spec["strict"])
        self._finishing = self._runner.finishing()

    def answers(self, kind: int, body: bytes) -> Iterator[bytes]:
        """The answers to a request, as frames. Raises what a node raises."""
        runner = self._runner
        if kind == Request.RECORDS:
            for record in records_of(body):
                runner.feed(record)
                yield answer_frame(AnswerKind.OUTPUTS, self._collector.take())
        elif kind == Request.MESSAGE:
            (spec,) = self.graph.nodes.values()
            inputs = input_ports(spec.cls)
            index: int = PORT.unpack_from(body)[0]
            port = list(inputs)[index]
            message = decode(body, {inputs[port].__name__: inputs[port]}, PORT.size)
            runner.deliver(spec.name, port, message, 0)
            yield answer_frame(AnswerKind.OUTPUTS, self._collector.take(), {"counters": _plain_counters(runner)})
        elif kind == Request.END:
            (runner.report.last_ns,) = TIME.unpack(body)
            refusals = [(refusal.arrival_ns, str(refusal.error)) for refusal in runner.sources_without_data()]
            yield answer_frame(AnswerKind.REFUSED, head={"refusals": refusals})
        elif kind == Request.FINISH:
            next(self._finishing)
            yield answer_frame(AnswerKind.OUTPUTS, self._collector.take(), {"counters": _plain_counters(runner)})
        elif kind == Request.REPORT:
            yield answer_frame(AnswerKind.REPORT, head=self._report().to_json())

    def _report(self) -> PartitionReport:
        report = self._runner.final_report()
        compute = {name: node.compute for name, node in report.nodes.items()}
        return PartitionReport(report.steps, compute, report.events, report.counters, self._digest.outputs)

    def failed(self, error: Exception) -> bytes:
        """The answer that reports an error, as a frame."""
        node = self._runner.running.partition(".")[0] or next(iter(self.graph.nodes))
        head = {**_described(error), "node": node, "counters": _plain_counters(self._runner)}
        return answer_frame(AnswerKind.FAILED, self._collector.take(), head)


def _plain_counters(runner: Replay) -> dict[str, Any]:
    return {name: counts.to_json() for name, counts in runner.counters().items()}


def _described(error: Exception) -> dict[str, Any]:
    """An error as JSON: only the runner's own two classes are raised again as what they are."""
    named = isinstance(error, RunError | LinkError)
    return {
        "error": type(error).__name__ if named else RunError.__name__,
        "text": str(error) if named else f"{type(error).__name__}: {error}",
        "cause": "" if error.__cause__ is None else f"{type(error.__cause__).__name__}: {error.__cause__}",
    }


def _graph_of(spec: dict[str, Any]) -> Graph:
    """The graph that `stage_wire.start_body` wrote."""
    nodes: dict[str, NodeSpec] = {}
    for node in spec["nodes"]:
        module, _, name = node["use"].rpartition(".")
        cls = getattr(importlib.import_module(module), name)
        nodes[node["name"]] = NodeSpec(node["name"], node["kind"], node["use"], cls, node["config"])
    edges: list[Edge] = []
    for producer, output, consumer, port in spec["edges"]:
        message = output_ports(nodes[producer].cls)[output]
        edges.append(Edge(producer, output, consumer, port, message, default_queue(message)))
    return Graph(nodes, tuple(edges), None, {})


class PartitionThread(threading.Thread):
    """Runs one partition, until its socket closes or a node raises."""

    def __init__(self, stream: socket.socket) -> None:
        super().__init__(daemon=True)
        self._stream = stream
        self._inbox: SimpleQueue[bytes] = SimpleQueue()
        self._outbox: SimpleQueue[bytes] = SimpleQueue()

    def run(self) -> None:
        for work in (self._read, self._write):
            threading.Thread(target=work, daemon=True).start()
        frames, waiting = Frames(self._inbox.get), list[bytes]()
        try:
            for answer in self._answers(frames):
                waiting.append(answer)
                if len(waiting) >= MAX_ANSWERS or not (frames.buffered or not self._inbox.empty()):
                    self._outbox.put(b"".join(waiting))
                    waiting.clear()
        except DisconnectedError:
            pass  # the parent has ended this partition
        self._outbox.put(b"".join(waiting))
        self._outbox.put(b"")

    def _answers(self, frames: Frames) -> Iterator[bytes]:
        """All answers; the last one reports an error. DisconnectedError: the parent has closed the stream."""
        partition: Partition | None = None
        try:
            partition = Partition(frames.next()[1])
            gc.freeze()  # modules are no garbage: not searching them saves 4 % of the time
            yield answer_frame(AnswerKind.OUTPUTS)
            while True:
                yield from partition.answers(*frames.next())
        except DisconnectedError:
            raise
        except Exception as error:  # noqa: BLE001 - the parent raises it
            yield partition.failed(error) if partition else answer_frame(AnswerKind.FAILED, head=_described(error))

    def _read(self) -> None:
        try:
            while chunk := self._stream.recv(CHUNK_BYTES):
                self._inbox.put(chunk)
        except OSError:
            pass  # as at the stream's end
        self._inbox.put(b"")

    def _write(self) -> None:
        with self._stream:
            try:
                while data := self._outbox.get():
                    self._stream.sendall(data)
            except OSError:
                pass  # nobody reads any more
            with contextlib.suppress(OSError):
                self._stream.shutdown(socket.SHUT_RDWR)  # ends `_read`


def serve(control: socket.socket, inherited: tuple[socket.socket, ...] = ()) -> None:
    """Run partitions until the other end of `control` closes; then end this process.

    `inherited`: sockets of the parent that a fork copied. The process leaves by `os._exit`: files and threads that it
    has copies of are the parent's to close.
    """
    code = 1
    try:
        for copy in inherited:
            copy.close()
        signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches all processes of a terminal; the parent ends us
        sys.setswitchinterval(SWITCH_S)
        while True:
            _, streams, _, _ = socket.recv_fds(control, 1, 1)
            if not streams:
                break
            PartitionThread(socket.socket(fileno=streams[0])).start()
        code = 0
    finally:
        os._exit(code)


def serve_forked(control: socket.socket, inherited: tuple[socket.socket, ...]) -> None:
    """`serve` in a forked process."""
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # not the parent's handler; multiprocessing ends it so at exit
    if cv2 := sys.modules.get("cv2"):
        cv2.setNumThreads(0)  # the threads of its pool are the parent's
    serve(control, inherited)


if __name__ == "__main__":
    os.nice(int(sys.argv[2]))
    signal.signal(signal.SIGTERM, signal.SIG_IGN)  # a service manager sends it to all processes; the parent ends us
    serve(socket.socket(fileno=int(sys.argv[1])))

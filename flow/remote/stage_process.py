"""Partitions of a graph that run in worker processes of this host, seen from the parent.

Python runs one thread of a process at a time. Stages that process images in a process of their own (`process: NAME`)
leave that thread to the poses and use the second core. In a live run the end of such a process (a fault in compiled
code) does not end the flight: it counts as one more exception of its stages, and fresh ones start in a fresh process.

Live (`Processes`): a stage keeps its inbox, thread, order and counts in the parent; only the handlers run in the
worker. The same messages go in, in the same order, so the repetition in one process (`flow.live.rerun`) gives the same
outputs. That does not hold after a process has ended in flight: the fresh stage has lost the state that the repeated
one still has. In a replay: see `flow.subprocess_replay`.

Source: ours.
"""

from __future__ import annotations

import contextlib
import functools
import multiprocessing
import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Sequence
from typing import Protocol

from flow.config.node_spec import NodeSpec
from flow.counters import Counters
from flow.graph import Graph
from flow.message import Message
from flow.ports import RemoteError, RunError
from flow.remote.codec import decode, encode
from flow.remote.stage_wire import (
    CHUNK_BYTES,
    PORT,
    Answer,
    AnswerKind,
    DisconnectedError,
    Frames,
    Request,
    answer_of,
    frame,
    start_body,
)
from flow.remote.stage_worker import serve_forked
from flow.stage import input_ports

END_S = 0.3  # for a process to end before it is killed
EXIT_S = 1.0  # for the exit code of a process that has closed its sockets
LIVE_NICE = 5
"""The parent has priority on a core: its poses are due, an image can wait."""


class _Child(Protocol):
    """What is used of `subprocess.Popen`."""

    @property
    def pid(self) -> int: ...
    def poll(self) -> int | None: ...
    def wait(self, timeout: float | None = None) -> int: ...
    def kill(self) -> None: ...


class _Forked:
    """A forked process, with the methods of `subprocess.Popen`."""

    def __init__(self, control: socket.socket, inherited: socket.socket) -> None:
        context = multiprocessing.get_context("fork")
        self._process = context.Process(target=serve_forked, args=(control, (inherited,)), daemon=True)
        self._process.start()

    @property
    def pid(self) -> int:
        return self._process.pid or 0

    def poll(self) -> int | None:
        return self._process.exitcode

    def wait(self, timeout: float | None = None) -> int:
        self._process.join(timeout)
        code = self.poll()
        if code is None:
            raise subprocess.TimeoutExpired("fork", timeout or 0.0)
        return code

    def kill(self) -> None:
        self._process.kill()


class WorkerProcess:
    """One worker process (`flow.remote.stage_worker`), from its start to `end`."""

    def __init__(self, name: str, *, forked: bool = False, nice: int = 0) -> None:
        """`forked`: a fork of this process, whose other threads must hold no lock; else a new interpreter.

        A fork saves the second of a core that a new interpreter takes to import the stages' libraries.
        """
        self.name = name
        self._control, theirs = socket.socketpair()
        with theirs:
            self._child: _Child = _Forked(theirs, self._control) if forked else _started(theirs, nice)

    @property
    def pid(self) -> int:
        """Process id."""
        return self._child.pid

    @property
    def runs(self) -> bool:
        """Whether it has not ended."""
        return self._child.poll() is None

    def connect(self) -> socket.socket:
        """A stream socket to the process, for one more partition."""
        ours, theirs = socket.socketpair()
        with theirs, contextlib.suppress(OSError):  # the process has ended: reading the stream fails
            socket.send_fds(self._control, [b" "], [theirs.fileno()])
        return ours

    def exit_text(self) -> str:
        """How it ended, for a partition whose stream has ended."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(EXIT_S)
        code = self._child.poll()
        if code is None:
            return f"the process '{self.name}' has lost the stage"
        how = f"by signal {-code} ({signal.strsignal(-code)})" if code < 0 else f"with code {code}"
        return f"the process '{self.name}' has ended {how}"

    def end(self) -> None:
        """End it, by force when it does not end at once."""
        self._control.close()
        try:
            self._child.wait(END_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()


def _started(control: socket.socket, nice: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-P", "-m", "flow.remote.stage_worker", str(control.fileno()), str(nice)],
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or "." for path in sys.path)},
        pass_fds=[control.fileno()],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
    )


class RemotePartition:
    """A partition of a graph in a worker process."""

    def __init__(
        self,
        process: WorkerProcess,
        graph: Graph,
        wanted: Sequence[str] | None = None,
        *,
        digest: bool = False,
        strict: bool = False,
    ) -> None:
        """Arguments as in `stage_wire.start_body`."""
        self.process, self.graph = process, graph
        self._stream = process.connect()
        self._frames = Frames(functools.partial(self._stream.recv, CHUNK_BYTES))
        self._outputs = [(f"{node}.{name}", {cls.__name__: cls}) for node, name, cls in graph.outputs()]
        self._started = False
        self._start_error = ""
        self.send(Request.START, start_body(graph, wanted, digest=digest, strict=strict))

    def send(self, kind: int, *body: bytes) -> None:
        """Send a request. When the process has ended, the next `answer` raises."""
        with contextlib.suppress(OSError):
            self._stream.sendall(frame(kind, *body))

    def wait(self) -> None:
        """Wait until it has started. RemoteError: its process has ended, or it cannot start."""
        if not self._started:
            answer = self._next()
            self._started = True
            self._start_error = answer.head["text"] if answer.kind == AnswerKind.FAILED else ""
        if self._start_error:
            raise RemoteError(self._start_error)

    @property
    def has_answer(self) -> bool:
        """Whether the next answer has arrived, at least its first bytes."""
        return self._frames.buffered

    def answer(self) -> Answer:
        """The next answer, waited for. RemoteError: its process has ended, or it cannot start."""
        self.wait()
        return self._next()

    def _next(self) -> Answer:
        try:
            return answer_of(*self._frames.next())
        except (DisconnectedError, OSError):
            raise RemoteError(self.process.exit_text()) from None

    def messages(self, answer: Answer) -> list[tuple[str, Message | None]]:
        """(output, message) of all that an answer holds; None for a message that was not wanted."""
        outputs = [(*self._outputs[index], data) for index, data in answer.messages]
        return [(name, decode(data, expected) if data else None) for name, expected, data in outputs]

    def close(self) -> None:
        """Close its stream: the worker drops it."""
        self._stream.close()


class RemoteStage:
    """A stage in a worker process, its ports as methods: `on_<port>` and `finish` return when it has answered."""

    def __init__(self, spec: NodeSpec, process: WorkerProcess) -> None:
        self.counters = Counters()
        """As of its newest answer."""
        self._name = spec.name
        self._partition = RemotePartition(process, Graph({spec.name: spec}, (), None, {}))
        self._ports = {f"on_{port}": index for index, port in enumerate(input_ports(spec.cls))}

    def __getattr__(self, name: str) -> Callable[[Message], list[Message]]:
        """A port."""
        try:
            return functools.partial(self._take, self.__dict__["_ports"][name])
        except KeyError:
            raise AttributeError(name) from None

    def finish(self) -> list[Message]:
        """What the stage still held."""
        return self._ask(Request.FINISH)

    def wait(self) -> None:
        """Wait until it has started, or has failed to: its first message raises that."""
        with contextlib.suppress(RemoteError):
            self._partition.wait()

    def _take(self, port: int, message: Message) -> list[Message]:
        return self._ask(Request.MESSAGE, PORT.pack(port), encode(message))

    def _ask(self, kind: int, *body: bytes) -> list[Message]:
        self._partition.send(kind, *body)
        answer = self._partition.answer()
        self.counters = Counters.of_json(answer.head["counters"][self._name])
        if answer.kind == AnswerKind.FAILED:
            cause, text = answer.head["cause"], answer.head["text"]
            raise RemoteError(cause) if cause else RunError(text)
        return [message for _, message in self._partition.messages(answer) if message is not None]


class Processes:
    """The worker processes of one live run, by name; each starts with its first stage, and again when it has ended."""

    def __init__(self) -> None:
        self._by_name: dict[str, WorkerProcess] = {}
        self._starting: list[RemoteStage] = []
        self._started = False
        self._lock = threading.Lock()

    def build(self, spec: NodeSpec) -> RemoteStage:
        """A fresh stage in the process that its declaration names."""
        with self._lock:
            process = self._by_name.get(spec.process)
            if process is None or not process.runs:
                if process is not None:
                    process.end()
                process = self._by_name[spec.process] = WorkerProcess(spec.process, nice=LIVE_NICE)
        stage = RemoteStage(spec, process)
        if not self._started:
            self._starting.append(stage)
        return stage

    def wait(self) -> None:
        """Wait until all stages have started: importing their libraries takes a second. The run begins then."""
        self._started = True
        while self._starting:
            self._starting.pop().wait()

    @property
    def pids(self) -> list[int]:
        """Of those that run."""
        with self._lock:
            return [process.pid for process in self._by_name.values() if process.runs]

    def end(self) -> None:
        """End all."""
        with self._lock:
            for process in self._by_name.values():
                process.end()

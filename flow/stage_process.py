"""Stages that work in other processes of this host (`process: NAME` in a live run), seen from the run.

Python lets one thread of a process work at a time. Stages of pictures in a process of their own leave the poses theirs,
use the second core, and what ends that process (a fault in a library's compiled code) does not end the flight: it is
one more way for a stage to raise, and a fresh one is started in a fresh process.

The run keeps the stage's inbox, thread, order and counts; only the handlers' work is elsewhere. The same messages go
in, in the same order, so the run taken again (`flow.rerun`, in one process) gives the same; but not after the end of
such a process in flight: a fresh stage has forgotten what the one taken again has not.

Source: ours.
"""

from __future__ import annotations

import contextlib
import functools
import json
import os
import socket
import subprocess
import sys
import threading
from collections.abc import Callable

from flow.codec import decode, encode
from flow.message import Message
from flow.node_spec import NodeSpec
from flow.ports import RaisedElsewhereError
from flow.stage import input_ports, output_ports
from flow.stage_wire import FINISH, RAISED, START, Gone, receive, send, unpacked

END_S = 0.3  # for a process to end by itself


class RemoteStage:
    """A stage in another process, its ports as methods: `on_<port>`, `finish`; they return when it has answered."""

    def __init__(self, spec: NodeSpec, process: Process) -> None:
        self.counters: dict[str, int] = {}
        """As of its newest answer."""
        self._process, self._line = process, process.open(spec)
        self._ready = False
        self._ports = {f"on_{port}": index for index, port in enumerate(input_ports(spec.cls))}
        self._gives = {message.__name__: message for message in output_ports(spec.cls).values()}

    def __getattr__(self, name: str) -> Callable[[Message], list[Message]]:
        """A port."""
        try:
            return functools.partial(self._ask, self.__dict__["_ports"][name])
        except KeyError:
            raise AttributeError(name) from None

    def finish(self) -> list[Message]:
        """What it still held."""
        return self._ask(FINISH, None)

    def wait(self) -> None:
        """Until it is there, or its process is no more: the first that asks it learns that."""
        with contextlib.suppress(Gone):
            self._answer()

    def _ask(self, what: int, message: Message | None) -> list[Message]:
        try:
            if not self._ready:
                self._answer()
            send(self._line, what, b"" if message is None else encode(message))
            answer, parts = self._answer()
        except Gone:
            raise RaisedElsewhereError(self._process.ending()) from None
        if answer == RAISED:
            raise RaisedElsewhereError(parts[0].decode(errors="replace"))
        return [decode(data, self._gives) for data in parts]

    def _answer(self) -> tuple[int, list[bytes]]:
        answer, body = receive(self._line)
        self._ready = True  # the first is that it has started
        self.counters, parts = unpacked(body)
        return answer, parts


class Process:
    """One process for stages: `python -m flow.stage_worker`."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._control, theirs = socket.socketpair()
        with theirs:
            self._child = subprocess.Popen(
                [sys.executable, "-P", "-m", "flow.stage_worker", str(theirs.fileno())],
                env={**os.environ, "PYTHONPATH": os.pathsep.join(path or "." for path in sys.path)},
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
            )

    @property
    def pid(self) -> int:
        """Of the process, while it runs."""
        return self._child.pid

    @property
    def runs(self) -> bool:
        """It has not ended."""
        return self._child.poll() is None

    def open(self, spec: NodeSpec) -> socket.socket:
        """Have a fresh stage started there; the line to it."""
        ours, theirs = socket.socketpair()
        with theirs, contextlib.suppress(OSError):  # it has ended: whoever asks the stage finds out
            send(ours, START, json.dumps({"use": spec.use, "config": spec.config}).encode())
            socket.send_fds(self._control, [b" "], [theirs.fileno()])
        return ours

    def ending(self) -> str:
        """Why nobody answers, in words."""
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._child.wait(END_S)
        code = self._child.returncode
        if code is None:
            return f"the process '{self.name}' lost the stage"
        how = f"by signal {-code}" if code < 0 else f"with code {code}"
        return f"the process '{self.name}' has ended {how}"

    def end(self) -> None:
        """End it, by force if it must be."""
        self._control.close()
        try:
            self._child.wait(END_S)
        except subprocess.TimeoutExpired:
            self._child.kill()
            self._child.wait()


class Processes:
    """The processes of one run, by name; each starts when its first stage does, and again when it has ended."""

    def __init__(self) -> None:
        self._by_name: dict[str, Process] = {}
        self._starting: list[RemoteStage] = []
        self._run = False
        self._lock = threading.Lock()

    def build(self, spec: NodeSpec) -> RemoteStage:
        """A fresh stage in the process that its declaration names."""
        with self._lock:
            process = self._by_name.get(spec.process)
            if process is None or not process.runs:
                if process is not None:
                    process.end()
                process = self._by_name[spec.process] = Process(spec.process)
        stage = RemoteStage(spec, process)
        if not self._run:
            self._starting.append(stage)
        return stage

    def wait(self) -> None:
        """Until all stages are there: their libraries take a second to import. The run begins then."""
        self._run = True
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

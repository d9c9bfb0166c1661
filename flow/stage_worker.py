"""The process in which stages of a live run work (`process: NAME`): `python -m flow.stage_worker FD`.

FD is a socket over which the run hands a socket for each stage. On that, the first question is the stage's class and
settings, as JSON. Each stage has a thread. The process ends when the run does, whatever ends that: nobody is at the
other end of FD then.

Source: ours.
"""

from __future__ import annotations

import gc
import importlib
import json
import os
import signal
import socket
import sys
import threading
from collections.abc import Callable
from typing import Any

from flow.codec import decode, encode
from flow.message import Message
from flow.ports import messages_of
from flow.stage import Stage, input_ports
from flow.stage_wire import FINISH, GAVE, RAISED, Gone, packed, receive, send

NICE = 5
"""Of two that want the same core the run itself goes first: its poses are due, a picture can wait."""


class Worker(threading.Thread):
    """One stage, asked over its line."""

    def __init__(self, line: socket.socket) -> None:
        super().__init__(daemon=True)
        self._line = line

    def run(self) -> None:
        with self._line:
            try:
                self._work()
            except Gone:
                return  # the run wants another, or has ended

    def _work(self) -> None:
        spec = json.loads(receive(self._line)[1])
        module, _, name = spec["use"].rpartition(".")
        cls: type[Stage] = getattr(importlib.import_module(module), name)
        stage = cls(cls.settings_type.model_validate(spec["config"]))
        gc.freeze()
        send(self._line, GAVE, packed({}, ()))
        ports = [(getattr(stage, f"on_{port}"), {m.__name__: m}) for port, m in input_ports(cls).items()]
        while True:
            port, body = receive(self._line)
            if port == FINISH:
                self._answer(stage, lambda _: stage.finish(), None)
            else:
                handler, expected = ports[port]
                self._answer(stage, handler, decode(body, expected))

    def _answer(self, stage: Stage, handler: Callable[[Any], Any], message: Message | None) -> None:
        try:
            what, parts = GAVE, [encode(item) for item in messages_of(handler, message)]
        except Exception as error:  # noqa: BLE001  the run is told, as of one in its own process
            what, parts = RAISED, [f"{type(error).__name__}: {error}".encode()]
        send(self._line, what, packed(stage.counters, parts))


def main(control: socket.socket) -> None:
    """Start a thread for each stage that is handed over, until nobody hands any."""
    for number in (signal.SIGINT, signal.SIGTERM):  # Ctrl-C goes to all of a terminal: the run ends this process
        signal.signal(number, signal.SIG_IGN)
    os.nice(NICE)
    while True:
        _, lines, _, _ = socket.recv_fds(control, 1, 1)
        if not lines:
            return
        Worker(socket.socket(fileno=lines[0])).start()


if __name__ == "__main__":
    main(socket.socket(fileno=int(sys.argv[1])))

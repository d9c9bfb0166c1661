"""A UDP socket with a thread of its own: the simulated autopilots, which a live run connects to.

Source: ours.
"""

from __future__ import annotations

import abc
import select
import socket
import threading
from types import TracebackType
from typing import Self

STEP_S = 0.002  # at most this long without a step
MAX_DATAGRAM = 2048


class UdpThread(abc.ABC):
    """Context manager that runs `step` in a thread, at least every STEP_S, with the datagrams that have arrived."""

    def __init__(self, bind: tuple[str, int], name: str) -> None:
        self._closed = threading.Event()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(bind)
        self._socket.setblocking(False)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._closed.set()
        self._thread.join()
        self._socket.close()

    @property
    def port(self) -> int:
        """The port on which it listens."""
        return self._socket.getsockname()[1]

    @abc.abstractmethod
    def step(self, datagram: tuple[bytes, tuple[str, int]] | None) -> None:
        """Handle a datagram with its sender; None: none has arrived."""

    def _run(self) -> None:
        while not self._closed.is_set():
            ready, _, _ = select.select([self._socket], [], [], STEP_S)
            datagram = None
            if ready:
                try:
                    datagram = self._socket.recvfrom(MAX_DATAGRAM)
                except OSError:  # the port of the other side is closed
                    continue
            self.step(datagram)

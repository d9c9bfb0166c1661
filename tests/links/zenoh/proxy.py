"""A TCP proxy in front of a port: it can cut the line (as a pulled cable: nothing moves) and mend it again."""

from __future__ import annotations

import contextlib
import socket
import threading

BUFFER_BYTES = 16_384


class Proxy:
    """`with Proxy(port) as proxy`: what comes to proxy.port goes to port."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._listening = socket.socket()
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self._listening.bind(("127.0.0.1", 0))
        self._listening.listen()
        self.port = self._listening.getsockname()[1]
        self._whole = threading.Event()
        self._whole.set()
        self._sockets: list[socket.socket] = []
        self._closed = False

    def __enter__(self) -> Proxy:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._whole.set()
        self._close([self._listening, *self._sockets])

    def cut(self) -> None:
        """Nothing goes through any more, and nobody is told."""
        self._whole.clear()

    def mend(self) -> None:
        """The old connections are gone, new ones go through."""
        old, self._sockets = self._sockets, []
        self._whole.set()
        self._close(old)

    def _accept(self) -> None:
        while not self._closed:
            try:
                near, _ = self._listening.accept()
                far = socket.create_connection(("127.0.0.1", self._to))
            except OSError:
                continue
            self._sockets += [near, far]
            for source, sink in ((near, far), (far, near)):
                threading.Thread(target=self._pump, args=(source, sink), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while self._whole.wait() and (data := source.recv(BUFFER_BYTES)):
                self._whole.wait()
                sink.sendall(data)
        self._close([source, sink])

    def _close(self, sockets: list[socket.socket]) -> None:
        for each in sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

"""A TCP proxy that can interrupt the connection without closing it, as an unplugged cable does, and restore it."""

from __future__ import annotations

import contextlib
import socket
import threading

BUFFER_BYTES = 16_384


class Proxy:
    """`with Proxy(port) as proxy`: forwards proxy.port to port."""

    def __init__(self, port: int) -> None:
        self._to = port
        self._listening = socket.socket()
        self._listening.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, BUFFER_BYTES)
        self._listening.bind(("127.0.0.1", 0))
        self._listening.listen()
        self.port = self._listening.getsockname()[1]
        self._forwarding = threading.Event()
        self._forwarding.set()
        self._sockets: list[socket.socket] = []
        self._closed = False

    def __enter__(self) -> Proxy:
        threading.Thread(target=self._accept, daemon=True).start()
        return self

    def __exit__(self, *_: object) -> None:
        self._closed = True
        self._forwarding.set()
        self._close([self._listening, *self._sockets])

    def interrupt(self) -> None:
        """Stop forwarding; both connections stay open."""
        self._forwarding.clear()

    def restore(self) -> None:
        """Close the old connections and accept new ones."""
        old, self._sockets = self._sockets, []
        self._forwarding.set()
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
            while self._forwarding.wait() and (data := source.recv(BUFFER_BYTES)):
                self._forwarding.wait()
                sink.sendall(data)
        self._close([source, sink])

    def _close(self, sockets: list[socket.socket]) -> None:
        for each in sockets:
            with contextlib.suppress(OSError):
                each.shutdown(socket.SHUT_RDWR)
            each.close()

"""A TCP client as a line. Closing it throws away what the other side has not acknowledged.

Source: ours; tcp(7) SIOCOUTQ for what has not been; socket(7) SO_LINGER.
"""

from __future__ import annotations

import fcntl
import select
import socket
import struct
import termios

from flow.link import LinkError
from links.mavlink.transport.connection import Endpoint

CHUNK_BYTES = 4096
TCP_BACKLOG_BYTES = 512  # not through yet: two poses more
CONNECT_S, RECONNECT_S = 2.0, 0.4  # the first time, and while a listener may be waiting to be closed
THROWN_AWAY = struct.pack("ii", 1, 0)  # struct linger: closing ends it at once


class TcpLine:
    """A TCP client."""

    backlog_bytes = TCP_BACKLOG_BYTES

    def __init__(self, endpoint: Endpoint) -> None:
        self.name = f"{endpoint.host}:{endpoint.port}"
        self._address = (endpoint.host, endpoint.port)
        self._socket: socket.socket | None = None
        self._connect_s = CONNECT_S

    def open(self) -> None:
        """Connect. LinkError."""
        try:
            self._socket = socket.create_connection(self._address, self._connect_s)
        except OSError as error:
            reason = error.strerror or str(error)
            raise LinkError(
                f"cannot connect to TCP {self.name}: {reason}. Does the autopilot's bridge or simulator run there? "
                "Check `connection`."
            ) from None
        self._connect_s = RECONNECT_S
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, THROWN_AWAY)
        self._socket.setblocking(False)

    def read(self, timeout_s: float) -> bytes:
        """What has arrived. OSError: it is gone."""
        line = self._there()
        if not select.select([line], [], [], timeout_s)[0]:
            return b""
        data = line.recv(CHUNK_BYTES)
        if not data:
            raise ConnectionResetError("closed by the other side")
        return data

    def write(self, data: bytes) -> int:
        """Bytes taken."""
        try:
            return self._there().send(data)
        except BlockingIOError:
            return 0

    def waiting_bytes(self) -> int:
        """Bytes that the other side has not acknowledged."""
        return struct.unpack("i", fcntl.ioctl(self._there(), termios.TIOCOUTQ, b"\0\0\0\0"))[0]

    def close(self) -> None:
        """Disconnect. What the other side has not acknowledged is thrown away."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _there(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionResetError("not connected")
        return self._socket

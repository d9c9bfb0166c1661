"""TCP client line. Closing it discards the bytes that the peer has not acknowledged.

Source: tcp(7), SIOCOUTQ; socket(7), SO_LINGER.
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
TCP_BACKLOG_BYTES = 512  # limit before a new frame: two poses
CONNECT_S, RECONNECT_S = 2.0, 0.4  # at the start, and when a reader reopens the line
DISCARD = struct.pack("ii", 1, 0)  # struct linger: closing resets the connection


class TcpLine:
    """A TCP client."""

    backlog_bytes = TCP_BACKLOG_BYTES

    def __init__(self, endpoint: Endpoint) -> None:
        self.name = f"{endpoint.host}:{endpoint.port}"
        self._address = (endpoint.host, endpoint.port)
        self._socket: socket.socket | None = None
        self._connect_s = CONNECT_S

    def open(self) -> None:
        """Connect. Raises LinkError."""
        try:
            self._socket = socket.create_connection(self._address, self._connect_s)
        except OSError as error:
            reason = error.strerror or str(error)
            raise LinkError(
                f"cannot connect to TCP {self.name}: {reason}. Is the autopilot's bridge or simulator running there? "
                "Check `connection`."
            ) from None
        self._connect_s = RECONNECT_S
        self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, DISCARD)
        self._socket.setblocking(False)

    def read(self, timeout_s: float) -> bytes:
        """Received bytes. Raises OSError when the line is lost."""
        line = self._opened()
        if not select.select([line], [], [], timeout_s)[0]:
            return b""
        data = line.recv(CHUNK_BYTES)
        if not data:
            raise ConnectionResetError("closed by the peer")
        return data

    def write(self, data: bytes) -> int:
        """Write without blocking; returns the number of accepted bytes."""
        try:
            return self._opened().send(data)
        except BlockingIOError:
            return 0

    def buffered_bytes(self) -> int:
        """Bytes that the peer has not acknowledged."""
        return struct.unpack("i", fcntl.ioctl(self._opened(), termios.TIOCOUTQ, b"\0\0\0\0"))[0]

    def close(self) -> None:
        """Disconnect and discard unacknowledged bytes."""
        if self._socket is not None:
            self._socket.close()
            self._socket = None

    def _opened(self) -> socket.socket:
        if self._socket is None:
            raise ConnectionResetError("not connected")
        return self._socket

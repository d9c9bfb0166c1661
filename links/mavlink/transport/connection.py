"""Connection to the autopilot: the protocol of all transports, the parser of connection strings, and UDP.

    udpin:127.0.0.1:14550        listen on a local port; beyond loopback only `sender` is accepted
    udpout:192.168.1.5:14550     send to this address; other senders are ignored
    tcp:127.0.0.1:5760           TCP client
    serial:/dev/ttyUSB0:921600   device and baud rate

Sending never blocks, and send buffers are small: the autopilot would treat a pose that arrives late as current. TCP and
serial are in `stream_connection.py`.

Source: mavutil's syntax of connection strings. mavutil's own connections are not used: they reply to the newest sender,
block while they reconnect, and print.
"""

from __future__ import annotations

import select
import socket
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Literal, Protocol

from flow.link import LinkError

DATAGRAM_BYTES = 2048
UDP_BACKLOG_BYTES = 4096  # doubled by Linux: about six frames can wait for a slow radio or an unanswered ARP request
DEFAULT_BAUD = 921_600

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Endpoint:
    """A parsed connection string."""

    kind: Literal["udpin", "udpout", "tcp", "serial"]
    host: str  # or the device
    port: int  # or the baud rate


def parse_connection(text: str) -> Endpoint:
    """Parse a connection string. Raises ValueError with the syntax."""
    kind, _, rest = text.partition(":")
    host, colon, number = rest.rpartition(":")
    if kind == "serial" and rest and not number.isdigit():
        return Endpoint("serial", rest, DEFAULT_BAUD)
    if kind not in ("udpin", "udpout", "tcp", "serial") or not colon or not host or not number.isdigit():
        raise ValueError(
            f"must be udpin:127.0.0.1:14550, udpout:HOST:PORT, tcp:HOST:PORT or serial:/dev/ttyUSB0:921600, "
            f"not {text!r}"
        )
    if kind == "serial":
        return Endpoint("serial", host, int(number))
    if not 0 <= int(number) <= 65_535 or (kind != "udpin" and number == "0"):
        raise ValueError(f"{number} is not a port")
    if kind == "udpin":
        IPv4Address(host)  # a local address, not a name
    return Endpoint("udpin" if kind == "udpin" else "udpout" if kind == "udpout" else "tcp", host, int(number))


class Connection(Protocol):
    """Bytes to and from the autopilot. `receive` is called by one thread, `send` by others."""

    datagrams: bool
    reconnects: int
    foreign: int  # datagrams from other senders, ignored
    stalls: int  # how often it was closed because it was blocked
    late_frames: int  # frames that were sent more than MAX_LATENCY_NS late, as far as is known

    @property
    def status(self) -> str | None:
        """Error text; None: it works."""
        ...

    def receive(self, timeout_s: float) -> tuple[bytes, Address] | None:
        """Received bytes and their source; None: nothing within timeout_s."""
        ...

    def reply_to(self, source: Address) -> None:
        """Set the destination: the source of the autopilot's frames."""

    def send(self, frame: bytes) -> bool:
        """Send a frame now or not at all. False: no destination, or the send buffer is full."""
        ...

    def close(self) -> None:
        """Close it."""


class Udp:
    """One UDP socket."""

    datagrams = True
    status: str | None = None

    def __init__(self, endpoint: Endpoint, sender: IPv4Address | None) -> None:
        self.reconnects = self.foreign = self.stalls = self.late_frames = 0
        self._only = None if sender is None else str(sender)
        self._peer: Address | None = None
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, UDP_BACKLOG_BYTES)
        try:
            if endpoint.kind == "udpin":
                self._socket.bind((endpoint.host, endpoint.port))
            else:
                self._peer = (socket.gethostbyname(endpoint.host), endpoint.port)
                self._only = self._peer[0]
        except OSError as error:
            self._socket.close()
            verb = "listen on" if endpoint.kind == "udpin" else "send to"
            raise LinkError(
                f"cannot {verb} UDP {endpoint.host}:{endpoint.port}: {error.strerror}. Is another program listening "
                "there, and is the address right? Check `connection`."
            ) from None
        self._fixed = endpoint.kind == "udpout"
        self._socket.setblocking(False)

    @property
    def port(self) -> int:
        """Local port."""
        return self._socket.getsockname()[1]

    def receive(self, timeout_s: float) -> tuple[bytes, Address] | None:
        """See Connection."""
        try:
            ready, _, _ = select.select([self._socket], [], [], timeout_s)
            if not ready:
                return None
            data, source = self._socket.recvfrom(DATAGRAM_BYTES)
        except (BlockingIOError, ConnectionRefusedError):
            return None  # the destination port is closed
        except (OSError, ValueError) as error:  # closed by another thread
            raise LinkError(f"UDP: {error}: is the network interface still up?") from None
        if (self._only is not None and source[0] != self._only) or (self._fixed and source != self._peer):
            self.foreign += 1
            return None
        return data, source

    def reply_to(self, source: Address) -> None:
        """See Connection."""
        if not self._fixed:
            self._peer = source

    def send(self, frame: bytes) -> bool:
        """See Connection."""
        if self._peer is None:
            return False
        try:
            return self._socket.sendto(frame, self._peer) == len(frame)
        except OSError:  # full, unreachable, or closed: the next frame may succeed
            return False

    def close(self) -> None:
        """See Connection."""
        self._socket.close()

"""Where the autopilot is, and the bytes to and from it: UDP, TCP, serial.

    udpin:127.0.0.1:14550        wait for it on a port of this host; beyond loopback only `sender` is heard
    udpout:192.168.1.5:14550     send to it there; nobody else is heard
    tcp:127.0.0.1:5760           connect to it
    serial:/dev/ttyUSB0:921600   baud rate after the device

Sending never waits, and little of what was sent waits for the line: a pose that comes late is taken for new. UDP is
here, TCP and serial are in `lines.py`.

Source: ours; mavutil's names for connections. mavutil's own connections answer whoever spoke last, wait while they
reconnect and print.
"""

from __future__ import annotations

import select
import socket
from dataclasses import dataclass
from ipaddress import IPv4Address
from typing import Literal, Protocol

from flow.link import LinkError

DATAGRAM_BYTES = 2048
UDP_BACKLOG_BYTES = 4096  # Linux doubles it: some six frames may wait for a slow radio, or for who does not answer ARP
DEFAULT_BAUD = 921_600

Source_ = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Endpoint:
    """One connection as it is written in a configuration."""

    kind: Literal["udpin", "udpout", "tcp", "serial"]
    host: str  # or the device
    port: int  # or the baud rate


def parse_connection(text: str) -> Endpoint:
    """What a connection's text says. ValueError with the way to write it."""
    kind, _, rest = text.partition(":")
    host, colon, number = rest.rpartition(":")
    if kind == "serial" and rest and not number.isdigit():
        return Endpoint("serial", rest, DEFAULT_BAUD)
    if kind not in ("udpin", "udpout", "tcp", "serial") or not colon or not host or not number.isdigit():
        raise ValueError(
            f"write it as udpin:127.0.0.1:14550, udpout:HOST:PORT, tcp:HOST:PORT or serial:/dev/ttyUSB0:921600, "
            f"not {text!r}"
        )
    if kind == "serial":
        return Endpoint("serial", host, int(number))
    if not 0 <= int(number) <= 65_535 or (kind != "udpin" and number == "0"):
        raise ValueError(f"{number} is no port")
    if kind == "udpin":
        IPv4Address(host)  # an address of this host, not a name
    return Endpoint("udpin" if kind == "udpin" else "udpout" if kind == "udpout" else "tcp", host, int(number))


class Connection(Protocol):
    """Bytes to and from the autopilot. `receive` is called from one thread, `send` from others."""

    datagrams: bool
    reconnects: int
    foreign: int  # datagrams from others, not read
    stalls: int  # times it stood still and was dropped
    left_late: int  # frames that waited longer for the line than LATE_NS, as far as is known

    @property
    def status(self) -> str | None:
        """What is wrong with it, in words; None: nothing."""
        ...

    def receive(self, timeout_s: float) -> tuple[bytes, Source_] | None:
        """What has arrived and from where; None: nothing within timeout_s."""
        ...

    def answer_to(self, source: Source_) -> None:
        """The autopilot spoke from there."""

    def send(self, frame: bytes) -> bool:
        """Send a frame now or not at all. False: nobody is there, or the line is slower than we send."""
        ...

    def close(self) -> None:
        """Let go of it."""


class Udp:
    """One UDP socket."""

    datagrams = True
    status: str | None = None

    def __init__(self, endpoint: Endpoint, sender: IPv4Address | None) -> None:
        self.reconnects = self.foreign = self.stalls = self.left_late = 0
        self._only = None if sender is None else str(sender)
        self._peer: Source_ | None = None
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
        """Our own port."""
        return self._socket.getsockname()[1]

    def receive(self, timeout_s: float) -> tuple[bytes, Source_] | None:
        """See Connection."""
        try:
            ready, _, _ = select.select([self._socket], [], [], timeout_s)
            if not ready:
                return None
            data, source = self._socket.recvfrom(DATAGRAM_BYTES)
        except (BlockingIOError, ConnectionRefusedError):
            return None  # the other side's port is closed just now
        except (OSError, ValueError) as error:  # closed by another thread
            raise LinkError(f"UDP: {error}: is the network interface still up?") from None
        if (self._only is not None and source[0] != self._only) or (self._fixed and source != self._peer):
            self.foreign += 1
            return None
        return data, source

    def answer_to(self, source: Source_) -> None:
        """See Connection."""
        if not self._fixed:
            self._peer = source

    def send(self, frame: bytes) -> bool:
        """See Connection."""
        if self._peer is None:
            return False
        try:
            return self._socket.sendto(frame, self._peer) == len(frame)
        except OSError:  # full, unreachable, or closed: the next frame may pass
            return False

    def close(self) -> None:
        """See Connection."""
        self._socket.close()

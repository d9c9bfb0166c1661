"""Live LiDAR packets from UDP sockets, from one sender, with the kernel's arrival stamps.

Nothing is queued here. Packets that the consumer does not take in time wait in the socket's bounded buffer; when it is
full the kernel drops them, and the decoder counts them from the gap in device time.

Source: VLP-16 User Manual 63-9243 Rev. E, section 9.3 (ports).
"""

from __future__ import annotations

import errno
import socket
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import NamedTuple

from flow.link import WAKE_S, LinkError, PolledRecords, Record
from links.clock import datagram_time

FirstPulse = Callable[[int, bytes], int]  # time of the first pulse from arrival [ns] and payload
Accepts = Callable[[Record], bool]  # LinkError: the sensor is not ready
RECEIVE_BUFFER_BYTES = 1 << 20  # as far as the host's net.core.rmem_max allows it
_DATAGRAM_BYTES = 65_536  # an Ouster's packets are up to 33 kB


@dataclass(slots=True)
class UdpCounters:
    """Counters of a listener."""

    received: int = 0
    foreign: int = 0  # ignored, not from the expected sender
    last_foreign: str = ""


class Channel(NamedTuple):
    """One UDP port and the topic of its records."""

    topic: str
    port: int
    buffer_bytes: int = RECEIVE_BUFFER_BYTES


@contextmanager
def listen_udp(
    channels: Sequence[Channel],
    bind: str,
    sender: str | None,
    timeout_s: float,
    counters: UdpCounters,
    first_pulse_ns: FirstPulse,
    accepts: Accepts,
) -> Iterator[PolledRecords]:
    """Open a socket per channel and yield the records that are accepted; they end with the context.

    Raises LinkError when a socket cannot be opened, or when nothing arrives on the first channel for timeout_s.
    `record.stamp_ns` is when the packet's first laser fired, estimated from its arrival (`first_pulse_ns`).
    """
    with ExitStack() as stack:
        sockets = {stack.enter_context(_open(bind, channel)): channel for channel in channels}
        packets = Packets(sockets, sender, timeout_s, counters, first_pulse_ns, accepts)
        try:
            yield packets
        finally:
            packets.closed.set()


def _open(bind: str, channel: Channel) -> socket.socket:
    port = channel.port
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, channel.buffer_bytes)
        datagram_time.enable_stamps(udp)
        udp.bind((bind, port))
    except OSError as error:
        udp.close()
        raise LinkError(f"cannot listen on UDP {bind}:{port}: {error.strerror}. {_bind_advice(error)}") from error
    udp.setblocking(False)
    return udp


def _bind_advice(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "Is another grd or a viewer already listening there?"
    if error.errno == errno.EADDRNOTAVAIL:
        return "Set `bind` to an address of this host (see `ip address`)."
    return "Check `bind` and `port`."


class Packets(PolledRecords):
    """Records of the packets of some sockets. LinkError when the first one's have ended for `timeout_s`."""

    def __init__(
        self,
        sockets: dict[socket.socket, Channel],
        sender: str | None,
        timeout_s: float,
        counters: UdpCounters,
        first_pulse_ns: FirstPulse,
        accepts: Accepts,
    ) -> None:
        super().__init__()
        self._sockets, self._first = sockets, next(iter(sockets.values()))
        self._sender, self._timeout_s, self._counters = sender, timeout_s, counters
        self._first_pulse_ns, self._accepts = first_pulse_ns, accepts
        self._received_s = time.monotonic()  # the newest packet of the first socket
        self._foreign_before = counters.foreign

    @property
    def files(self) -> list[socket.socket]:
        """See PolledRecords."""
        return list(self._sockets)

    @property
    def wait_s(self) -> float:
        """See PolledRecords."""
        return min(WAKE_S, self._timeout_s)

    def pending(self) -> Iterator[Record]:
        """See PolledRecords."""
        for udp, channel in self._sockets.items():
            try:
                for data, arrival_ns, host in datagram_time.pending(udp, _DATAGRAM_BYTES):
                    record = self._record(channel, data, arrival_ns, host)
                    if record is not None and self._accepts(record):
                        yield record
            except OSError as error:
                raise LinkError(f"UDP {channel.port}: {error}: is the network interface still up?") from error
        if time.monotonic() > self._received_s + self._timeout_s:
            foreign = self._counters.foreign - self._foreign_before
            port, last = self._first.port, self._counters.last_foreign
            raise LinkError(_timeout_text(port, self._sender, self._timeout_s, foreign, last))

    def _record(self, channel: Channel, data: bytes, arrival_ns: int, host: str) -> Record | None:
        counters = self._counters
        if self._sender is not None and host != self._sender:
            counters.foreign += 1
            counters.last_foreign = host
            return None
        if channel is self._first:
            self._received_s, self._foreign_before = time.monotonic(), counters.foreign
        counters.received += 1
        return Record(channel.topic, arrival_ns, self._first_pulse_ns(arrival_ns, data), data, counters.received - 1)


def _timeout_text(port: int, sender: str | None, timeout_s: float, foreign: int, last_foreign: str) -> str:
    if foreign:
        return (
            f"no packet from {sender} on UDP {port} for {timeout_s:g} s, but {foreign} from others "
            f"(last {last_foreign}): is `sender` the LiDAR's address?"
        )
    return (
        f"no packet on UDP {port} for {timeout_s:g} s: is the LiDAR powered, and is this host on its subnet? "
        "If it broadcasts, set this host as its destination, or `bind: 0.0.0.0`."
    )

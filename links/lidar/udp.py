"""Live LiDAR packets from UDP sockets, from one sender, with the kernel's arrival stamps.

Nothing is queued here. Packets that the consumer does not take in time wait in the socket's bounded buffer; when it is
full the kernel drops them, and the decoder counts them from the gap in device time.

Source: VLP-16 User Manual 63-9243 Rev. E, section 9.3 (ports).
"""

from __future__ import annotations

import errno
import select
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from typing import Any, NamedTuple

from flow.link import LinkError, Record
from links.clock import datagram_time

FirstPulse = Callable[[int, bytes], int]  # time of the first pulse from arrival [ns] and payload
RECEIVE_BUFFER_BYTES = 1 << 20  # 0.6 s of packets, if the host's net.core.rmem_max allows it
_DATAGRAM_BYTES = 65_536  # an Ouster's packets are up to 33 kB
_BURST = 16  # datagrams read per `select`: a call of `select` costs as much as reading a datagram
_WAKE_S = 0.2  # how often a waiting listener checks whether it was closed


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


@contextmanager
def listen_udp(
    channels: Sequence[Channel],
    bind: str,
    sender: str | None,
    timeout_s: float,
    counters: UdpCounters,
    first_pulse_ns: FirstPulse,
) -> Iterator[Iterator[Record]]:
    """Open a socket per channel and yield an iterator of records.

    Raises LinkError when a socket cannot be opened, or when nothing arrives on the first channel for timeout_s.
    `record.stamp_ns` is when the packet's first laser fired, estimated from its arrival (`first_pulse_ns`).
    The iterator ends when the context is left, also from another thread.
    """
    closed = threading.Event()
    with ExitStack() as stack:
        sockets = {stack.enter_context(_open(bind, channel.port)): channel for channel in channels}
        try:
            yield _records(sockets, closed, sender, timeout_s, counters, first_pulse_ns)
        finally:
            closed.set()


def _open(bind: str, port: int) -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
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


def _records(
    sockets: dict[socket.socket, Channel],
    closed: threading.Event,
    sender: str | None,
    timeout_s: float,
    counters: UdpCounters,
    first_pulse_ns: FirstPulse,
) -> Iterator[Record]:
    first = next(iter(sockets.values()))
    deadline_s = time.monotonic() + timeout_s
    foreign_before = counters.foreign
    while not closed.is_set():
        try:
            ready, _, _ = select.select(list(sockets), [], [], min(_WAKE_S, timeout_s))
            received = [(sockets[udp], datagram) for udp in ready for datagram in _pending(udp)]
        except (OSError, ValueError) as error:
            if closed.is_set():
                return
            raise LinkError(f"UDP {first.port}: {error}: is the network interface still up?") from error
        for channel, (data, ancillary, _, (host, _)) in received:
            if sender is not None and host != sender:
                counters.foreign += 1
                counters.last_foreign = host
                continue
            arrival_ns = datagram_time.arrival_ns(ancillary)
            stamp_ns = first_pulse_ns(arrival_ns, data)
            yield Record(channel.topic, arrival_ns, stamp_ns, data, counters.received)
            counters.received += 1
            if channel is first:
                deadline_s = time.monotonic() + timeout_s
                foreign_before = counters.foreign
        if time.monotonic() > deadline_s:
            foreign = counters.foreign - foreign_before
            raise LinkError(_timeout_text(first.port, sender, timeout_s, foreign, counters.last_foreign))


def _pending(udp: socket.socket) -> Iterator[Any]:
    """The datagrams in the buffer, as `recvmsg` returns them; none if the kernel discarded a damaged one."""
    try:
        for _ in range(_BURST):
            yield udp.recvmsg(_DATAGRAM_BYTES, datagram_time.ANCILLARY_BYTES)
    except BlockingIOError:
        return


def _timeout_text(port: int, sender: str | None, timeout_s: float, foreign: int, last_foreign: str) -> str:
    if foreign:
        return (
            f"no packet from {sender} on UDP {port} for {timeout_s:g} s, but {foreign} from others "
            f"(last {last_foreign}): is `sender` the LiDAR's address?"
        )
    return f"no packet on UDP {port} for {timeout_s:g} s: is the LiDAR powered, and is this host on its subnet?"

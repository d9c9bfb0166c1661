"""Live VLP-16 packets from a UDP socket, from one sender, stamped by the kernel when they arrived.

Nothing is queued here: what the consumer does not take in time waits in the socket's bounded buffer, then the kernel
drops it, and the decoder counts it from the gap in device time.

Source: VLP-16 User Manual 63-9243 Rev. E, section 9.3 (ports); socket(7), SO_TIMESTAMPNS.
"""

from __future__ import annotations

import errno
import socket
import struct
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from flow.link import LinkError, Record
from links.velodyne import vlp16

RECEIVE_BUFFER_BYTES = 1 << 20  # 0.6 s of packets, where the host's net.core.rmem_max allows it
_DATAGRAM_BYTES = 2048
_WAKE_S = 0.2  # how often a waiting listener looks whether it was closed

_SO_TIMESTAMPNS = 35 if sys.platform == "linux" else None  # asm-generic/socket.h; Python does not name it
_TIMESPEC = struct.Struct("@ll")


@dataclass(slots=True)
class UdpCounters:
    """What a listener saw."""

    received: int = 0
    foreign: int = 0  # ignored: not from the expected sender
    last_foreign: str = ""


@contextmanager
def listen_udp(
    topic: str, bind: str, port: int, sender: str | None, timeout_s: float, counters: UdpCounters
) -> Iterator[Iterator[Record]]:
    """Open the socket and yield an iterator of records. LinkError when it cannot open, or nothing comes for timeout_s.

    `record.stamp_ns` is when the packet's first laser fired as far as its arrival tells (`vlp16.first_pulse_ns`).
    The iterator ends when the context is left, also from another thread.
    """
    closed = threading.Event()
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as udp:
        udp.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER_BYTES)
        if _SO_TIMESTAMPNS is not None:
            udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        try:
            udp.bind((bind, port))
        except OSError as error:
            raise LinkError(f"cannot listen on UDP {bind}:{port}: {error.strerror}. {_bind_advice(error)}") from error
        udp.settimeout(min(_WAKE_S, timeout_s))
        try:
            yield _records(udp, closed, topic, port, sender, timeout_s, counters)
        finally:
            closed.set()


def _bind_advice(error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return "Is another grd or a viewer already listening there?"
    if error.errno == errno.EADDRNOTAVAIL:
        return "Set `bind` to an address of this host (see `ip address`)."
    return "Check `bind` and `port`."


def _records(
    udp: socket.socket,
    closed: threading.Event,
    topic: str,
    port: int,
    sender: str | None,
    timeout_s: float,
    counters: UdpCounters,
) -> Iterator[Record]:
    deadline_s = time.monotonic() + timeout_s
    foreign_before = counters.foreign
    while not closed.is_set():
        try:
            data, ancillary, _, (host, _) = udp.recvmsg(_DATAGRAM_BYTES, 64)
        except TimeoutError:
            data = None
        except OSError as error:
            if closed.is_set():
                return
            raise LinkError(f"UDP {port}: {error.strerror}: is the network interface still up?") from error
        if data is not None and (sender is None or host == sender):
            arrival_ns = _kernel_time_ns(ancillary) or time.time_ns()
            yield Record(topic, arrival_ns, vlp16.first_pulse_ns(arrival_ns, data), data, counters.received)
            counters.received += 1
            deadline_s = time.monotonic() + timeout_s
            foreign_before = counters.foreign
            continue
        if data is not None:
            counters.foreign += 1
            counters.last_foreign = host
        if time.monotonic() > deadline_s:
            raise LinkError(_silence(port, sender, timeout_s, counters.foreign - foreign_before, counters.last_foreign))


def _kernel_time_ns(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(value) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(value)
            return 1_000_000_000 * seconds + nanoseconds
    return None


def _silence(port: int, sender: str | None, timeout_s: float, foreign: int, last_foreign: str) -> str:
    if foreign:
        return (
            f"no packet from {sender} on UDP {port} for {timeout_s:g} s, but {foreign} from others "
            f"(last {last_foreign}): is `sender` the lidar's address?"
        )
    return f"no packet on UDP {port} for {timeout_s:g} s: is the lidar powered, and is this host on its subnet?"

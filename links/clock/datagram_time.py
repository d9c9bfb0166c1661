"""Datagrams with their arrival time by the kernel's stamp, so that a delayed reader does not delay the stamp.

The kernel stamps with the wall clock; `host_time.py` converts that to the host's timeline, which no step of the wall
clock changes. Where the kernel gives no stamp, the time of reading is used. That is also the case for a short time
after the stamps are enabled: a kernel worker enables them asynchronously.

Source: socket(7), SO_TIMESTAMPNS; Linux, net/core/dev.c, net_enable_timestamp.
"""

from __future__ import annotations

import socket
import struct
import sys
from collections.abc import Iterator
from typing import NamedTuple

from links.clock import host_time

ANCILLARY_BYTES = 64  # buffer size for the stamp, an argument of `recvmsg`
BURST = 16  # datagrams read at a time: a call of `select` costs as much as reading a datagram
_SO_TIMESTAMPNS = 35 if sys.platform == "linux" else None  # asm-generic/socket.h; not in Python's socket module
_TIMESPEC = struct.Struct("@ll")


def enable_stamps(udp: socket.socket) -> None:
    """Make the kernel stamp arriving datagrams. Raises OSError when the kernel does not support it."""
    if _SO_TIMESTAMPNS is not None:
        udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


class Datagram(NamedTuple):
    """A datagram and its arrival."""

    data: bytes
    arrival_ns: int  # host time
    host: str  # address of the sender


def pending(udp: socket.socket, max_bytes: int) -> Iterator[Datagram]:
    """Datagrams in the buffer of a socket that does not block, at most BURST. OSError: the socket has failed.

    None where the kernel discarded a damaged one.
    """
    for _ in range(BURST):
        try:
            data, ancillary, _, (host, _) = udp.recvmsg(max_bytes, ANCILLARY_BYTES)
        except BlockingIOError:
            return
        yield Datagram(data, arrival_ns(ancillary), host)


def arrival_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """Arrival of a datagram that was just read, in host time, by the ancillary data of its `recvmsg`."""
    stamp_ns = kernel_time_ns(ancillary)
    return host_time.now_ns() if stamp_ns is None else host_time.from_wall_ns(stamp_ns)


def kernel_time_ns(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    """The kernel's stamp on the wall clock; None: the datagram has no stamp."""
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(value) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(value)
            return 1_000_000_000 * seconds + nanoseconds
    return None

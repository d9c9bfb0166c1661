"""Arrival time of a datagram by the kernel's stamp, so that a delayed reader thread does not delay the stamp.

The kernel stamps with the wall clock; `host_time.py` converts that to the host's timeline, which no step of the wall
clock changes. Where the kernel gives no stamp, the time of reading is used. That is also the case for a short time
after the stamps are enabled: a kernel worker enables them asynchronously.

Source: socket(7), SO_TIMESTAMPNS; Linux, net/core/dev.c, net_enable_timestamp.
"""

from __future__ import annotations

import socket
import struct
import sys

from links.clock import host_time

ANCILLARY_BYTES = 64  # buffer size for the stamp, an argument of `recvmsg`
_SO_TIMESTAMPNS = 35 if sys.platform == "linux" else None  # asm-generic/socket.h; not in Python's socket module
_TIMESPEC = struct.Struct("@ll")


def enable_stamps(udp: socket.socket) -> None:
    """Make the kernel stamp arriving datagrams. Raises OSError when the kernel does not support it."""
    if _SO_TIMESTAMPNS is not None:
        udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


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

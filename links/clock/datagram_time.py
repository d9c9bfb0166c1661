"""When a datagram arrived, as the kernel stamped it: a thread that comes late does not make it later.

The kernel stamps with the wall clock; `host_time.py` makes of it a time that a step of that clock does not move.
Where the kernel does not stamp, it is when the datagram was read; so it is in the first moments after it was asked to:
a worker of its own turns that on.

Source: socket(7), SO_TIMESTAMPNS; Linux, net/core/dev.c, net_enable_timestamp.
"""

from __future__ import annotations

import socket
import struct
import sys

from links.clock import host_time

ANCILLARY_BYTES = 64  # room for the stamp, for `recvmsg`
_SO_TIMESTAMPNS = 35 if sys.platform == "linux" else None  # asm-generic/socket.h; Python does not name it
_TIMESPEC = struct.Struct("@ll")


def ask_for_stamps(udp: socket.socket) -> None:
    """Have the kernel stamp what arrives. OSError when it will not."""
    if _SO_TIMESTAMPNS is not None:
        udp.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)


def arrival_ns(ancillary: list[tuple[int, int, bytes]]) -> int:
    """When a datagram just read arrived, host time, by the ancillary data of its `recvmsg`."""
    stamp_ns = kernel_time_ns(ancillary)
    return host_time.now_ns() if stamp_ns is None else host_time.from_wall_ns(stamp_ns)


def kernel_time_ns(ancillary: list[tuple[int, int, bytes]]) -> int | None:
    """The kernel's stamp, wall clock; None: it gave none."""
    for level, kind, value in ancillary:
        if level == socket.SOL_SOCKET and kind == _SO_TIMESTAMPNS and len(value) == _TIMESPEC.size:
            seconds, nanoseconds = _TIMESPEC.unpack(value)
            return 1_000_000_000 * seconds + nanoseconds
    return None

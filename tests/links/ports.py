"""Unused ports of this host, and datagrams to them."""

from __future__ import annotations

import socket
from contextlib import ExitStack


def free_ports(count: int, kind: socket.SocketKind = socket.SOCK_DGRAM) -> list[int]:
    """Different unused ports for UDP or (SOCK_STREAM) TCP."""
    with ExitStack() as stack:
        probes = [stack.enter_context(socket.socket(socket.AF_INET, kind)) for _ in range(count)]
        for probe in probes:
            probe.bind(("127.0.0.1", 0))
        return [probe.getsockname()[1] for probe in probes]


def free_port(kind: socket.SocketKind = socket.SOCK_DGRAM) -> int:
    return free_ports(1, kind)[0]


def send(port: int, *datagrams: bytes, host: str = "127.0.0.1") -> None:
    """Send datagrams to a port of this host from one of its loopback addresses."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.bind((host, 0))
        for data in datagrams:
            sender.sendto(data, ("127.0.0.1", port))

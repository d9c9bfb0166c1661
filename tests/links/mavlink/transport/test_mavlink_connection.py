"""Connections to the autopilot: accepted senders, reopening after a loss, and that sending never blocks."""

from __future__ import annotations

import contextlib
import fcntl
import os
import pty
import select
import socket
import struct
import subprocess
import sys
import termios
import threading
from concurrent.futures import ThreadPoolExecutor
from ipaddress import IPv4Address

import pytest

from flow.link import LinkError
from links.mavlink.transport.connection import Connection, Endpoint, Udp, parse_connection
from links.mavlink.transport.serial_line import SERIAL_BACKLOG_BYTES
from links.mavlink.transport.stream_connection import MAX_STALL_S, StreamConnection, open_connection
from links.mavlink.transport.tcp_line import TCP_BACKLOG_BYTES

FRAME = bytes(244)
UNSHARE = ("unshare", "-n") if os.geteuid() == 0 else ("unshare", "-rn")
OWN_NETWORK = "ip link add grd0 type veth peer grd1 && ip link set grd0 up && ip link set grd1 up"


def own_network() -> bool:
    """Whether this host allows a network namespace with an unconnected interface."""
    try:
        run = subprocess.run([*UNSHARE, "sh", "-c", OWN_NETWORK], capture_output=True, check=False)
    except FileNotFoundError:
        return False
    return run.returncode == 0


@pytest.mark.parametrize(
    ("text", "endpoint"),
    [
        ("udpin:127.0.0.1:14550", Endpoint("udpin", "127.0.0.1", 14550)),
        ("udpout:drone.local:14550", Endpoint("udpout", "drone.local", 14550)),
        ("tcp:10.0.0.1:5760", Endpoint("tcp", "10.0.0.1", 5760)),
        ("serial:/dev/ttyUSB0:57600", Endpoint("serial", "/dev/ttyUSB0", 57600)),
        ("serial:/dev/ttyACM0", Endpoint("serial", "/dev/ttyACM0", 921600)),
    ],
)
def test_connection_strings_have_mavutils_syntax(text: str, endpoint: Endpoint):
    assert parse_connection(text) == endpoint


@pytest.mark.parametrize(
    "text",
    ["", "udp:1:2", "udpin:14550", "udpin:host:14550", "udpout:1.2.3.4:0", "tcp:1.2.3.4:70000", "serial:", "tcp::1"],
)
def test_an_invalid_connection_string_is_rejected(text: str):
    with pytest.raises(ValueError):
        parse_connection(text)


def udp_pair(host: str = "127.0.0.1") -> tuple[Udp, socket.socket]:
    link = open_connection(parse_connection("udpin:127.0.0.1:0"))
    assert isinstance(link, Udp)
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    other.bind((host, 0))
    other.settimeout(5.0)
    return link, other


def test_udp_sends_to_the_autopilot_and_to_nobody_before_its_first_frame():
    link, drone = udp_pair()
    assert not link.send(b"pose")
    drone.sendto(b"hello", ("127.0.0.1", link.port))
    received = link.receive(5.0)
    assert received == (b"hello", drone.getsockname())
    link.reply_to(received[1])
    assert link.send(b"pose")
    assert drone.recv(100) == b"pose"
    link.close()
    drone.close()


def test_udp_accepts_only_its_sender():
    link = Udp(Endpoint("udpin", "127.0.0.1", 0), IPv4Address("127.0.0.9"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_sender:
        other_sender.sendto(b"land now", ("127.0.0.1", link.port))
        assert link.receive(5.0) is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as drone:
        drone.bind(("127.0.0.9", 0))
        drone.sendto(b"hello", ("127.0.0.1", link.port))
        assert link.receive(5.0) == (b"hello", drone.getsockname())
    assert link.foreign == 1
    link.close()


def test_udp_out_accepts_only_its_destination_and_survives_a_closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as drone:
        drone.bind(("127.0.0.1", 0))
        drone.settimeout(5.0)
        link = open_connection(Endpoint("udpout", "127.0.0.1", drone.getsockname()[1]))
        assert link.send(b"pose")
        data, source = drone.recvfrom(100)
        assert data == b"pose"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other_sender:
            other_sender.sendto(b"land now", source)
            assert link.receive(5.0) is None
            link.reply_to(other_sender.getsockname())
        drone.sendto(b"hello", source)
        assert link.receive(5.0) == (b"hello", drone.getsockname())
    assert link.foreign == 1
    for _ in range(5):
        link.send(b"pose")  # sometimes rejected by the kernel: the port is closed
        assert link.receive(0.01) is None
    link.close()


SLOW_NETWORK = """
from links.mavlink.transport.connection import Endpoint, Udp
link = Udp(Endpoint("udpout", "10.9.9.2", 14550), None)
print(sum(link.send(bytes(244)) for _ in range(500)))
"""


@pytest.mark.skipif(not own_network(), reason="needs a network namespace (unshare, ip)")
def test_few_datagrams_are_buffered_for_a_host_that_does_not_reply():
    commands = f"{OWN_NETWORK} && ip addr add 10.9.9.1/24 dev grd0 && {sys.executable} -c '{SLOW_NETWORK}'"
    run = subprocess.run([*UNSHARE, "sh", "-c", commands], capture_output=True, text=True, check=True)
    assert 3 <= int(run.stdout) <= 10  # of 500; with the default buffer about 160, 3 s of poses


def test_a_port_in_use_is_an_error_that_names_what_to_check():
    link, other = udp_pair()
    with pytest.raises(LinkError, match=f"UDP 127.0.0.1:{link.port}.*another program"):
        open_connection(Endpoint("udpin", "127.0.0.1", link.port))
    link.close()
    other.close()


def until(link: Connection, wanted: bytes) -> None:
    """Receive until the bytes have arrived."""
    data = b""
    for _ in range(500):
        received = link.receive(0.02)
        data += received[0] if received else b""
        if wanted in data:
            return
    pytest.fail(f"only {data!r} arrived")


def test_tcp_is_reopened_after_the_peer_closed_it():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        first, _ = server.accept()
        first.sendall(b"one")
        until(link, b"one")
        assert link.send(b"pose")
        assert first.recv(100) == b"pose"
        first.close()
        second: list[socket.socket] = []
        waiting = threading.Thread(target=lambda: second.append(server.accept()[0]))
        waiting.start()
        for _ in range(500):
            link.receive(0.02)
            if link.reconnects:
                break
        waiting.join(10)
        second[0].sendall(b"two")
        until(link, b"two")
        assert link.reconnects == 1
        assert link.send(b"pose")
        link.close()
        second[0].close()


def test_while_tcp_is_down_nothing_is_sent_and_the_status_reports_it():
    server = socket.create_server(("127.0.0.1", 0))
    link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
    accepted, _ = server.accept()
    accepted.close()
    server.close()
    for _ in range(20):
        link.receive(0.02)
    assert not link.send(FRAME)
    assert link.status is not None
    assert "Reopening" in link.status
    link.close()


def test_tcp_to_a_closed_port_is_an_error_that_names_what_to_check():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkError, match=f"TCP 127.0.0.1:{port}.*Check `connection`"):
        open_connection(Endpoint("tcp", "127.0.0.1", port))


def test_a_tcp_peer_that_does_not_read_costs_frames_but_no_time():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        taken = sum(link.send(FRAME) for _ in range(50_000))  # 12 MB: a blocking send would never return
        assert taken < 50_000
        link.close()
        peer.close()


def small_server() -> socket.socket:
    """A server with a small receive buffer."""
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    server.bind(("127.0.0.1", 0))
    server.listen()
    return server


def read_all(peer: socket.socket) -> int:
    """Number of bytes received until nothing more arrives."""
    peer.settimeout(0.3)
    received = 0
    with contextlib.suppress(TimeoutError, ConnectionResetError):
        while data := peer.recv(65536):
            received += len(data)
    return received


def unread(peer: socket.socket) -> int:
    """Bytes in the peer's receive buffer."""
    return struct.unpack("i", fcntl.ioctl(peer, termios.FIONREAD, bytes(4)))[0]


def test_frames_that_a_tcp_peer_has_not_received_within_half_a_second_never_arrive():
    with small_server() as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        for _ in range(500):  # 50 poses/s, not read
            link.send(FRAME)
            link.receive(0.02)
            if link.reconnects:
                break
        buffered = unread(peer)
        assert 0 < read_all(peer) <= buffered
        assert (link.stalls, link.reconnects) == (1, 1)
        reopened, _ = server.accept()
        assert read_all(reopened) == 0
        assert link.send(b"new")
        assert reopened.recv(100) == b"new"
        link.close()
        peer.close()
        reopened.close()


def test_buffered_bytes_are_discarded_when_tcp_is_closed():
    with small_server() as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        for _ in range(200):
            link.send(FRAME)
        link.close()
        buffered = unread(peer)
        assert 0 < read_all(peer) <= buffered
        peer.close()


class SlowLine:
    """A line that accepts a few bytes at a time."""

    name, backlog_bytes = "slow", 1000

    def __init__(self) -> None:
        self.capacity, self.accepted, self.buffered = 0, b"", 0

    def open(self) -> None: ...

    def read(self, timeout_s: float) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        size = min(self.capacity, len(data))
        self.accepted += data[:size]
        self.capacity -= size
        return size

    def buffered_bytes(self) -> int:
        return self.buffered

    def close(self) -> None: ...


def test_a_started_frame_is_completed_before_the_next_and_frames_in_between_are_dropped():
    line = SlowLine()
    link = StreamConnection(line)
    line.capacity = 2
    assert link.send(b"AAAA")
    line.capacity = 1
    assert not link.send(b"BBBB")
    line.capacity = 100
    assert link.send(b"CCCC")
    assert line.accepted == b"AAAACCCC"


@pytest.mark.parametrize("capacity", [0, 2, 4])  # bytes of a frame that the line has accepted
def test_a_blocked_line_is_closed_with_a_status_and_a_slow_one_is_not(capacity: int, monkeypatch: pytest.MonkeyPatch):
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.transport.stream_connection.time.monotonic", lambda: now_s)
    line = SlowLine()
    link = StreamConnection(line)
    for _ in range(100):  # each frame is transmitted 0.3 s after it was sent
        line.capacity = 4
        link.send(b"AAAA")
        line.buffered = 4
        now_s += 0.3
        link.receive(0.0)
        line.buffered = 0
    assert (link.stalls, link.status) == (0, None)
    line.capacity = capacity
    assert link.send(b"BBBB")
    line.buffered = 4 if capacity == 4 else 0
    now_s += MAX_STALL_S + 0.01
    link.receive(0.0)
    assert link.stalls == 1
    assert "did not transmit within 0.5 s" in (link.status or "")
    line.capacity = 100
    assert not link.send(b"CCCC")


class MeteredLine(SlowLine):
    """A line that accepts everything and transmits at a rate."""

    def __init__(self, kbit_per_s: float, backlog_bytes: int) -> None:
        super().__init__()
        self.backlog_bytes, self._per_s = backlog_bytes, 125 * kbit_per_s

    def open(self) -> None:
        self.buffered = 0

    def write(self, data: bytes) -> int:
        self.buffered += len(data)
        return len(data)

    def transmit(self, seconds: float) -> None:
        self.buffered = max(0, self.buffered - round(seconds * self._per_s))


def poses_for_20_s(
    kbit_per_s: float, backlog_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> tuple[int, StreamConnection, list[str | None]]:
    """Sent poses of 50 per second, and each new status, polled once per second as `flow.live` does."""
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.transport.stream_connection.time.monotonic", lambda: now_s)
    line, sent, statuses = MeteredLine(kbit_per_s, backlog_bytes), 0, list[str | None]()
    link = StreamConnection(line)
    for tick in range(1000):
        sent += link.send(FRAME)
        line.transmit(0.02)
        now_s += 0.02
        link.receive(0.0)
        if tick % 50 == 0 and (statuses[-1] if statuses else None) != link.status:
            statuses.append(link.status)
    return sent, link, statuses


@pytest.mark.parametrize("backlog_bytes", [TCP_BACKLOG_BYTES, SERIAL_BACKLOG_BYTES])
def test_a_slow_line_gets_as_many_poses_as_it_transmits_and_is_not_closed(
    backlog_bytes: int, monkeypatch: pytest.MonkeyPatch
):
    sent, link, statuses = poses_for_20_s(16, backlog_bytes, monkeypatch)
    assert (link.stalls, statuses) == (0, [])
    assert 8 * 20 <= sent <= 9 * 20


def test_a_line_that_is_far_too_slow_reports_the_needed_rate_once(monkeypatch: pytest.MonkeyPatch):
    _, link, statuses = poses_for_20_s(6, TCP_BACKLOG_BYTES, monkeypatch)
    assert link.stalls > 5
    assert len(statuses) == 1
    assert "does it carry 13 kbit/s" in (statuses[0] or "")
    assert "clock.rate_hz" in (statuses[0] or "")


def test_a_stall_shorter_than_the_polling_interval_is_reported_and_then_cleared(monkeypatch: pytest.MonkeyPatch):
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.transport.stream_connection.time.monotonic", lambda: now_s)
    line, reported = SlowLine(), list[bool]()
    link = StreamConnection(line)
    link.send(FRAME)  # never accepted
    for tick in range(200):
        now_s += 0.05
        link.receive(0.0)
        if tick % 20 == 0:
            reported.append(link.status is not None)
    assert (link.stalls, link.reconnects) == (1, 1)
    assert reported[:3] == [False, True, True]
    assert reported[-1] is False


def test_serial_on_a_pty_transmits_all_bytes_both_ways_and_notices_its_loss():
    host, device = pty.openpty()
    link = open_connection(Endpoint("serial", os.ttyname(device), 57600))
    everything = bytes(range(256))
    os.write(host, everything)
    until(link, everything)
    assert link.send(everything)
    assert os.read(host, 1000) == everything
    os.close(device)
    os.close(host)
    while link.status is None:
        link.receive(0.01)
    assert not link.send(b"pose")
    link.close()


def test_a_full_serial_line_drops_the_newest_frame_and_does_not_block():
    host, device = pty.openpty()
    link = open_connection(Endpoint("serial", os.ttyname(device), 57600))
    taken = sum(link.send(FRAME) for _ in range(1000))
    assert 0 < taken < 1000
    link.close()
    os.close(device)
    os.close(host)


def test_buffered_bytes_are_discarded_when_serial_is_closed():
    host, device = pty.openpty()
    link = open_connection(Endpoint("serial", os.ttyname(device), 57600))
    taken = sum(link.send(FRAME) for _ in range(1000)) * len(FRAME)
    link.close()
    arrived = 0
    while select.select([host], [], [], 0.3)[0]:
        arrived += len(os.read(host, 65536))
    assert arrived < taken / 2  # up to 4095 bytes were already received
    os.close(device)
    os.close(host)


def test_a_missing_device_is_an_error_that_names_what_to_check():
    with pytest.raises(LinkError, match=r"/dev/no-such-tty at 57600 baud.*dialout"):
        open_connection(Endpoint("serial", "/dev/no-such-tty", 57600))


def read_until(link: Connection, started: threading.Event, ended: threading.Event) -> None:
    while not ended.is_set():
        started.set()
        link.receive(0.05)


@pytest.mark.parametrize("kind", ["udpin", "tcp", "serial"])
def test_closing_a_line_during_a_read_ends_it_without_error_or_with_a_link_error(kind: str):
    server = socket.create_server(("127.0.0.1", 0))
    host, device = pty.openpty()
    endpoints = {
        "udpin": Endpoint("udpin", "127.0.0.1", 0),
        "tcp": Endpoint("tcp", "127.0.0.1", server.getsockname()[1]),
        "serial": Endpoint("serial", os.ttyname(device), 57600),
    }
    with ThreadPoolExecutor(1) as pool:
        for _ in range(5):
            link = open_connection(endpoints[kind])
            started, ended = threading.Event(), threading.Event()
            reading = pool.submit(read_until, link, started, ended)
            assert started.wait(5)
            link.close()
            assert not link.send(FRAME)
            ended.set()
            assert isinstance(reading.exception(5), LinkError | None)
    server.close()
    os.close(device)
    os.close(host)

"""Lines to the autopilot: who is heard, what comes back after a loss, and that sending never waits."""

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
from links.mavlink.connection import Connection, Endpoint, Udp, parse_connection
from links.mavlink.lines import STALL_S, StreamConnection, open_connection
from links.mavlink.serial_line import SERIAL_BACKLOG_BYTES
from links.mavlink.tcp_line import TCP_BACKLOG_BYTES

FRAME = bytes(244)
UNSHARE = ("unshare", "-n") if os.geteuid() == 0 else ("unshare", "-rn")
OWN_NETWORK = "ip link add grd0 type veth peer grd1 && ip link set grd0 up && ip link set grd1 up"


def own_network() -> bool:
    """Whether this host lets us have a network of our own, with a line to nobody."""
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
def test_connections_are_written_as_mavutil_writes_them(text: str, endpoint: Endpoint):
    assert parse_connection(text) == endpoint


@pytest.mark.parametrize(
    "text",
    ["", "udp:1:2", "udpin:14550", "udpin:host:14550", "udpout:1.2.3.4:0", "tcp:1.2.3.4:70000", "serial:", "tcp::1"],
)
def test_a_connection_that_cannot_be_is_refused(text: str):
    with pytest.raises(ValueError):
        parse_connection(text)


def udp_pair(host: str = "127.0.0.1") -> tuple[Udp, socket.socket]:
    link = open_connection(parse_connection("udpin:127.0.0.1:0"))
    assert isinstance(link, Udp)
    other = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    other.bind((host, 0))
    other.settimeout(5.0)
    return link, other


def test_udp_answers_the_autopilot_and_nobody_before_it_spoke():
    link, drone = udp_pair()
    assert not link.send(b"pose")
    drone.sendto(b"hello", ("127.0.0.1", link.port))
    received = link.receive(5.0)
    assert received == (b"hello", drone.getsockname())
    link.answer_to(received[1])
    assert link.send(b"pose")
    assert drone.recv(100) == b"pose"
    link.close()
    drone.close()


def test_udp_hears_its_sender_alone():
    link = Udp(Endpoint("udpin", "127.0.0.1", 0), IPv4Address("127.0.0.9"))
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
        stranger.sendto(b"land now", ("127.0.0.1", link.port))
        assert link.receive(5.0) is None
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as drone:
        drone.bind(("127.0.0.9", 0))
        drone.sendto(b"hello", ("127.0.0.1", link.port))
        assert link.receive(5.0) == (b"hello", drone.getsockname())
    assert link.foreign == 1
    link.close()


def test_udp_out_hears_nobody_but_whom_it_sends_to_and_bears_a_closed_port():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as drone:
        drone.bind(("127.0.0.1", 0))
        drone.settimeout(5.0)
        link = open_connection(Endpoint("udpout", "127.0.0.1", drone.getsockname()[1]))
        assert link.send(b"pose")
        data, source = drone.recvfrom(100)
        assert data == b"pose"
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as stranger:
            stranger.sendto(b"land now", source)
            assert link.receive(5.0) is None
            link.answer_to(stranger.getsockname())
        drone.sendto(b"hello", source)
        assert link.receive(5.0) == (b"hello", drone.getsockname())
    assert link.foreign == 1
    for _ in range(5):
        link.send(b"pose")  # refused by the kernel now and then: nobody is there
        assert link.receive(0.01) is None
    link.close()


SLOW_NETWORK = """
from links.mavlink.connection import Endpoint, Udp
link = Udp(Endpoint("udpout", "10.9.9.2", 14550), None)
print(sum(link.send(bytes(244)) for _ in range(500)))
"""


@pytest.mark.skipif(not own_network(), reason="needs a network namespace of its own (unshare, ip)")
def test_few_datagrams_wait_for_a_host_that_does_not_answer():
    commands = f"{OWN_NETWORK} && ip addr add 10.9.9.1/24 dev grd0 && {sys.executable} -c '{SLOW_NETWORK}'"
    run = subprocess.run([*UNSHARE, "sh", "-c", commands], capture_output=True, text=True, check=True)
    assert 3 <= int(run.stdout) <= 10  # of 500; some 160 waited, 3 s of poses, in a buffer of the usual size


def test_a_port_in_use_says_what_to_check():
    link, other = udp_pair()
    with pytest.raises(LinkError, match=f"UDP 127.0.0.1:{link.port}.*another program"):
        open_connection(Endpoint("udpin", "127.0.0.1", link.port))
    link.close()
    other.close()


def until(link: Connection, wanted: bytes) -> None:
    """Receive until the bytes have come."""
    got = b""
    for _ in range(500):
        received = link.receive(0.02)
        got += received[0] if received else b""
        if wanted in got:
            return
    pytest.fail(f"only {got!r} came")


def test_tcp_is_opened_again_after_the_other_side_closed_it():
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


def test_while_tcp_is_down_nothing_is_sent_and_it_says_so():
    server = socket.create_server(("127.0.0.1", 0))
    link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
    accepted, _ = server.accept()
    accepted.close()
    server.close()
    for _ in range(20):
        link.receive(0.02)
    assert not link.send(FRAME)
    assert link.status is not None
    assert "Trying again" in link.status
    link.close()


def test_tcp_to_nobody_says_what_to_check():
    with socket.create_server(("127.0.0.1", 0)) as server:
        port = server.getsockname()[1]
    with pytest.raises(LinkError, match=f"TCP 127.0.0.1:{port}.*Check `connection`"):
        open_connection(Endpoint("tcp", "127.0.0.1", port))


def test_a_tcp_peer_that_does_not_read_costs_frames_and_never_time():
    with socket.create_server(("127.0.0.1", 0)) as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        taken = sum(link.send(FRAME) for _ in range(50_000))  # 12 MB: would wait for ever if it waited
        assert taken < 50_000
        link.close()
        peer.close()


def small_server() -> socket.socket:
    """A server whose connections hold little that nobody has read."""
    server = socket.socket()
    server.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    server.bind(("127.0.0.1", 0))
    server.listen()
    return server


def read_on(peer: socket.socket) -> int:
    """Bytes that come until nothing more does."""
    peer.settimeout(0.3)
    taken = 0
    with contextlib.suppress(TimeoutError, ConnectionResetError):
        while data := peer.recv(65536):
            taken += len(data)
    return taken


def unread(peer: socket.socket) -> int:
    """Bytes that the peer's own system holds for it."""
    return struct.unpack("i", fcntl.ioctl(peer, termios.FIONREAD, bytes(4)))[0]


def test_what_a_tcp_peer_has_not_taken_for_half_a_second_never_arrives():
    with small_server() as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        for _ in range(500):  # 50 poses a second; nobody reads
            link.send(FRAME)
            link.receive(0.02)
            if link.reconnects:
                break
        held = unread(peer)
        assert 0 < read_on(peer) <= held
        assert (link.stalls, link.reconnects) == (1, 1)
        again, _ = server.accept()
        assert read_on(again) == 0
        assert link.send(b"new")
        assert again.recv(100) == b"new"
        link.close()
        peer.close()
        again.close()


def test_what_is_on_its_way_when_tcp_is_closed_is_thrown_away():
    with small_server() as server:
        link = open_connection(Endpoint("tcp", "127.0.0.1", server.getsockname()[1]))
        peer, _ = server.accept()
        for _ in range(200):
            link.send(FRAME)
        link.close()
        held = unread(peer)
        assert 0 < read_on(peer) <= held
        peer.close()


class SlowLine:
    """A line that takes a few bytes at a time."""

    name, backlog_bytes = "slow", 1000

    def __init__(self) -> None:
        self.room, self.taken, self.waiting = 0, b"", 0

    def open(self) -> None: ...

    def read(self, timeout_s: float) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        size = min(self.room, len(data))
        self.taken += data[:size]
        self.room -= size
        return size

    def waiting_bytes(self) -> int:
        return self.waiting

    def close(self) -> None: ...


def test_a_frame_begun_is_finished_before_the_next_and_those_between_are_dropped():
    line = SlowLine()
    link = StreamConnection(line)
    line.room = 2
    assert link.send(b"AAAA")
    line.room = 1
    assert not link.send(b"BBBB")
    line.room = 100
    assert link.send(b"CCCC")
    assert line.taken == b"AAAACCCC"


@pytest.mark.parametrize("room", [0, 2, 4])  # we keep all of a frame, or the rest of it, or the line does
def test_a_line_that_stands_still_is_dropped_and_says_so_and_one_that_moves_is_not(
    room: int, monkeypatch: pytest.MonkeyPatch
):
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.lines.time.monotonic", lambda: now_s)
    line = SlowLine()
    link = StreamConnection(line)
    for _ in range(100):  # never empty, and never still: each frame is through 0.3 s after it was sent
        line.room = 4
        link.send(b"AAAA")
        line.waiting = 4
        now_s += 0.3
        link.receive(0.0)
        line.waiting = 0
    assert (link.stalls, link.status) == (0, None)
    line.room = room
    assert link.send(b"BBBB")
    line.waiting = 4 if room == 4 else 0
    now_s += STALL_S + 0.01
    link.receive(0.0)
    assert link.stalls == 1
    assert "did not take what was sent within 0.5 s" in (link.status or "")
    line.room = 100
    assert not link.send(b"CCCC")


class MeteredLine(SlowLine):
    """A line that takes all and passes it on at a rate."""

    def __init__(self, kbit_per_s: float, backlog_bytes: int) -> None:
        super().__init__()
        self.backlog_bytes, self._per_s = backlog_bytes, 125 * kbit_per_s

    def open(self) -> None:
        self.waiting = 0

    def write(self, data: bytes) -> int:
        self.waiting += len(data)
        return len(data)

    def rest(self, seconds: float) -> None:
        self.waiting = max(0, self.waiting - round(seconds * self._per_s))


def poses_for_20_s(
    kbit_per_s: float, backlog_bytes: int, monkeypatch: pytest.MonkeyPatch
) -> tuple[int, StreamConnection, list[str | None]]:
    """How many went out of 50 a second, and each new word of status, looked at once a second as `flow.live` does."""
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.lines.time.monotonic", lambda: now_s)
    line, sent, said = MeteredLine(kbit_per_s, backlog_bytes), 0, list[str | None]()
    link = StreamConnection(line)
    for tick in range(1000):
        sent += link.send(FRAME)
        line.rest(0.02)
        now_s += 0.02
        link.receive(0.0)
        if tick % 50 == 0 and (said[-1] if said else None) != link.status:
            said.append(link.status)
    return sent, link, said


@pytest.mark.parametrize("backlog_bytes", [TCP_BACKLOG_BYTES, SERIAL_BACKLOG_BYTES])
def test_a_slow_line_gets_as_many_poses_as_it_takes_and_is_not_dropped(
    backlog_bytes: int, monkeypatch: pytest.MonkeyPatch
):
    sent, link, said = poses_for_20_s(16, backlog_bytes, monkeypatch)
    assert (link.stalls, said) == (0, [])
    assert 8 * 20 <= sent <= 9 * 20


def test_a_line_too_slow_for_any_use_says_once_what_it_needs(monkeypatch: pytest.MonkeyPatch):
    _, link, said = poses_for_20_s(6, TCP_BACKLOG_BYTES, monkeypatch)
    assert link.stalls > 5
    assert len(said) == 1
    assert "does it carry 13 kbit/s" in (said[0] or "")
    assert "clock.rate_hz" in (said[0] or "")


def test_a_stall_shorter_than_between_two_looks_is_said_and_then_that_all_works(monkeypatch: pytest.MonkeyPatch):
    now_s = 0.0
    monkeypatch.setattr("links.mavlink.lines.time.monotonic", lambda: now_s)
    line, seen = SlowLine(), list[bool]()
    link = StreamConnection(line)
    link.send(FRAME)  # never taken
    for tick in range(200):
        now_s += 0.05
        link.receive(0.0)
        if tick % 20 == 0:
            seen.append(link.status is not None)
    assert (link.stalls, link.reconnects) == (1, 1)
    assert seen[:3] == [False, True, True]
    assert seen[-1] is False


def test_serial_on_a_pseudo_terminal_carries_all_bytes_both_ways_and_notices_when_it_goes():
    ours, theirs = pty.openpty()
    link = open_connection(Endpoint("serial", os.ttyname(theirs), 57600))
    everything = bytes(range(256))
    os.write(ours, everything)
    until(link, everything)
    assert link.send(everything)
    assert os.read(ours, 1000) == everything
    os.close(theirs)
    os.close(ours)
    while link.status is None:
        link.receive(0.01)
    assert not link.send(b"pose")
    link.close()


def test_a_serial_line_that_is_full_drops_the_newest_and_does_not_wait():
    ours, theirs = pty.openpty()
    link = open_connection(Endpoint("serial", os.ttyname(theirs), 57600))
    taken = sum(link.send(FRAME) for _ in range(1000))
    assert 0 < taken < 1000
    link.close()
    os.close(theirs)
    os.close(ours)


def test_what_a_serial_line_has_not_sent_when_it_is_closed_is_thrown_away():
    ours, theirs = pty.openpty()
    link = open_connection(Endpoint("serial", os.ttyname(theirs), 57600))
    taken = sum(link.send(FRAME) for _ in range(1000)) * len(FRAME)
    link.close()
    arrived = 0
    while select.select([ours], [], [], 0.3)[0]:
        arrived += len(os.read(ours, 65536))
    assert arrived < taken / 2  # up to 4095 bytes were the other side's already
    os.close(theirs)
    os.close(ours)


def test_a_device_that_is_not_there_says_what_to_check():
    with pytest.raises(LinkError, match=r"/dev/no-such-tty at 57600 baud.*dialout"):
        open_connection(Endpoint("serial", "/dev/no-such-tty", 57600))


def read_until(link: Connection, begun: threading.Event, ended: threading.Event) -> None:
    while not ended.is_set():
        begun.set()
        link.receive(0.05)


@pytest.mark.parametrize("kind", ["udpin", "tcp", "serial"])
def test_a_line_that_is_closed_while_it_is_read_ends_quietly_or_as_a_link_error(kind: str):
    server = socket.create_server(("127.0.0.1", 0))
    ours, theirs = pty.openpty()
    endpoints = {
        "udpin": Endpoint("udpin", "127.0.0.1", 0),
        "tcp": Endpoint("tcp", "127.0.0.1", server.getsockname()[1]),
        "serial": Endpoint("serial", os.ttyname(theirs), 57600),
    }
    with ThreadPoolExecutor(1) as pool:
        for _ in range(5):
            link = open_connection(endpoints[kind])
            begun, ended = threading.Event(), threading.Event()
            reading = pool.submit(read_until, link, begun, ended)
            assert begun.wait(5)
            link.close()
            assert not link.send(FRAME)
            ended.set()
            assert isinstance(reading.exception(5), LinkError | None)
    server.close()
    os.close(theirs)
    os.close(ours)

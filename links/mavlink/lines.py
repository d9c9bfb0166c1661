"""TCP and serial lines to the autopilot: byte streams that are opened again when they are gone.

Sending never waits. What a slow line has not taken yet is not added to: the frame is dropped and the next pose is
newer, so that it gets as many as it takes. A line that is gone is tried again, more slowly each time up to 2 s. A line
that has kept a frame for half a second stands still; it is dropped with what is in it, so that no pose arrives later as
if it were of now. What the other side's system has taken and its program has not read is out of our hands.

Frames that leave later than LATE_NS are counted: a line that is merely slow does not stand still, its poses are late.

Source: ours.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from ipaddress import IPv4Address
from typing import Protocol

from flow.link import LinkError
from links.mavlink.connection import Connection, Endpoint, Source_, Udp
from links.mavlink.round_trip import LATE_NS
from links.mavlink.serial_line import SerialLine
from links.mavlink.tcp_line import TcpLine
from links.mavlink.wire import MAX_FRAME_BYTES

CLOSE_S = 0.1
RETRY_S = (0.1, 2.0)  # first and last wait before the next try
TOLD_S = 5.0  # for so long a trouble is told at least: it is looked at once a second, and said once if it comes again
STALL_S = 0.5  # ArduPilot takes what comes later for half a second old (JitterCorrection), whatever its time says


def open_connection(endpoint: Endpoint, sender: IPv4Address | None = None) -> Connection:
    """Open a connection of any kind. LinkError says what to check."""
    if endpoint.kind in ("udpin", "udpout"):
        return Udp(endpoint, sender)
    line = TcpLine(endpoint) if endpoint.kind == "tcp" else SerialLine(endpoint)
    line.open()
    return StreamConnection(line)


class Line(Protocol):
    """A byte stream that can be opened again. OSError: it is gone."""

    backlog_bytes: int
    name: str

    def open(self) -> None:
        """Open it. LinkError."""

    def read(self, timeout_s: float) -> bytes:
        """What has arrived; empty: nothing within timeout_s."""
        ...

    def write(self, data: bytes) -> int:
        """Bytes taken now."""
        ...

    def waiting_bytes(self) -> int:
        """Bytes taken and not sent yet."""
        ...

    def close(self) -> None:
        """Let go of it."""


class StreamConnection:
    """A line that is opened again when it is gone, and takes no frame before the one before it is through."""

    datagrams = False

    def __init__(self, line: Line) -> None:
        self.reconnects = self.foreign = self.stalls = self.left_late = 0
        self._line = line
        self._status, self._status_s = "", -TOLD_S  # the last one, and when it came
        self._up = True
        self._closed = False
        self._reading = threading.Lock()  # held while the line is read, opened or closed
        self._writing = threading.Lock()  # held while it is written or closed; a write never waits
        self._rest = b""  # of a frame that the line took in part
        self._begun_bytes = 0  # since the line was opened: of all frames, with the rest
        self._on_way: deque[tuple[int, float]] = deque()  # _begun_bytes after a frame, when it was begun [s]
        self._retry_at_s, self._wait_s = 0.0, RETRY_S[0]

    @property
    def status(self) -> str | None:
        """In words, while it is down and some seconds on."""
        told = self._up and time.monotonic() - self._status_s >= TOLD_S
        return None if told or not self._status else self._status

    def receive(self, timeout_s: float) -> tuple[bytes, Source_] | None:
        """See Connection."""
        with self._reading:
            data = self._read(timeout_s)
            if self._closed:
                self._let_go()
        return (data, (self._line.name, 0)) if data else None

    def answer_to(self, source: Source_) -> None:
        """See Connection."""

    def send(self, frame: bytes) -> bool:
        """See Connection."""
        if not self._up:  # closing it may take long
            return False
        with self._writing:
            if not self._up:
                return False
            try:
                if self._rest:
                    self._rest = self._rest[self._line.write(self._rest) :]
                if self._note_what_left() > self._line.backlog_bytes or self._rest:
                    return False
                self._rest = frame[self._line.write(frame) :]
                self._begun_bytes += len(frame)
                self._on_way.append((self._begun_bytes, time.monotonic()))
            except (OSError, ValueError):
                self._lost()
                return False
            return True

    def close(self) -> None:
        """See Connection. Where a listener is at the line just now and stays there, it closes it when it leaves."""
        self._closed, self._up = True, False
        if self._reading.acquire(timeout=CLOSE_S):
            self._let_go()
            self._reading.release()

    def _let_go(self) -> None:
        with self._writing:
            self._line.close()

    def _read(self, timeout_s: float) -> bytes:
        """What has arrived; nothing while the line is down."""
        if self._closed or (not self._up and not self._again(timeout_s)):
            return b""
        try:
            if self._stands_still():
                self.stalls += 1
                kbit_per_s = 8e-3 * (self._line.backlog_bytes + MAX_FRAME_BYTES) / STALL_S
                self._lost(
                    f"did not take what was sent within {STALL_S:g} s and was dropped with it: does anybody read "
                    f"there, and does it carry {kbit_per_s:.0f} kbit/s (else fewer poses a second: clock.rate_hz)?"
                )
                return b""
            data = self._line.read(timeout_s)
        except (OSError, ValueError):
            self._lost()
            return b""
        if data:
            self._wait_s = RETRY_S[0]
        return data

    def _stands_still(self) -> bool:
        """Whether a frame has waited for too long; looked at by the listener, many times a second."""
        with self._writing:
            self._note_what_left()
            return bool(self._on_way) and time.monotonic() - self._on_way[0][1] > STALL_S

    def _note_what_left(self) -> int:
        """Bytes that wait in the line. Those frames that are through wait no more, and some were late."""
        waiting_bytes = self._line.waiting_bytes()
        through_bytes = self._begun_bytes - len(self._rest) - waiting_bytes
        while self._on_way and self._on_way[0][0] <= through_bytes:
            _, begun_s = self._on_way.popleft()
            self.left_late += time.monotonic() - begun_s > 1e-9 * LATE_NS
        return waiting_bytes

    def _lost(self, how: str = "is gone: is it plugged in and powered?") -> None:
        """Only the listener closes and opens: nobody reads from a number that has become another file's."""
        self._up = False
        self._status, self._status_s = f"{self._line.name} {how} Trying again", time.monotonic()
        self._retry_at_s = time.monotonic() + self._wait_s

    def _again(self, timeout_s: float) -> bool:
        self._let_go()
        rest_s = self._retry_at_s - time.monotonic()
        if rest_s > 0:
            time.sleep(min(timeout_s, rest_s))
            return False
        try:
            self._line.open()
        except LinkError:
            self._wait_s = min(2 * self._wait_s, RETRY_S[1])
            self._retry_at_s = time.monotonic() + self._wait_s
            return False
        self._rest, self._begun_bytes = b"", 0  # nobody writes while it is not up
        self._on_way.clear()
        self._up = not self._closed
        self.reconnects += 1
        return True

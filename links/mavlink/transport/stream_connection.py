"""TCP and serial connections to the autopilot: byte streams that are reopened when they are lost.

Sending never blocks. While an earlier frame waits in the send buffer, new frames are dropped: a slow line gets as many
poses as it can transmit, always the newest. A lost line is reopened with increasing pauses up to 2 s. A line that holds
a frame for half a second is blocked; it is closed together with its buffer, so that no old pose arrives as a current
one. Bytes in the receiver's own buffer cannot be recalled.

Frames that are sent more than MAX_LATENCY_NS late are counted: a slow line that is not blocked transmits late poses.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from ipaddress import IPv4Address
from typing import Protocol

from flow.link import LinkError
from links.mavlink.timesync_monitor import MAX_LATENCY_NS
from links.mavlink.transport.connection import Address, Connection, Endpoint, Udp
from links.mavlink.transport.framing import MAX_FRAME_BYTES
from links.mavlink.transport.serial_line import SerialLine
from links.mavlink.transport.tcp_line import TcpLine

MAX_CLOSE_WAIT_S = 0.1
RETRY_S = (0.1, 2.0)  # first and longest pause before reopening
MIN_STATUS_S = 5.0  # minimum duration of a status: it is polled once per second, and repeated errors are reported once
MAX_STALL_S = 0.5  # ArduPilot treats older messages as half a second old (JitterCorrection), whatever their time stamp


def open_connection(endpoint: Endpoint, sender: IPv4Address | None = None) -> Connection:
    """Open a connection of any kind. Raises LinkError."""
    if endpoint.kind in ("udpin", "udpout"):
        return Udp(endpoint, sender)
    line = TcpLine(endpoint) if endpoint.kind == "tcp" else SerialLine(endpoint)
    line.open()
    return StreamConnection(line)


class Line(Protocol):
    """A byte stream that can be reopened. Its methods raise OSError when it is lost."""

    backlog_bytes: int
    name: str

    def open(self) -> None:
        """Open it. Raises LinkError."""

    def read(self, timeout_s: float) -> bytes:
        """Received bytes; empty: nothing within timeout_s."""
        ...

    def write(self, data: bytes) -> int:
        """Write without blocking; returns the number of accepted bytes."""
        ...

    def buffered_bytes(self) -> int:
        """Bytes in the send buffer."""
        ...

    def close(self) -> None:
        """Close it."""


class StreamConnection:
    """A line that is reopened when it is lost, and accepts no frame while an earlier one is buffered."""

    datagrams = False

    def __init__(self, line: Line) -> None:
        self.reconnects = self.foreign = self.stalls = self.late_frames = 0
        self._line = line
        self._status, self._status_s = "", -MIN_STATUS_S  # the newest error, and its time
        self._up = True
        self._closed = False
        self._reading = threading.Lock()  # held while the line is read, opened or closed
        self._writing = threading.Lock()  # held while the line is written or closed; a write never blocks
        self._rest = b""  # remainder of a partly written frame
        self._queued_bytes = 0  # of all frames since the line was opened, including the remainder
        self._in_flight: deque[tuple[int, float]] = deque()  # (_queued_bytes after the frame, its time [s])
        self._retry_at_s, self._wait_s = 0.0, RETRY_S[0]

    @property
    def status(self) -> str | None:
        """The newest error, while the line is down and for MIN_STATUS_S after."""
        expired = self._up and time.monotonic() - self._status_s >= MIN_STATUS_S
        return None if expired or not self._status else self._status

    def receive(self, timeout_s: float) -> tuple[bytes, Address] | None:
        """See Connection."""
        with self._reading:
            data = self._read(timeout_s)
            if self._closed:
                self._close_line()
        return (data, (self._line.name, 0)) if data else None

    def reply_to(self, source: Address) -> None:
        """See Connection."""

    def send(self, frame: bytes) -> bool:
        """See Connection."""
        if not self._up:  # closing may take long
            return False
        with self._writing:
            if not self._up:
                return False
            try:
                if self._rest:
                    self._rest = self._rest[self._line.write(self._rest) :]
                if self._update_in_flight() > self._line.backlog_bytes or self._rest:
                    return False
                self._rest = frame[self._line.write(frame) :]
                self._queued_bytes += len(frame)
                self._in_flight.append((self._queued_bytes, time.monotonic()))
            except (OSError, ValueError):
                self._on_lost()
                return False
            return True

    def close(self) -> None:
        """See Connection. If a reader holds the line for longer than MAX_CLOSE_WAIT_S, the reader closes it."""
        self._closed, self._up = True, False
        if self._reading.acquire(timeout=MAX_CLOSE_WAIT_S):
            self._close_line()
            self._reading.release()

    def _close_line(self) -> None:
        with self._writing:
            self._line.close()

    def _read(self, timeout_s: float) -> bytes:
        """Received bytes; empty while the line is down."""
        if self._closed or (not self._up and not self._reopen(timeout_s)):
            return b""
        try:
            if self._is_blocked():
                self.stalls += 1
                kbit_per_s = 8e-3 * (self._line.backlog_bytes + MAX_FRAME_BYTES) / MAX_STALL_S
                self._on_lost(
                    f"did not transmit within {MAX_STALL_S:g} s and was closed with its buffer: is it read at the "
                    f"other end, and does it carry {kbit_per_s:.0f} kbit/s (otherwise lower clock.rate_hz)?"
                )
                return b""
            data = self._line.read(timeout_s)
        except (OSError, ValueError):
            self._on_lost()
            return b""
        if data:
            self._wait_s = RETRY_S[0]
        return data

    def _is_blocked(self) -> bool:
        """Whether a frame has been buffered for longer than MAX_STALL_S. Called by the reader."""
        with self._writing:
            self._update_in_flight()
            return bool(self._in_flight) and time.monotonic() - self._in_flight[0][1] > MAX_STALL_S

    def _update_in_flight(self) -> int:
        """Remove transmitted frames and count the late ones. Returns the bytes in the send buffer."""
        buffered_bytes = self._line.buffered_bytes()
        sent_bytes = self._queued_bytes - len(self._rest) - buffered_bytes
        while self._in_flight and self._in_flight[0][0] <= sent_bytes:
            _, start_s = self._in_flight.popleft()
            self.late_frames += time.monotonic() - start_s > 1e-9 * MAX_LATENCY_NS
        return buffered_bytes

    def _on_lost(self, how: str = "is lost: is it plugged in and powered?") -> None:
        """Mark the line as lost. Only the reader closes and reopens it, so that no thread uses a reused descriptor."""
        self._up = False
        self._status, self._status_s = f"{self._line.name} {how} Reopening", time.monotonic()
        self._retry_at_s = time.monotonic() + self._wait_s

    def _reopen(self, timeout_s: float) -> bool:
        self._close_line()
        pause_s = self._retry_at_s - time.monotonic()
        if pause_s > 0:
            time.sleep(min(timeout_s, pause_s))
            return False
        try:
            self._line.open()
        except LinkError:
            self._wait_s = min(2 * self._wait_s, RETRY_S[1])
            self._retry_at_s = time.monotonic() + self._wait_s
            return False
        self._rest, self._queued_bytes = b"", 0  # no thread writes while it is down
        self._in_flight.clear()
        self._up = not self._closed
        self.reconnects += 1
        return True

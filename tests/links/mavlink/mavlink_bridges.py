"""Lines that keep frames back: a real one between two sockets, and two with a rate, in simulated time."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from typing import Any

import pytest
from mavlink_poses import HOST0, good_pose
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.connection import Connection, Source_
from links.mavlink.gate import Limits
from links.mavlink.lines import StreamConnection
from links.mavlink.origin import OriginGiver
from links.mavlink.session import Session
from links.mavlink.speaker import PoseSpeaker
from links.mavlink.wire import packed, parse_frame

mavlink: Any = ardupilotmega
STEP_NS = 5_000_000
TICK_EACH = 10  # steps: the housekeeper's 50 ms
SPEAK_EACH = 20  # steps: the autopilot: 10 frames a second


class Bridge:
    """UDP between us and the autopilot: takes all at once, and hands on what is for the autopilot after a while."""

    def __init__(self, ours: int) -> None:
        self.delay_s = 0.0
        self._ours = "127.0.0.1", ours
        self._theirs: tuple[str, int] | None = None
        self._waiting: deque[tuple[float, bytes]] = deque()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self.port: int = self._socket.getsockname()[1]
        self._socket.settimeout(0.005)
        self._closed = threading.Event()
        self._thread = threading.Thread(target=self._run)

    def __enter__(self) -> Bridge:
        self._thread.start()
        return self

    def __exit__(self, *exception: object) -> None:
        self._closed.set()
        self._thread.join()
        self._socket.close()

    def _run(self) -> None:
        while not self._closed.is_set():
            with contextlib.suppress(TimeoutError, ConnectionRefusedError):
                data, source = self._socket.recvfrom(2048)
                if source == self._ours:
                    self._waiting.append((time.monotonic() + self.delay_s, data))
                else:
                    self._theirs = source
                    self._socket.sendto(data, self._ours)
            while self._theirs is not None and self._waiting and self._waiting[0][0] <= time.monotonic():
                self._socket.sendto(self._waiting.popleft()[1], self._theirs)


class RatedLine:
    """A line that takes all and passes it on at a rate; `backlog_bytes` as of a TCP or serial line."""

    name, backlog_bytes = "rated", 512

    def __init__(self, kbit_per_s: float) -> None:
        self.kbit_per_s = kbit_per_s
        self.hangs = False
        self._frames: deque[tuple[bytes, float]] = deque()  # and how much of it has not left

    def open(self) -> None:
        self._frames.clear()

    def read(self, timeout_s: float) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        self._frames.append((data, len(data)))
        return len(data)

    def waiting_bytes(self) -> int:
        return round(sum(left for _, left in self._frames))

    def close(self) -> None: ...

    def pass_on(self, seconds: float) -> list[bytes]:
        """Frames that have left meanwhile."""
        room, whole = 125 * self.kbit_per_s * seconds * (not self.hangs), list[bytes]()
        while self._frames and room > 0:
            data, left = self._frames.popleft()
            if left > room:
                self._frames.appendleft((data, left - room))
            else:
                whole.append(data)
            room -= left
        return whole


class RatedBridge:
    """A bridge behind a faster line: takes every datagram."""

    datagrams, status = True, None
    reconnects = foreign = stalls = left_late = 0

    def __init__(self, line: RatedLine) -> None:
        self.line = line

    def receive(self, timeout_s: float) -> tuple[bytes, Source_] | None: ...

    def answer_to(self, source: Source_) -> None: ...

    def send(self, frame: bytes) -> bool:
        return self.line.write(frame) > 0

    def close(self) -> None: ...


class SlowFlight:
    """A session over a slow line to an autopilot that speaks ten times a second and answers TIMESYNC, by our clock."""

    def __init__(self, kbit_per_s: float, monkeypatch: pytest.MonkeyPatch, bridge: bool) -> None:
        self.now_ns = HOST0
        self.line = RatedLine(kbit_per_s)
        self.pose_each = 4  # steps: 50 a second
        self.answers = self.speaks = True
        self._was_late = False
        self.ages_s: list[float] = []
        """Of each pose when it was handed on."""
        self.late_since_s: list[float] = []
        """When poses began to be held back as late."""
        self.got: list[Any] = []
        monkeypatch.setattr("links.mavlink.lines.time.monotonic", lambda: self.s)
        monkeypatch.setattr(Session, "_keep", lambda session: None)  # its steps are ours
        self.connection: Connection = RatedBridge(self.line) if bridge else StreamConnection(self.line)
        speaker = PoseSpeaker(("odometry",), Limits())
        self.session = Session(
            self.connection,
            (1, 1),
            (1, 197),
            speaker,
            OriginGiver(None, (1, 1)),
            None,
            lambda: self.now_ns,
            ("/autopilot/rx", "/autopilot/tx"),
        )
        self._mav = mavlink.MAVLink(None, 1, 1)
        self._steps = 0

    @property
    def s(self) -> float:
        """Since the beginning."""
        return 1e-9 * (self.now_ns - HOST0)

    def fly(self, seconds: float) -> None:
        """Poses, housekeeping, answers."""
        for _ in range(round(1e9 * seconds / STEP_NS)):
            self.now_ns += STEP_NS
            self._steps += 1
            if self.speaks and self._steps % SPEAK_EACH == 0:
                self._say(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
            if self._steps % self.pose_each == 0:
                self.session.pose(good_pose(self.now_ns))
            if self._steps % TICK_EACH == 3:
                self.session._tick(self.now_ns)
            for frame in self.line.pass_on(1e-9 * STEP_NS):
                self._hand_on(parse_frame(frame))
            self.connection.receive(0.0)
            late = self.session._trips.late
            if late and not self._was_late:
                self.late_since_s.append(self.s)
            self._was_late = late

    def _hand_on(self, message: Any) -> None:
        self.got.append(message)
        if message.get_type() == "ODOMETRY":
            self.ages_s.append(1e-6 * (self.now_ns // 1000 - message.time_usec))
        elif message.get_type() == "TIMESYNC" and message.tc1 == 0 and self.answers and self.speaks:
            self._say(mavlink.MAVLink_timesync_message(self.now_ns, message.ts1))

    def _say(self, message: Any) -> None:
        frame = packed(message, self._mav)
        self.session._hear(frame, parse_frame(frame), ("127.0.0.1", 1), self.now_ns)

    def count(self, kind: str) -> int:
        """Messages of a kind that were handed on."""
        return sum(message.get_type() == kind for message in self.got)

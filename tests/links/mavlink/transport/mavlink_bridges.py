"""Bridges and lines that delay frames: a real one between two sockets, and two with a rate, in simulated time."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
from collections import deque
from typing import Any

import pytest
from pymavlink.dialects.v20 import ardupilotmega

from links.mavlink.autopilot_session import AutopilotSession
from links.mavlink.origin import OriginSender
from links.mavlink.poses.gate import PoseLimits
from links.mavlink.poses.independence import Independence
from links.mavlink.poses.pose_sender import PoseSender
from links.mavlink.source_switch import SourceSwitch
from links.mavlink.streams.message_intervals import MessageIntervals, MessageRates
from links.mavlink.transport.connection import Address, Connection
from links.mavlink.transport.framing import packed, parse_frame
from links.mavlink.transport.stream_connection import StreamConnection
from tests.links.mavlink.mavlink_poses import HOST0, good_pose

mavlink: Any = ardupilotmega
STEP_NS = 5_000_000
TICK_STEPS = 10  # the session thread's 50 ms
FRAME_STEPS = 20  # the autopilot's 10 frames/s


class Bridge:
    """UDP bridge to the autopilot: accepts everything, and forwards frames to the autopilot after delay_s."""

    def __init__(self, grd_port: int) -> None:
        self.delay_s = 0.0
        self._grd = "127.0.0.1", grd_port
        self._autopilot: tuple[str, int] | None = None
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
                if source == self._grd:
                    self._waiting.append((time.monotonic() + self.delay_s, data))
                else:
                    self._autopilot = source
                    self._socket.sendto(data, self._grd)
            while self._autopilot is not None and self._waiting and self._waiting[0][0] <= time.monotonic():
                self._socket.sendto(self._waiting.popleft()[1], self._autopilot)


class RatedLine:
    """A line that accepts everything and transmits at a rate; `backlog_bytes` as of a TCP or serial line."""

    name, backlog_bytes = "rated", 512

    def __init__(self, kbit_per_s: float) -> None:
        self.kbit_per_s = kbit_per_s
        self.blocked = False
        self._frames: deque[tuple[bytes, float]] = deque()  # (frame, bytes not transmitted)

    def open(self) -> None:
        self._frames.clear()

    def read(self, timeout_s: float) -> bytes:
        return b""

    def write(self, data: bytes) -> int:
        self._frames.append((data, len(data)))
        return len(data)

    def buffered_bytes(self) -> int:
        return round(sum(left for _, left in self._frames))

    def close(self) -> None: ...

    def transmit(self, seconds: float) -> list[bytes]:
        """Frames that were transmitted completely in this time."""
        capacity, whole = 125 * self.kbit_per_s * seconds * (not self.blocked), list[bytes]()
        while self._frames and capacity > 0:
            data, left = self._frames.popleft()
            if left > capacity:
                self._frames.appendleft((data, left - capacity))
            else:
                whole.append(data)
            capacity -= left
        return whole


class RatedBridge:
    """A bridge behind a fast line: accepts every datagram."""

    datagrams, status = True, None
    reconnects = foreign = stalls = late_frames = 0

    def __init__(self, line: RatedLine) -> None:
        self.line = line

    def receive(self, timeout_s: float) -> tuple[bytes, Address] | None: ...

    def reply_to(self, source: Address) -> None: ...

    def send(self, frame: bytes) -> bool:
        return self.line.write(frame) > 0

    def close(self) -> None: ...


NO_REQUESTS = MessageRates(imu_hz=0, attitude_hz=0, position_hz=0, estimator_hz=0)


class SlowFlight:
    """A session over a slow line to an autopilot with ten frames/s that replies to TIMESYNC, on a simulated clock."""

    def __init__(self, kbit_per_s: float, monkeypatch: pytest.MonkeyPatch, bridge: bool) -> None:
        self.now_ns = HOST0
        self.line = RatedLine(kbit_per_s)
        self.pose_steps = 4  # 50 poses/s
        self.replies = self.active = True
        self._was_late = False
        self.ages_s: list[float] = []
        """Age of each pose when it was forwarded."""
        self.late_since_s: list[float] = []
        """When the link became late."""
        self.received: list[Any] = []
        monkeypatch.setattr("links.mavlink.transport.stream_connection.time.monotonic", lambda: self.s)
        monkeypatch.setattr(AutopilotSession, "_run", lambda session: None)  # the test calls its steps
        self.connection: Connection = RatedBridge(self.line) if bridge else StreamConnection(self.line)
        pose_sender = PoseSender(("odometry",), PoseLimits(), yaw="measured")
        self.session = AutopilotSession(
            self.connection,
            (1, 1),
            (1, 197),
            pose_sender,
            OriginSender(None, (1, 1), (1, 197)),
            MessageIntervals(NO_REQUESTS, "ardupilot", (1, 1), (1, 197)),
            SourceSwitch(2, False, (), (1, 1), (1, 197), pose_sender.texts.warn, 0.35),
            None,
            lambda: self.now_ns,
            ("/autopilot/rx", "/autopilot/tx"),
            Independence(),
        )
        self._mav = mavlink.MAVLink(None, 1, 1)
        self._steps = 0

    @property
    def s(self) -> float:
        """Time since the start."""
        return 1e-9 * (self.now_ns - HOST0)

    def fly(self, seconds: float) -> None:
        """Run poses, the session thread's steps, and replies."""
        for _ in range(round(1e9 * seconds / STEP_NS)):
            self.now_ns += STEP_NS
            self._steps += 1
            if self.active and self._steps % FRAME_STEPS == 0:
                self._reply(mavlink.MAVLink_heartbeat_message(2, 3, 0, 0, 4, 3))
            if self._steps % self.pose_steps == 0:
                self.session.send_pose(good_pose(self.now_ns))
            if self._steps % TICK_STEPS == 3:
                self.session.tick()
            for frame in self.line.transmit(1e-9 * STEP_NS):
                self._forward(parse_frame(frame))
            self.connection.receive(0.0)
            late = self.session._timesync.late
            if late and not self._was_late:
                self.late_since_s.append(self.s)
            self._was_late = late

    def _forward(self, message: Any) -> None:
        self.received.append(message)
        if message.get_type() == "ODOMETRY":
            self.ages_s.append(1e-6 * (self.now_ns // 1000 - message.time_usec))
        elif message.get_type() == "TIMESYNC" and message.tc1 == 0 and self.replies and self.active:
            self._reply(mavlink.MAVLink_timesync_message(self.now_ns, message.ts1))

    def _reply(self, message: Any) -> None:
        frame = packed(message, self._mav)
        self.session._on_frame(frame, parse_frame(frame), ("127.0.0.1", 1), self.now_ns)

    def count(self, kind: str) -> int:
        """Number of forwarded messages of a kind."""
        return sum(message.get_type() == kind for message in self.received)

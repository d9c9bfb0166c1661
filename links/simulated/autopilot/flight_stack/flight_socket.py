"""The autopilot in the loop on a UDP socket, in real time.

One thread flies the stack up to the present and moves frames: those of the stack leave when the simulated radio has
delivered them, those of the host enter the radio's other direction as they arrive. The simulated LiDAR reads the truth
from another thread, through `advance`.

Source: ours.
"""

from __future__ import annotations

import heapq
import threading
from collections.abc import Callable

from links.mavlink.transport.framing import FrameSplitter
from links.simulated.autopilot.flight_stack.stack import FlightStack
from links.simulated.autopilot.udp_thread import UdpThread


class FlightSocket(UdpThread):
    """A flight stack with a peer. `received`: frames of the host so far."""

    def __init__(
        self,
        stack: FlightStack,
        send_to: tuple[str, int],
        scenario_ns: Callable[[], int],
        bind: tuple[str, int] = ("127.0.0.1", 0),
    ) -> None:
        """`scenario_ns`: present time in the scenario, which has begun."""
        super().__init__(bind, "flight stack")
        self.received = 0
        self._stack, self._peer, self._scenario_ns = stack, send_to, scenario_ns
        self._lock = threading.Lock()
        self._splitter = FrameSplitter()
        self._waiting: list[tuple[int, int, bytes]] = []  # arrival, number, frame
        self._count = 0

    def advance(self, until_ns: int) -> None:
        """Fly until the truth is known up to a time; for the sensors of the rig."""
        with self._lock:
            self._stack.advance(until_ns)

    def step(self, datagram: tuple[bytes, tuple[str, int]] | None) -> None:
        """Fly up to the present, and move frames."""
        now_ns = self._scenario_ns()
        if datagram is not None:
            self._receive(datagram[0], now_ns)
        with self._lock:
            for record in self._stack.records(now_ns):
                self._count += 1
                heapq.heappush(self._waiting, (record.arrival_ns, self._count, record.data))
        while self._waiting and self._waiting[0][0] <= now_ns:
            frame = heapq.heappop(self._waiting)[2]
            try:
                self._socket.sendto(frame, self._peer)
            except OSError:  # no receiver: lost, as on a radio
                continue

    def _receive(self, data: bytes, now_ns: int) -> None:
        for frame, _ in self._splitter.datagram(data):
            self.received += 1
            with self._lock:
                self._stack.receive(frame, now_ns)

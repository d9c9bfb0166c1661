"""Records of the readings of the servo process, which is restarted when it ends by itself.

Source: ours.
"""

from __future__ import annotations

import json
import threading
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field

from flow.link import LinkError, PolledRecords, Readable, Record
from links.clock import host_time
from links.dynamixel import wire
from links.dynamixel.drive import DriveSettings
from links.dynamixel.mx28 import TICK_RAD, VELOCITY_UNIT_RADPS
from links.dynamixel.servo_process import ALIVE_S, ProcessEnded, ServoProcess

RESTART_S, MAX_STARTS = 0.1, 4  # pause before a restart of the process, times its number; starts without a reading
STATES = (
    "connected",
    "low_latency",
    "voltage_mv",
    "temperature_c",
)  # fields of wire.Health that are states, not totals
TOTALS = tuple(name for name in wire.Health._fields if name not in STATES)


@dataclass(slots=True)
class ServoHealth:
    """What the servo processes of a run have reported."""

    newest: wire.Health | None = None
    ended: Counter[str] = field(default_factory=Counter[str])  # totals of processes that have ended
    restarts: int = 0
    error: int = 0  # newest Hardware Error Status

    def end_process(self) -> None:
        """Keep the totals of a process that has ended."""
        if self.newest is not None:
            self.ended += Counter({name: getattr(self.newest, name) for name in TOTALS})
            self.newest = None

    @property
    def is_lost(self) -> bool:
        """Whether the servo was set up and does not reply now."""
        newest = self.newest
        return newest is not None and not newest.connected and self.ended["set_ups"] + newest.set_ups > 0

    @property
    def counters(self) -> dict[str, int]:
        """Totals since the start, and the newest states."""
        now = {} if self.newest is None else self.newest._asdict()
        totals = {name: now.get(name, 0) + self.ended[name] for name in TOTALS}
        totals |= {name: now.get(name, 0) for name in STATES}
        return totals | ({"process restarts": self.restarts} if self.restarts else {})


class Readings(PolledRecords):
    """Records of one servo's readings, from the start of its process to `close`."""

    def __init__(self, topic: str, settings: DriveSettings, health: ServoHealth) -> None:
        super().__init__()
        self._topic, self._settings, self._health = topic, settings, health
        self._host_ahead_ns = host_time.now_ns() - time.monotonic_ns()
        self._sequence, self._starts = 0, 1  # _starts: of the process, since the newest reading
        self._restart_s: float | None = None  # when the process is started again, monotonic
        self._lock = threading.Lock()  # for replacing the process, and for closing
        self.process = ServoProcess(settings)

    @property
    def files(self) -> Sequence[Readable]:
        """See PolledRecords."""
        return () if self._restart_s is not None else (self.process,)

    @property
    def wait_s(self) -> float:
        """See PolledRecords: the process stops the servo when it receives no Alive packets."""
        return ALIVE_S if self._restart_s is None else max(0.0, self._restart_s - time.monotonic())

    def pending(self) -> Iterator[Record]:
        """See PolledRecords. LinkError: the process has ended several times before a reading."""
        if self._restart_s is not None and time.monotonic() < self._restart_s:
            return
        if self._restart_s is not None:
            self._restart()
        try:
            yield from self._records()
        except ProcessEnded as ended:
            if self._starts == MAX_STARTS:
                raise LinkError(
                    f"the servo process ended {self._starts} times before it read the servo ({ended}): see its own "
                    "message above; is the memory full, or is this installation damaged?"
                ) from None
            self._restart_s = time.monotonic() + RESTART_S * self._starts

    def _records(self) -> Iterator[Record]:
        for packet in self.process.received():
            if isinstance(packet, wire.Health):
                self._health.newest = packet
            elif isinstance(packet, wire.Reading):
                self._health.error = packet.error
                yield reading_record(self._topic, packet, self._host_ahead_ns, self._sequence)
                self._sequence += 1
                self._starts = 0

    def _restart(self) -> None:
        """Replace a process that has ended; the servo's watchdog has stopped it meanwhile."""
        self.process.close()
        self._health.end_process()
        with self._lock:
            if not self.closed.is_set():
                self._health.restarts += 1
                self.process = ServoProcess(self._settings)
        self._restart_s = None
        self._starts += 1

    def send(self, packet: wire.Goal | wire.Stop) -> bool:
        """Send a packet to the process without waiting; False: it could not be sent."""
        return self.process.send(packet)

    def close(self) -> None:
        """End the process, which stops the servo; any thread may call this."""
        with self._lock:
            self.closed.set()
            process = self.process
        process.close()


def reading_record(topic: str, reading: wire.Reading, host_ahead_ns: int, sequence: int) -> Record:
    """Record of a reading: stamp mid-exchange, arrival with the reply. host_ahead_ns: host time - monotonic time."""
    state = {
        "position_rad": round(reading.position_ticks * TICK_RAD, 9),
        "velocity_radps": round(reading.velocity_units * VELOCITY_UNIT_RADPS, 9),
        "goal_rad": round(reading.goal_ticks * TICK_RAD, 9),
        "error": reading.error,
    }
    stamp_ns = (reading.request_ns + reading.reply_ns) // 2 + host_ahead_ns
    return Record(topic, reading.reply_ns + host_ahead_ns, stamp_ns, json.dumps(state).encode(), sequence)

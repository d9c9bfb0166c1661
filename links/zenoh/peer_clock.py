"""Clock of another host: the offset to the local timeline, with a bound of its error.

Each message bounds the offset from above (it cannot arrive before it was sent), each reply to a time request from
below; see `links.clock.device_clock`. There is no offset before the first reply, and none while the bound exceeds
`MAX_UNCERTAINTY_NS`: 25 ms are 25 cm at 10 m/s.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

from links.clock.device_clock import DeviceClock

MAX_UNCERTAINTY_NS = 25_000_000
CLOCK_OFFSET, CLOCK_UNCERTAINTY = "clock offset [us]", "clock uncertainty [us]"  # counters


class ClockOffset(NamedTuple):
    """Local time - peer time, and the bound of its error."""

    offset_ns: int
    uncertainty_ns: int


class PeerClock:
    """Clock of one other host. Thread safe."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._run: int | None = None
        self._clock = DeviceClock()
        self.reply_ns: int | None = None
        """Arrival of the newest reply, local time; None: none yet."""
        self.restarts = 0
        """How often the other host's process was restarted."""

    def on_reply(self, run: int, request_ns: int, peer_ns: int, arrival_ns: int) -> None:
        """Use a reply with the peer time peer_ns to the request at request_ns."""
        with self._lock:
            if run != self._run:
                self.restarts += self._run is not None
                self._run, self._clock = run, DeviceClock()
            self._clock.read(peer_ns, arrival_ns)
            if self._clock.round_trip(request_ns, peer_ns, arrival_ns):
                self.reply_ns = arrival_ns

    def on_message(self, run: int, sent_ns: int, arrival_ns: int) -> ClockOffset | None:
        """The offset for a message that was sent at sent_ns; None: not known well enough for this run of the peer."""
        with self._lock:
            if run != self._run or self._clock.read(sent_ns, arrival_ns) is None:
                return None
            offset = self._offset()
        return offset if offset and offset.uncertainty_ns <= MAX_UNCERTAINTY_NS else None

    @property
    def offset(self) -> ClockOffset | None:
        """The present offset; None before the first reply."""
        with self._lock:
            return self._offset()

    @property
    def counters(self) -> dict[str, int]:
        """The present offset, the bound of its error, and restarts; empty before the first reply."""
        offset = self.offset
        if offset is None:
            return {}
        return {
            CLOCK_OFFSET: offset.offset_ns // 1000,
            CLOCK_UNCERTAINTY: offset.uncertainty_ns // 1000,
            "peer restarts": self.restarts,
        }

    def _offset(self) -> ClockOffset | None:
        offset_ns, uncertainty_ns = self._clock.offset_ns, self._clock.uncertainty_ns
        return None if offset_ns is None or uncertainty_ns is None else ClockOffset(offset_ns, uncertainty_ns)

"""Another host's timeline told in ours, with what it may be wrong by.

Each message bounds the difference from above (it cannot arrive before it was sent), each answer to "what time is it?"
from below; see `links.clock.device_clock`. Nothing is told before there was an answer, and nothing when the
bounds are further apart than `MAX_UNCERTAINTY_NS`: 25 ms are 25 cm at 10 m/s.

Source: ours.
"""

from __future__ import annotations

import threading
from typing import NamedTuple

from links.clock.device_clock import DeviceClock

MAX_UNCERTAINTY_NS = 25_000_000


class Difference(NamedTuple):
    """Our time - theirs, and what that is wrong by at most."""

    offset_ns: int
    uncertainty_ns: int


class PeerClock:
    """The clock of one other host; fed by several threads."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._run: int | None = None
        self._clock = DeviceClock()
        self.answered_ns: int | None = None
        """When it answered last, our time."""
        self.restarts = 0
        """Times the other host's process began anew."""

    def answered(self, run: int, asked_ns: int, told_ns: int, arrival_ns: int) -> None:
        """We asked at asked_ns, the other host said told_ns, that was here at arrival_ns."""
        with self._lock:
            if run != self._run:
                self.restarts += self._run is not None
                self._run, self._clock = run, DeviceClock()
            self._clock.read(told_ns, arrival_ns)
            if self._clock.round_trip(asked_ns, told_ns, arrival_ns):
                self.answered_ns = arrival_ns

    def heard(self, run: int, sent_ns: int, arrival_ns: int) -> Difference | None:
        """The difference for a message sent then; None: not known (well enough) for this run of the other host."""
        with self._lock:
            if run != self._run or self._clock.read(sent_ns, arrival_ns) is None:
                return None
            difference = self._difference()
        return difference if difference and difference.uncertainty_ns <= MAX_UNCERTAINTY_NS else None

    @property
    def difference(self) -> Difference | None:
        """As it is known now; None before the first answer."""
        with self._lock:
            return self._difference()

    def _difference(self) -> Difference | None:
        offset_ns, uncertainty_ns = self._clock.offset_ns, self._clock.uncertainty_ns
        return None if offset_ns is None or uncertainty_ns is None else Difference(offset_ns, uncertainty_ns)

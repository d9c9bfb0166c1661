"""One timeline of the host: nanoseconds since 1970 that only ever go forward.

The wall clock is read once, when the process starts; from then on the monotonic clock counts. NTP, a GPS fix or a hand
on the clock may set the wall clock while a run goes on: nothing here moves. What the kernel stamps with the wall clock
(SO_TIMESTAMPNS) is mapped by `from_wall_ns`, which notices such a step.

Source: ours; clock_gettime(2), socket(7).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

STEP_NS = 1_000_000  # wall against monotonic since the call before; NTP slews by at most 0.5 ms in a second
PROMPT_NS, LOOKS = 20_000, 5  # two clocks read together
MAX_AGE_NS = 60_000_000_000  # a stamp further back says nothing; at 20 Hz a socket's buffer of 256 holds 13 s


class HostTime:
    """The monotonic clock, counted from the wall clock's reading at the start."""

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._start_ns = wall_ns() - monotonic_ns()
        self._wall_ahead_ns = 0  # wall - host at the newest look
        self._doubt_ns = 0  # of that look
        self._looked_ns = self._stepped_ns = self.now_ns()
        self._lock = threading.Lock()
        self.steps = 0
        """Times the wall clock was seen to be set."""

    def now_ns(self) -> int:
        """Now; never less than the call before gave."""
        return self._start_ns + self._monotonic_ns()

    def from_wall_ns(self, stamp_ns: int) -> int:
        """The host time of a moment just gone by that the kernel stamped with the wall clock.

        Where the wall clock was set after the stamp was taken, nobody knows how old the stamp is: then it is now.
        Too late, never too early: a sensor's clock that is read from the promptest packets stays right.
        """
        with self._lock:
            now_ns, ahead_ns, doubt_ns = self._look()
            slack_ns = STEP_NS + (now_ns - self._looked_ns) // 1000  # the clocks may drift apart by 1000 ppm
            slack_ns += doubt_ns + self._doubt_ns
            if abs(ahead_ns - self._wall_ahead_ns) > slack_ns:
                self.steps += 1
                self._stepped_ns = now_ns
            self._wall_ahead_ns, self._looked_ns, self._doubt_ns = ahead_ns, now_ns, doubt_ns
            host_ns = stamp_ns - ahead_ns
            believed = max(self._stepped_ns, now_ns - MAX_AGE_NS) <= host_ns <= now_ns
            return host_ns if believed else now_ns

    def _look(self) -> tuple[int, int, int]:
        """(now, wall - host, how much the latter may be off), by the promptest of a few readings.

        A reading that no other thread or process came between ends it; on a machine so loaded that there is none, what
        came between is not taken for a clock that was set.
        """
        looks = []
        while not looks or (looks[-1][0] >= PROMPT_NS and len(looks) < LOOKS):
            before_ns, wall_ns, after_ns = self.now_ns(), self._wall_ns(), self.now_ns()
            looks.append((after_ns - before_ns, wall_ns - after_ns))  # a stamp may come out late by that, never early
        doubt_ns, ahead_ns = min(looks)
        return after_ns, ahead_ns, doubt_ns


_HOST = HostTime()
now_ns = _HOST.now_ns
from_wall_ns = _HOST.from_wall_ns

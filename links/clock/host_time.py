"""Host time: a monotonic timeline in nanoseconds since 1970.

The wall clock is read once, when the process starts; after that the monotonic clock counts. When NTP, a GPS fix or an
operator sets the wall clock during a run, host time does not change. Stamps that the kernel takes from the wall clock
(SO_TIMESTAMPNS) are converted by `from_wall_ns`, which detects such a step.

Source: ours; clock_gettime(2), socket(7).
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable

STEP_NS = 1_000_000  # of the wall clock against the monotonic clock between two calls; NTP slews by at most 0.5 ms/s
PROMPT_NS, MAX_READINGS = 20_000, 5  # two clocks are read together when the reads take less than PROMPT_NS
MAX_AGE_NS = 60_000_000_000  # older stamps are invalid; a socket's buffer of 256 datagrams holds 13 s at 20 Hz


class HostTime:
    """The monotonic clock plus the wall clock's reading at the start."""

    def __init__(
        self, wall_ns: Callable[[], int] = time.time_ns, monotonic_ns: Callable[[], int] = time.monotonic_ns
    ) -> None:
        self._wall_ns, self._monotonic_ns = wall_ns, monotonic_ns
        self._start_ns = wall_ns() - monotonic_ns()
        self._wall_ahead_ns = 0  # wall - host at the newest reading
        self._error_ns = 0  # bound of that reading's error
        self._read_ns = self._stepped_ns = self.now_ns()
        self._lock = threading.Lock()
        self.steps = 0
        """How often a step of the wall clock was detected."""

    def now_ns(self) -> int:
        """Current host time; never less than the previous call returned."""
        return self._start_ns + self._monotonic_ns()

    def from_wall_ns(self, stamp_ns: int) -> int:
        """Host time of a recent kernel stamp of the wall clock.

        If the wall clock was set after the stamp was taken, the stamp's age is unknown and the result is the current
        time. The result can be late but not early, so an offset estimated from minimum delays stays correct.
        """
        with self._lock:
            now_ns, ahead_ns, error_ns = self._read_clocks()
            tolerance_ns = STEP_NS + (now_ns - self._read_ns) // 1000  # the clocks may drift by 1000 ppm
            tolerance_ns += error_ns + self._error_ns
            if abs(ahead_ns - self._wall_ahead_ns) > tolerance_ns:
                self.steps += 1
                self._stepped_ns = now_ns
            self._wall_ahead_ns, self._read_ns, self._error_ns = ahead_ns, now_ns, error_ns
            host_ns = stamp_ns - ahead_ns
            valid = max(self._stepped_ns, now_ns - MAX_AGE_NS) <= host_ns <= now_ns
            return host_ns if valid else now_ns

    def _read_clocks(self) -> tuple[int, int, int]:
        """(now, wall - host, bound of the latter's error), by the fastest of up to MAX_READINGS readings.

        A reading that took less than PROMPT_NS ends the loop. On a loaded machine without such a reading, the error
        bound covers the interruption, so that it is not mistaken for a step of the wall clock.
        """
        readings = []
        while not readings or (readings[-1][0] >= PROMPT_NS and len(readings) < MAX_READINGS):
            before_ns, wall_ns, after_ns = self.now_ns(), self._wall_ns(), self.now_ns()
            readings.append((after_ns - before_ns, wall_ns - after_ns))  # late by at most the duration, never early
        error_ns, ahead_ns = min(readings)
        return after_ns, ahead_ns, error_ns


_HOST = HostTime()
now_ns = _HOST.now_ns
from_wall_ns = _HOST.from_wall_ns

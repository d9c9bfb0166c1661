"""Filter of the servo's readings: rejects those whose time or position may be wrong.

A reading is stamped with the middle of its exchange. After an exchange that took much longer than usual, the time of
measurement is uncertain: at 55 rpm, 1 ms is 0.33 deg. A position that the servo cannot have reached is accepted only
when the next reading confirms it: one in 65536 damaged replies has a correct checksum.
"""

from __future__ import annotations

from collections import deque
from typing import Literal

from links.dynamixel import mx28
from links.dynamixel.drive import ARRIVED_TICKS, Measurement

SLOW_NS = 500_000  # an exchange is slow when it takes longer than twice the median plus this
WINDOW = 33  # exchanges in the median: it follows a change of the usual duration within 70 ms
MAX_TICKS_PER_S = 100 / 60 * mx28.STEPS_PER_TURN  # 100 rpm; the no-load speed is 67 rpm at 14.8 V

Reason = Literal["implausible", "slow"]


class ReadingFilter:
    """Accepts or rejects each reading, in order."""

    def __init__(self) -> None:
        self._durations_ns: deque[int] = deque(maxlen=WINDOW)
        self._accepted: Measurement | None = None  # the newest
        self._unconfirmed: Measurement | None = None  # the previous one, if it was rejected as implausible

    def reject_reason(self, reading: Measurement) -> Reason | None:
        """Why a reading is rejected: its position is implausible, or its exchange was slow. None: it is accepted."""
        accepted, unconfirmed = self._accepted, self._unconfirmed
        self._unconfirmed = None
        if accepted and not reachable(accepted, reading) and not (unconfirmed and reachable(unconfirmed, reading)):
            self._unconfirmed = reading
            return "implausible"
        duration_ns = reading.reply_ns - reading.request_ns
        median_ns = sorted(self._durations_ns)[len(self._durations_ns) // 2] if self._durations_ns else duration_ns
        self._durations_ns.append(duration_ns)
        if duration_ns > 2 * median_ns + SLOW_NS:
            return "slow"
        self._accepted = reading
        return None


def reachable(before: Measurement, after: Measurement) -> bool:
    """Whether the servo can have moved from one position to the other in the time between."""
    passed_s = 1e-9 * (after.reply_ns - before.request_ns)
    return abs(after.position_ticks - before.position_ticks) <= MAX_TICKS_PER_S * passed_s + ARRIVED_TICKS

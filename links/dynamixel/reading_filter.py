"""Which readings of the servo are told: not those whose time or place may be wrong.

A reading's time is mid-exchange. Where an exchange took much longer than usual, it is a guess: at 55 rpm 1 ms is 0.33
deg. And a place that the servo cannot have come to is not believed before it is told twice: of damaged answers one in
65536 has the right checksum.

Source: ours.
"""

from __future__ import annotations

from collections import deque

from links.dynamixel import mx28
from links.dynamixel.drive import ARRIVED_TICKS, Measured

SLOW_NS = 500_000  # an exchange longer than twice the usual and this
REMEMBERED = 33  # exchanges; half of them outvote a change of what is usual: 70 ms
FASTEST_TICKS_PER_S = 100 / 60 * mx28.STEPS_PER_TURN  # 100 rpm; without load it does 67 at 14.8 V


class ReadingFilter:
    """Looks at every reading, in order."""

    def __init__(self) -> None:
        self._took_ns: deque[int] = deque(maxlen=REMEMBERED)
        self._believed: Measured | None = None  # the newest
        self._doubted: Measured | None = None  # the one before, when it was not believed for its place

    def reject_reason(self, measured: Measured) -> str | None:
        """Why a reading is not to be told, "implausible" or "slow"; None when it is."""
        believed, doubted = self._believed, self._doubted
        self._doubted = None
        if believed and not reachable(believed, measured) and not (doubted and reachable(doubted, measured)):
            self._doubted = measured
            return "implausible"
        took_ns = measured.reply_ns - measured.request_ns
        usual_ns = sorted(self._took_ns)[len(self._took_ns) // 2] if self._took_ns else took_ns
        self._took_ns.append(took_ns)
        if took_ns > 2 * usual_ns + SLOW_NS:
            return "slow"
        self._believed = measured
        return None


def reachable(before: Measured, after: Measured) -> bool:
    """Whether the servo can have come from one place to the other in that time."""
    passed_s = 1e-9 * (after.reply_ns - before.request_ns)
    return abs(after.position_ticks - before.position_ticks) <= FASTEST_TICKS_PER_S * passed_s + ARRIVED_TICKS

"""The clock of a device that talks to us, an autopilot's since boot or another host's -> the host's timeline.

What is sought is the offset, host = device + offset. Two bounds hold it, and each message can only tighten them:

    a message cannot arrive before it was sent:        offset <= arrival - device
    an answer (MAVLink's TIMESYNC, tc1) came after its question (ts1): offset >= ts1 - tc1

The clocks drift apart by at most `drift_limit_ppm`, so a bound loosens by that much as it ages: one old prompt message
neither holds for ever nor is forgotten at once. The answer is the upper bound, late by the delay of the promptest
message; with TIMESYNC it is the middle of the two, wrong by at most half the round trip.

A link that delays *every* message by the same time hides that from one-way messages; only TIMESYNC tells.
A device clock that steps (a reboot) disagrees with the bounds: five disagreements in a row begin anew. Messages that
waited in a line that stood still disagree, too, but their times go on from those before: they tell nothing, unless
that lasts for longer than a line's buffers do.

Source: ours; https://mavlink.io/en/services/timesync.html for the exchange.
"""

from __future__ import annotations

from links.clock.clock_drift import ClockDrift

DISAGREEMENTS = 5  # in a row, then the device's clock was set and not the message damaged
BACKLOG_NS = 10_000_000_000  # what waited is through by then: who is still as late was off, or has another clock now
MAX_ROUND_TRIP_NS = 1_000_000_000  # a slower TIMESYNC reply tells nothing of use


class DeviceClock:
    """Turns device times into host times, message by message. Pure: the same messages give the same times."""

    def __init__(self, drift_limit_ppm: float = 100.0, jump_limit_ns: int = 5_000_000_000) -> None:
        self._drift = drift_limit_ppm * 1e-6
        self._jump_ns = jump_limit_ns
        self._base_ns = 0  # offsets are kept relative to this one, small enough for floats
        self._upper_ns: float | None = None  # offset bounds - base, as they were at host time _at_ns
        self._lower_ns: float | None = None
        self._at_ns = 0
        self._newest_ns = 0  # device time, of those believed
        self._disagreed = 0
        self._disagreed_at_ns = 0  # the first of them, host
        self.drift = ClockDrift()
        self.restarts = 0
        """Times the device's clock began anew."""
        self.round_trips = 0
        """TIMESYNC replies used."""

    @property
    def offset_ns(self) -> int | None:
        """host - device as far as it is known; None before the first message."""
        if self._upper_ns is None:
            return None
        middle = self._upper_ns if self._lower_ns is None else 0.5 * (self._upper_ns + self._lower_ns)
        return self._base_ns + round(middle)

    @property
    def uncertainty_ns(self) -> int | None:
        """The offset is wrong by at most this; None until a TIMESYNC reply bounds it from below."""
        if self._upper_ns is None or self._lower_ns is None:
            return None
        return round(0.5 * (self._upper_ns - self._lower_ns))

    def read(self, device_ns: int, arrival_ns: int) -> int | None:
        """Host time of `device_ns`, heard at `arrival_ns`, never after it; None while the device's clock disagrees."""
        if self._upper_ns is None:
            self._begin(arrival_ns - device_ns, arrival_ns)
        self._age(arrival_ns)
        late_ns = arrival_ns - device_ns - self._base_ns
        if self._upper_ns is None or abs(late_ns - self._upper_ns) > self._jump_ns:
            if self._disagreed == 0:
                self._disagreed_at_ns = arrival_ns
            self._disagreed += 1
            if self._disagreed < DISAGREEMENTS or self._waited(device_ns, late_ns, arrival_ns):
                return None
            self.restarts += 1
            self._begin(arrival_ns - device_ns, arrival_ns)
            late_ns = 0
        self._disagreed = 0
        self._newest_ns = max(self._newest_ns, device_ns)
        self._tighten(upper_ns=late_ns)
        return min(device_ns + (self.offset_ns or 0), arrival_ns)

    def round_trip(self, ts1_ns: int, tc1_ns: int, arrival_ns: int) -> bool:
        """A TIMESYNC reply: asked at host time ts1, answered at device time tc1. False: not ours, or no use."""
        if self._upper_ns is None or not 0 <= arrival_ns - ts1_ns <= MAX_ROUND_TRIP_NS:
            return False
        if self.read(tc1_ns, arrival_ns) is None:
            return False
        self._tighten(lower_ns=ts1_ns - tc1_ns - self._base_ns)
        self.drift.add(ts1_ns, tc1_ns, arrival_ns)
        self.round_trips += 1
        return True

    def forget_answers(self) -> None:
        """They may have been another's: the offset is held by one-way messages alone until the next."""
        self._lower_ns = None
        self.drift.clear()

    def _waited(self, device_ns: int, late_ns: float, arrival_ns: int) -> bool:
        """Whether a message too late for the bounds may be an old one of a clock that has not begun anew."""
        late = self._upper_ns is not None and late_ns > self._upper_ns
        goes_on = device_ns > self._newest_ns - self._jump_ns
        return late and goes_on and arrival_ns - self._disagreed_at_ns < BACKLOG_NS

    def _begin(self, offset_ns: int, arrival_ns: int) -> None:
        self._base_ns, self._upper_ns, self._lower_ns, self._at_ns = offset_ns, 0.0, None, arrival_ns
        self._disagreed = self._newest_ns = 0
        self.drift.clear()

    def _age(self, arrival_ns: int) -> None:
        slack = self._drift * max(arrival_ns - self._at_ns, 0)
        self._at_ns = max(arrival_ns, self._at_ns)
        if self._upper_ns is not None:
            self._upper_ns += slack
        if self._lower_ns is not None:
            self._lower_ns -= slack

    def _tighten(self, upper_ns: float | None = None, lower_ns: float | None = None) -> None:
        """Take a new bound where it is tighter. Bounds that cross: the new one holds, the other is forgotten."""
        if upper_ns is not None and self._upper_ns is not None and upper_ns < self._upper_ns:
            self._upper_ns = upper_ns
            if self._lower_ns is not None and self._lower_ns > upper_ns:
                self._lower_ns = None
        if lower_ns is not None and (self._lower_ns is None or lower_ns > self._lower_ns):
            self._lower_ns = lower_ns
            if self._upper_ns is not None and self._upper_ns < lower_ns:
                self._upper_ns = lower_ns

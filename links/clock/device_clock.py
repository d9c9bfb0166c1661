"""Host time of messages from a device with its own clock: an autopilot (time since boot) or another host.

The estimate is the offset in host = device + offset. Two bounds enclose it, and each message can only tighten them:

    a message cannot arrive before it was sent:                           offset <= arrival - device
    a reply (tc1, MAVLink TIMESYNC) is sent after its request (ts1):      offset >= ts1 - tc1

The clocks drift by at most `drift_limit_ppm`, so each bound loosens by that rate as it ages: an old message with a
short delay keeps its influence for a limited time. Without replies the offset is the upper bound, late by the smallest
message delay. With replies it is the middle of both bounds, with an error of at most half the round trip.

One-way messages cannot reveal a constant delay of the link; only replies can. A step of the device's clock (a reboot)
contradicts the bounds: five consecutive contradictions reset the estimate. Messages from a blocked and released link
contradict the bounds too, but their device times continue from the previous ones: they are ignored, unless this lasts
longer than a link can buffer (BACKLOG_NS).

Source: ours; https://mavlink.io/en/services/timesync.html for the exchange.
"""

from __future__ import annotations

from links.clock.clock_drift import ClockDrift

DISAGREEMENTS = 5  # consecutive ones: the device's clock was set, it is not one damaged message
BACKLOG_NS = 10_000_000_000  # a link's buffers are empty by then: later messages come from another clock
MAX_ROUND_TRIP_NS = 1_000_000_000  # slower replies are not used


class DeviceClock:
    """Converts device times to host times, message by message. Deterministic: the same messages give the same times."""

    def __init__(self, drift_limit_ppm: float = 100.0, jump_limit_ns: int = 5_000_000_000) -> None:
        self._drift = drift_limit_ppm * 1e-6
        self._jump_ns = jump_limit_ns
        self._base_ns = 0  # offsets are kept relative to this one, small enough for floats
        self._upper_ns: float | None = None  # offset bounds - base, valid at host time _at_ns
        self._lower_ns: float | None = None
        self._at_ns = 0
        self._newest_ns = 0  # device time of the newest accepted message
        self._disagreed = 0
        self._disagreed_at_ns = 0  # host time of the first of them
        self.drift = ClockDrift()
        self.restarts = 0
        """How often the device's clock was reset."""
        self.reboots = 0
        """How often it ran backwards in a reset: the device booted. In other resets it may have been set."""
        self.round_trips = 0
        """Number of replies used."""

    @property
    def offset_ns(self) -> int | None:
        """Estimate of host - device; None before the first message."""
        if self._upper_ns is None:
            return None
        middle = self._upper_ns if self._lower_ns is None else 0.5 * (self._upper_ns + self._lower_ns)
        return self._base_ns + round(middle)

    @property
    def uncertainty_ns(self) -> int | None:
        """Bound of the offset's error; None until a reply bounds the offset from below."""
        if self._upper_ns is None or self._lower_ns is None:
            return None
        return round(0.5 * (self._upper_ns - self._lower_ns))

    def read(self, device_ns: int, arrival_ns: int) -> int | None:
        """Host time of `device_ns` from a message that arrived at `arrival_ns`, never later; None: it contradicts."""
        if self._upper_ns is None:
            self._reset(arrival_ns - device_ns, arrival_ns)
        self._age(arrival_ns)
        late_ns = arrival_ns - device_ns - self._base_ns
        if self._upper_ns is None or abs(late_ns - self._upper_ns) > self._jump_ns:
            if self._disagreed == 0:
                self._disagreed_at_ns = arrival_ns
            self._disagreed += 1
            if self._disagreed < DISAGREEMENTS or self._was_buffered(device_ns, late_ns, arrival_ns):
                return None
            self.restarts += 1
            self.reboots += device_ns < self._newest_ns
            self._reset(arrival_ns - device_ns, arrival_ns)
            late_ns = 0
        self._disagreed = 0
        self._newest_ns = max(self._newest_ns, device_ns)
        self._tighten(upper_ns=late_ns)
        return min(device_ns + (self.offset_ns or 0), arrival_ns)

    def round_trip(self, ts1_ns: int, tc1_ns: int, arrival_ns: int) -> bool:
        """Use a reply (tc1, device time) to a request (ts1, host time). False: it is foreign or too slow."""
        if self._upper_ns is None or not 0 <= arrival_ns - ts1_ns <= MAX_ROUND_TRIP_NS:
            return False
        if self.read(tc1_ns, arrival_ns) is None:
            return False
        self._tighten(lower_ns=ts1_ns - tc1_ns - self._base_ns)
        self.drift.add(ts1_ns, tc1_ns, arrival_ns)
        self.round_trips += 1
        return True

    def forget_replies(self) -> None:
        """Forget the replies so far, which may be foreign: one-way messages alone bound the offset until the next."""
        self._lower_ns = None
        self.drift.clear()

    def _was_buffered(self, device_ns: int, late_ns: float, arrival_ns: int) -> bool:
        """Whether a message that is too late for the bounds may have been buffered, with the clock unchanged."""
        late = self._upper_ns is not None and late_ns > self._upper_ns
        continues = device_ns > self._newest_ns - self._jump_ns
        return late and continues and arrival_ns - self._disagreed_at_ns < BACKLOG_NS

    def _reset(self, offset_ns: int, arrival_ns: int) -> None:
        self._base_ns, self._upper_ns, self._lower_ns, self._at_ns = offset_ns, 0.0, None, arrival_ns
        self._disagreed = self._newest_ns = 0
        self.drift.clear()

    def _age(self, arrival_ns: int) -> None:
        loosening = self._drift * max(arrival_ns - self._at_ns, 0)
        self._at_ns = max(arrival_ns, self._at_ns)
        if self._upper_ns is not None:
            self._upper_ns += loosening
        if self._lower_ns is not None:
            self._lower_ns -= loosening

    def _tighten(self, upper_ns: float | None = None, lower_ns: float | None = None) -> None:
        """Apply a new bound if it is tighter. If the bounds cross, the new one is kept and the other dropped."""
        if upper_ns is not None and self._upper_ns is not None and upper_ns < self._upper_ns:
            self._upper_ns = upper_ns
            if self._lower_ns is not None and self._lower_ns > upper_ns:
                self._lower_ns = None
        if lower_ns is not None and (self._lower_ns is None or lower_ns > self._lower_ns):
            self._lower_ns = lower_ns
            if self._upper_ns is not None and self._upper_ns < lower_ns:
                self._upper_ns = lower_ns

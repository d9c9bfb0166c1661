"""The sensor's microseconds of the hour -> nanoseconds on the host's timeline.

`free`: the sensor's clock has any phase. Device time + offset is the answer; a packet can only come late, so

    offset = least (host - device) of the last 0.5 to 1 s

and one prompt packet ends the lateness of all. What remains: the delay of the *fastest* packet, which no packet tells,
and the drift of the two clocks over that time (50 us at 50 parts per million). Where the offset falls, the pulses of
two packets overlap by as much. A stamp that is late by less than the sensor's own resolution (1 us) is taken as it is:
stamps that are exact, as in simulated recordings, stay exact to the ns.

`utc`: the sensor is locked to UTC by GPS or PTP, and so is the host: the hour nearest to the host's stamp is added,
nothing is estimated.

Source: ours; VLP-16 User Manual 63-9243 Rev. E, section 9.3.1.6 (time stamp).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from links.velodyne import vlp16
from links.velodyne.reject_reason import RejectReason

ClockMode = Literal["free", "utc"]

RESOLUTION_NS = 1_000
HALF_WINDOW_NS = 500_000_000
REORDER_US = 50_000  # a step back within this is a late or repeated packet, beyond it the clock was set


class PacketTime(NamedTuple):
    """One packet's time."""

    stamp_ns: int  # of its first pulse, on the host's timeline
    gap_ns: int  # device time since the packet before; 0 when unknown


class LidarClock:
    """Turns device times into host times, packet by packet. Pure: the same packets give the same stamps."""

    def __init__(self, mode: ClockMode = "free", limit_ns: int = 500_000_000) -> None:
        self._read = self._read_free if mode == "free" else self._read_utc
        self._limit_ns = limit_ns
        self._last_us: int | None = None
        self._device_ns = 0  # since the anchor, hour wraps counted
        # Least host - device in the present half window (until device time _half_ends_ns) and in the one before.
        self._least_ns = 0
        self._least_before_ns = 0
        self._half_ends_ns = 0
        self.disagreements = 0
        """Times that device and host differed by more than the limit: in `free` each one began a new offset."""

    def read(self, device_us: int, host_ns: int) -> PacketTime | RejectReason:
        """Time of a packet from its device time [us of the hour] and the host's idea of it [ns]."""
        return self._read(device_us, host_ns)

    def _read_free(self, device_us: int, host_ns: int) -> PacketTime | RejectReason:
        if self._last_us is None:
            return self._anchor(device_us, host_ns)
        step_us = _wrap(device_us - self._last_us, vlp16.HOUR_US)
        device_ns = self._device_ns + 1_000 * step_us
        offset_ns = host_ns - device_ns
        if abs(offset_ns - self._least_ns) > self._limit_ns or step_us < -REORDER_US:
            self.disagreements += 1
            return self._anchor(device_us, host_ns)
        if step_us <= 0:
            return RejectReason.ORDER
        if device_ns >= self._half_ends_ns:
            long_ago = device_ns >= self._half_ends_ns + HALF_WINDOW_NS
            self._least_before_ns = offset_ns if long_ago else self._least_ns
            self._least_ns = offset_ns
            self._half_ends_ns = device_ns + HALF_WINDOW_NS
        self._last_us = device_us
        self._device_ns = device_ns
        self._least_ns = min(self._least_ns, offset_ns)
        least_ns = min(self._least_ns, self._least_before_ns)
        return PacketTime(host_ns if offset_ns - least_ns <= RESOLUTION_NS else device_ns + least_ns, 1_000 * step_us)

    def _anchor(self, device_us: int, host_ns: int) -> PacketTime:
        self._last_us = device_us
        self._device_ns = 0
        self._least_ns = self._least_before_ns = host_ns
        self._half_ends_ns = HALF_WINDOW_NS
        return PacketTime(host_ns, 0)

    def _read_utc(self, device_us: int, host_ns: int) -> PacketTime | RejectReason:
        early_ns = _wrap(1_000 * device_us - host_ns, 1_000 * vlp16.HOUR_US)
        if abs(early_ns) > self._limit_ns:
            self.disagreements += 1
            return RejectReason.CLOCK
        step_us = 0 if self._last_us is None else _wrap(device_us - self._last_us, vlp16.HOUR_US)
        if self._last_us is not None and -REORDER_US <= step_us <= 0:
            return RejectReason.ORDER
        self._last_us = device_us
        return PacketTime(host_ns if abs(early_ns) <= RESOLUTION_NS else host_ns + early_ns, 1_000 * max(step_us, 0))


def _wrap(difference: int, turn: int) -> int:
    """Bring a difference of two positions on a circle into [-turn/2, turn/2)."""
    return (difference + turn // 2) % turn - turn // 2

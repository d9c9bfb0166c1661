"""Host time of LiDAR packets from the sensor's microseconds of the hour.

`free`: the phase of the sensor's clock is unknown. Host time is device time + offset. A packet can arrive late but not
early, so

    offset = min(host - device) over the last 0.5 to 1 s

One packet without queueing delay corrects all others. The remaining error is the delay of the *fastest* packet, which
cannot be observed, and the drift of the two clocks over the window (50 us at 50 ppm). When the offset decreases, the
pulses of two consecutive packets overlap by the same amount. A stamp that is late by less than the sensor's resolution
(1 us) is kept: exact stamps, as in simulated recordings, stay exact to the nanosecond.

`utc`: sensor and host are locked to UTC by GPS or PTP. The hour nearest to the host's stamp is added; nothing is
estimated.

Source: ours; VLP-16 User Manual 63-9243 Rev. E, section 9.3.1.6 (time stamp).
"""

from __future__ import annotations

from typing import Literal, NamedTuple

from links.lidar.reject_reason import HOUR_US, PacketRejectReason

ClockMode = Literal["free", "utc"]

RESOLUTION_NS = 1_000
HALF_WINDOW_NS = 500_000_000
REORDER_US = 50_000  # a smaller backward step is a late or repeated packet, a larger one means the clock was set


class PacketTime(NamedTuple):
    """Time of one packet."""

    stamp_ns: int  # of its first pulse, on the host's timeline
    gap_ns: int  # device time since the previous packet; 0: unknown


class LidarClock:
    """Converts device times to host times, packet by packet. Deterministic: the same packets give the same stamps."""

    def __init__(self, mode: ClockMode = "free", limit_ns: int = 500_000_000) -> None:
        self._read = self._read_free if mode == "free" else self._read_utc
        self._limit_ns = limit_ns
        self._last_us: int | None = None
        self._device_ns = 0  # since the anchor, hour wraps counted
        # Minimum of host - device in the current half window (until device time _half_ends_ns) and in the previous one.
        self._min_ns = 0
        self._previous_min_ns = 0
        self._half_ends_ns = 0
        self.disagreements = 0
        """How often device and host differed by more than the limit; in mode `free` each resets the offset."""

    def read(self, device_us: int, host_ns: int) -> PacketTime | PacketRejectReason:
        """Time of a packet from its device time [us of the hour] and its host stamp [ns], or why it is rejected."""
        return self._read(device_us, host_ns)

    def _read_free(self, device_us: int, host_ns: int) -> PacketTime | PacketRejectReason:
        if self._last_us is None:
            return self._anchor(device_us, host_ns)
        step_us = _wrap(device_us - self._last_us, HOUR_US)
        device_ns = self._device_ns + 1_000 * step_us
        offset_ns = host_ns - device_ns
        if abs(offset_ns - self._min_ns) > self._limit_ns or step_us < -REORDER_US:
            self.disagreements += 1
            return self._anchor(device_us, host_ns)
        if step_us <= 0:
            return PacketRejectReason.ORDER
        if device_ns >= self._half_ends_ns:
            gap = device_ns >= self._half_ends_ns + HALF_WINDOW_NS
            self._previous_min_ns = offset_ns if gap else self._min_ns
            self._min_ns = offset_ns
            self._half_ends_ns = device_ns + HALF_WINDOW_NS
        self._last_us = device_us
        self._device_ns = device_ns
        self._min_ns = min(self._min_ns, offset_ns)
        min_ns = min(self._min_ns, self._previous_min_ns)
        return PacketTime(host_ns if offset_ns - min_ns <= RESOLUTION_NS else device_ns + min_ns, 1_000 * step_us)

    def _anchor(self, device_us: int, host_ns: int) -> PacketTime:
        self._last_us = device_us
        self._device_ns = 0
        self._min_ns = self._previous_min_ns = host_ns
        self._half_ends_ns = HALF_WINDOW_NS
        return PacketTime(host_ns, 0)

    def _read_utc(self, device_us: int, host_ns: int) -> PacketTime | PacketRejectReason:
        early_ns = _wrap(1_000 * device_us - host_ns, 1_000 * HOUR_US)
        if abs(early_ns) > self._limit_ns:
            self.disagreements += 1
            return PacketRejectReason.CLOCK
        step_us = 0 if self._last_us is None else _wrap(device_us - self._last_us, HOUR_US)
        if self._last_us is not None and -REORDER_US <= step_us <= 0:
            return PacketRejectReason.ORDER
        self._last_us = device_us
        return PacketTime(host_ns if abs(early_ns) <= RESOLUTION_NS else host_ns + early_ns, 1_000 * max(step_us, 0))


def _wrap(difference: int, turn: int) -> int:
    """A difference on a circle, wrapped into [-turn/2, turn/2)."""
    return (difference + turn // 2) % turn - turn // 2

"""One autopilot's frames in turn: sequence, clock and counts; each frame that says something becomes a message.

Each frame stands alone, so a damaged one cannot take the next with it. What is damaged, foreign or makes no sense is
counted and left out; nothing here raises over a radio's bytes.

Source: https://mavlink.io/en/messages/common.html; what to do about late, lost and repeated frames is ours.
"""

from __future__ import annotations

from collections import Counter
from typing import Any

from flow.link import Record
from links.clock.device_clock import DeviceClock
from links.mavlink.framing import SEQUENCE, header, known, parse_frame, timesync_target
from links.mavlink.readers import READERS, TIMELESS_READERS, AutopilotMessage
from stages.messages import AutopilotStatus

HALF_MS_NS = 500_000  # time_boot_ms is cut off, not rounded: on average half a millisecond early
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
CRITICAL = 5  # MAV_STATE_CRITICAL; above: emergency, poweroff, termination
LATE = 128  # a sequence number this far ahead is a late frame, not 128 lost ones


class FrameDecoder:
    """Decodes frames in turn; keeps the clock, the sequence and the counts."""

    def __init__(self, sender: tuple[int, int], own: tuple[int, int], clock: DeviceClock) -> None:
        self.clock = clock
        self.decoded = self.unused = self.lost = 0
        self.refused: Counter[str] = Counter()
        self._sender, self._own = sender, own
        self._sequence: int | None = None
        self._last_ns: dict[str, int] = {}  # stamp of the last message of a kind
        self._late: int | None = None  # a number from the past, seen just before
        self._matched = False  # answers to our TIMESYNC come with its time as their stamp

    def decode(self, record: Record) -> AutopilotMessage | None:
        """The message of one frame; None when it says nothing of use here or is refused (see `refused`)."""
        try:
            frame = parse_frame(record.data)
        except ValueError:
            return self._refuse("damaged")
        sender, number = header(record.data)
        if sender != self._sender:
            return self._refuse("from another system")
        kind = frame.get_type()
        if not known(frame):  # without its checksum: believed only where the number fits
            if self._sequence is not None and number == (self._sequence + 1) % SEQUENCE:
                self._sequence = number
            return self._refuse("unknown message")
        if not self._in_sequence(number):
            return self._refuse("repeated or late")
        if kind == "TIMESYNC":
            return self._timesync(frame, record)
        if kind == "HEARTBEAT":
            self.decoded += 1
            return self._status(frame, record.arrival_ns)
        timeless = TIMELESS_READERS.get(kind)
        if timeless is not None:
            self.decoded += 1
            return timeless(frame, record.arrival_ns)
        reader = READERS.get(kind)
        if reader is None:
            self.unused += 1
            return None
        stamp_ns = self._stamp(frame, record.arrival_ns)
        if stamp_ns is None:
            return self._refuse("time disagrees")
        if stamp_ns <= self._last_ns.get(kind, -1):  # a prompter message has shown that those before were late
            return self._refuse("not after the one before")
        try:
            message = reader(frame, stamp_ns)
        except ValueError as error:
            return self._refuse(str(error))
        self._last_ns[kind] = stamp_ns
        self.decoded += 1
        return message

    def _stamp(self, frame: Any, arrival_ns: int) -> int | None:
        """When it was true, on the host's timeline; None while the device's clock disagrees with itself."""
        in_ms = hasattr(frame, "time_boot_ms")
        device_ns = frame.time_boot_ms * 1_000_000 if in_ms else frame.time_usec * 1_000
        stamp_ns = self.clock.read(device_ns, arrival_ns)
        return stamp_ns if stamp_ns is None else min(stamp_ns + HALF_MS_NS * in_ms, arrival_ns)

    def _in_sequence(self, number: int) -> bool:
        if self._sequence is not None:
            ahead = (number - self._sequence) % SEQUENCE
            if ahead == 0 or ahead >= LATE:
                restarted = self._late is not None and number == (self._late + 1) % SEQUENCE
                self._late = number
                if not restarted:
                    return False
            else:
                self.lost += ahead - 1
        self._sequence, self._late = number, None
        return True

    def _timesync(self, frame: Any, record: Record) -> None:
        """The session matches answers with our own requests; what was recorded without that is taken by who is named.

        One that names nobody is then taken for ours when its times may be: behind a router it can be another's still.
        """
        if frame.tc1 == 0:
            self.unused += 1  # the autopilot asks; answering is the sender's part
            return
        matches = record.stamp_ns == frame.ts1
        if matches and not self._matched:
            self._matched = True
            self.clock.forget_replies()
        named = zip(timesync_target(record.data), self._own, strict=True)
        if not matches and (self._matched or any(name not in (0, ours) for name, ours in named)):
            self._refuse("timesync for another")
        elif not self.clock.round_trip(frame.ts1, frame.tc1, record.arrival_ns):
            self._refuse("timesync of another's or too slow")

    def _status(self, frame: Any, arrival_ns: int) -> AutopilotStatus:
        drift_ppm, drift_sigma_ppm = self.clock.drift.ppm or (None, None)
        return AutopilotStatus(
            stamp_ns=arrival_ns,  # a heartbeat carries no time
            armed=bool(frame.base_mode & ARMED),
            custom_mode=frame.custom_mode,
            failsafe=frame.system_status >= CRITICAL,
            lost_frames=self.lost,
            clock_offset_ns=self.clock.offset_ns,
            clock_uncertainty_ns=self.clock.uncertainty_ns,
            clock_drift_ppm=drift_ppm,
            clock_drift_sigma_ppm=drift_sigma_ppm,
        )

    def _refuse(self, reason: str) -> None:
        self.refused[reason] += 1

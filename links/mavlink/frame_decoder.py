"""Decoder of one autopilot's frames to messages, with its clock, sequence numbers and counters.

Each frame is decoded on its own, so a damaged one does not affect the next. Damaged, foreign and invalid frames are
counted and skipped; no received bytes raise an exception.

Each position, velocity and attitude is marked with whether it is independent of the poses that we sent
(`independence.py`). In replay the sent frames are on a topic of their own. Positions that PX4 sends without aiding are
rejected (`poses/autopilot_estimate.py`).

Source: https://mavlink.io/en/messages/common.html; the handling of late, lost and repeated frames is ours.
"""

from __future__ import annotations

import dataclasses
from collections import Counter
from typing import Any

from flow.link import Record
from links.clock.device_clock import DeviceClock
from links.mavlink.poses.autopilot_estimate import position_is_aided
from links.mavlink.poses.independence import Independence
from links.mavlink.poses.odom_frame import read_odom_frame
from links.mavlink.readers import READERS, TIMELESS_READERS, AutopilotMessage, is_ranging_radio
from links.mavlink.streams.imu_stamps import DELAY_NS, ImuSelection
from links.mavlink.transport.framing import SEQUENCE, header, known, parse_frame, timesync_target
from stages.messages import (
    AutopilotStatus,
    DroneAttitude,
    DroneGlobalPosition,
    DroneLocalPosition,
    DroneOdometry,
    EarlierOdomFrame,
)

BOOT_TIME_TRUNCATION_NS = 500_000  # time_boot_ms is truncated, on average half a millisecond early
ARMED = 128  # MAV_MODE_FLAG_SAFETY_ARMED
CRITICAL = 5  # MAV_STATE_CRITICAL; above: emergency, poweroff, termination
FOREIGN_TIMESYNC = "TIMESYNC for another component"  # reason in `rejected`
ESTIMATES = (DroneAttitude, DroneLocalPosition, DroneOdometry, DroneGlobalPosition)
ARRIVAL_STAMPED = "GPS_RAW_INT"  # its time is that of the last fix, long ago without one, or since 1970: no clock
POSITIONS = frozenset({"LOCAL_POSITION_NED", "ODOMETRY", "GLOBAL_POSITION_INT"})
LATE = 128  # a sequence number this far ahead is a late frame, not 128 lost frames


class FrameDecoder:
    """Decodes frames in order; holds the clock, the sequence number and the counters."""

    def __init__(self, sender: tuple[int, int], own: tuple[int, int], clock: DeviceClock) -> None:
        self.clock = clock
        self.independence = Independence()
        self.decoded = self.unused = self.lost = 0
        self.rejected: Counter[str] = Counter()
        self._sender, self._own = sender, own
        self._sequence: int | None = None
        self._last_ns: dict[str, int] = {}  # stamp of the newest message per type
        self._late: int | None = None  # an older sequence number, received immediately before
        self._imu = ImuSelection()
        self._aided = True
        self._matched = False  # replies to our TIMESYNC are recorded with the request's time as stamp

    def decode(self, record: Record) -> AutopilotMessage | EarlierOdomFrame | None:
        """The message of one frame; None for an unused or rejected frame (see `rejected`)."""
        try:
            frame = parse_frame(record.data)
        except ValueError:
            return self._reject("damaged")
        sender, number = header(record.data)
        if sender == self._own:
            return self._earlier_run(frame, record.stamp_ns)
        if sender != self._sender:
            return self._reject("from another system")
        kind = frame.get_type()
        if not known(frame):  # its checksum is unknown: its number is used only if it is the expected one
            if self._sequence is not None and number == (self._sequence + 1) % SEQUENCE:
                self._sequence = number
            return self._reject("unknown message")
        if not self._in_sequence(number):
            return self._reject("repeated or late")
        if kind == "TIMESYNC":
            return self._timesync(frame, record)
        if kind == "HEARTBEAT":
            self.decoded += 1
            return self._status(frame, record.arrival_ns)
        timeless = TIMELESS_READERS.get(kind)
        if timeless is not None:
            self.decoded += 1
            return timeless(frame, record.arrival_ns)
        aided = position_is_aided(frame)
        self._aided = self._aided if aided is None else aided
        if kind in POSITIONS and not self._aided:
            return self._reject("position without aiding")
        reader = READERS.get(kind)
        used = is_ranging_radio(frame) if kind == "DISTANCE_SENSOR" else self._imu.accepts(kind, record.arrival_ns)
        if reader is None or not used:
            self.unused += 1
            return None
        stamp_ns = self._stamp(frame, record.arrival_ns)
        if stamp_ns is None:
            return self._reject("inconsistent time")
        if stamp_ns <= self._last_ns.get(kind, -1):  # a faster message has corrected the clock
            return self._reject("not newer than the last one")
        try:
            message = reader(frame, stamp_ns)
            if isinstance(message, ESTIMATES):
                message = dataclasses.replace(message, independent=self._independent(record.arrival_ns))
        except ValueError as error:
            return self._reject(str(error))
        self._last_ns[kind] = stamp_ns
        self.decoded += 1
        return message

    def _earlier_run(self, frame: Any, stamp_ns: int) -> EarlierOdomFrame | None:
        """State of an earlier run, which the session reports as a received frame of our own."""
        try:
            return read_odom_frame(frame, stamp_ns)
        except (AttributeError, ValueError):
            return self._reject("echo of our own")

    def _stamp(self, frame: Any, arrival_ns: int) -> int | None:
        """Time of the measurement on the host's timeline; None while the device's clock is inconsistent."""
        in_ms, kind = hasattr(frame, "time_boot_ms"), frame.get_type()
        if kind == ARRIVAL_STAMPED:
            return arrival_ns
        device_ns = frame.time_boot_ms * 1_000_000 if in_ms else frame.time_usec * 1000
        stamp_ns = self.clock.read(device_ns, arrival_ns)
        if stamp_ns is None:
            return None
        return min(stamp_ns + BOOT_TIME_TRUNCATION_NS * in_ms, arrival_ns) - DELAY_NS.get(kind, 0)

    def sent(self, record: Record) -> None:
        """A frame that we sent, from a recording."""
        try:
            self.independence.on_sent(parse_frame(record.data).get_type(), record.stamp_ns)
        except ValueError:
            self._reject("damaged")

    def _independent(self, arrival_ns: int) -> bool:
        if self.clock.offset_ns is not None:
            self.independence.on_clock(self.clock.offset_ns, self.clock.reboots)
        return self.independence.at(arrival_ns)

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
        """Use a TIMESYNC reply that the session matched to a request; in other recordings, use its target field.

        A reply without target is then accepted if its times are plausible; behind a router it can still be foreign.
        """
        if frame.tc1 == 0:
            self.unused += 1  # a request of the autopilot; the session replies to it
            return
        matches = record.stamp_ns == frame.ts1
        if matches and not self._matched:
            self._matched = True
            self.clock.forget_replies()
        targets = zip(timesync_target(record.data), self._own, strict=True)
        if not matches and (self._matched or any(name not in (0, ours) for name, ours in targets)):
            self._reject(FOREIGN_TIMESYNC)
        elif not self.clock.round_trip(frame.ts1, frame.tc1, record.arrival_ns):
            self._reject("TIMESYNC foreign or too slow")

    def _status(self, frame: Any, arrival_ns: int) -> AutopilotStatus:
        drift_ppm, drift_sigma_ppm = self.clock.drift.ppm or (None, None)
        return AutopilotStatus(
            stamp_ns=arrival_ns,  # HEARTBEAT has no time stamp
            armed=bool(frame.base_mode & ARMED),
            custom_mode=frame.custom_mode,
            failsafe=frame.system_status >= CRITICAL,
            lost_frames=self.lost,
            clock_offset_ns=self.clock.offset_ns,
            clock_uncertainty_ns=self.clock.uncertainty_ns,
            clock_drift_ppm=drift_ppm,
            clock_drift_sigma_ppm=drift_sigma_ppm,
        )

    def _reject(self, reason: str) -> None:
        self.rejected[reason] += 1

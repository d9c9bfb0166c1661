"""A Velodyne's position packet: GPS time, and whether the sensor's clock is locked to it.

Source: VLP-16 User Manual 63-9243 Rev. E, section 9.3.3, tables 9-3 and 9-4. The manual counts from the Ethernet
frame's start; the offsets here count from the UDP payload's start (42 bytes less).
"""

from __future__ import annotations

import enum
from collections import Counter
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta

from flow.link import LinkError
from links.lidar.reject_reason import HOUR_US
from links.lidar.velodyne import POSITION_BYTES

_TIMESTAMP_AT = 0xF0 - 42
_PPS_AT = 0xF4 - 42
_NMEA_AT = 0xF8 - 42


class Pps(enum.Enum):
    """Table 9-4: state of the pulse per second at the sensor's interface box."""

    ABSENT = 0
    SYNCHRONIZING = 1
    LOCKED = 2
    ERROR = 3


@dataclass(frozen=True, slots=True)
class Position:
    """One position packet."""

    timestamp_us: int  # the sensor's microseconds of the hour when it composed the packet
    pps: Pps
    nmea: str  # the last GPRMC sentence as received, "" without one
    gps_utc: datetime | None  # its date and time; None without a valid sentence
    gps_valid: bool  # the receiver reports a valid fix (status A)


class PpsMonitor:
    """State of the sensor's clock by its position packets, and counters since the start."""

    def __init__(self) -> None:
        self.pps: Pps | None = None
        """State in the newest packet; None before the first."""
        self._counts: Counter[str] = Counter()
        self._gps_valid = False

    @property
    def locked(self) -> bool:
        """Whether the sensor's clock is locked to UTC: locked to the pulse per second, with a valid GPS time."""
        return self.pps is Pps.LOCKED and self._gps_valid

    def add(self, data: bytes) -> None:
        """Take one packet. A payload that is not a position packet is only counted."""
        try:
            position = parse_position(data)
        except LinkError:
            self._counts["position packets damaged"] += 1
            return
        self._counts["position packets"] += 1
        if self.locked and not (position.pps is Pps.LOCKED and position.gps_valid):
            self._counts["PPS locks lost"] += 1
        self.pps, self._gps_valid = position.pps, position.gps_valid

    @property
    def counters(self) -> dict[str, int]:
        """Totals, and the state in the newest packet as 1 or 0; empty before the first packet."""
        if not self._counts:
            return {}
        state = {f"PPS {pps.name.lower()}": int(pps is self.pps) for pps in Pps}
        return {**self._counts, **state, "GPS time valid": int(self._gps_valid)}

    def describe(self) -> str:
        """The state as part of a sentence."""
        if self.pps is None:
            return "no position packet has arrived"
        gps = "its GPS time is valid" if self._gps_valid else "its GPS time is not valid"
        return f"its PPS is {self.pps.name.lower()}, {gps}"


def parse_position(data: bytes) -> Position:
    """Parse a position packet (UDP payload of 512 bytes). Raises LinkError when it is not one."""
    if len(data) != POSITION_BYTES:
        raise LinkError(f"a position packet has {POSITION_BYTES} bytes, this one {len(data)}: is it UDP 8308?")
    timestamp_us = int.from_bytes(data[_TIMESTAMP_AT : _TIMESTAMP_AT + 4], "little")
    if timestamp_us >= HOUR_US or data[_PPS_AT] > Pps.ERROR.value:
        raise LinkError("a position packet with an invalid time or PPS state: is the sender a VLP-16?")
    nmea = data[_NMEA_AT:].split(b"\r", 1)[0].split(b"\0", 1)[0].decode("ascii", errors="replace")
    gps_utc, valid = _read_gprmc(nmea)
    return Position(timestamp_us, Pps(data[_PPS_AT]), nmea, gps_utc, valid)


def _read_gprmc(sentence: str) -> tuple[datetime | None, bool]:
    """UTC and validity of `$GPRMC,hhmmss[.ss],A,...,ddmmyy,...*checksum`; (None, False) for an invalid sentence."""
    body, star, checksum = sentence.removeprefix("$").partition("*")
    fields = body.split(",")
    if not star or fields[0] != "GPRMC" or len(fields) < 10:
        return None, False
    parity = 0
    for character in body:
        parity ^= ord(character)
    try:
        if int(checksum, 16) != parity:
            return None, False
        midnight = datetime.strptime(fields[9], "%d%m%y").replace(tzinfo=UTC)
        clock = datetime.strptime(fields[1][:6], "%H%M%S")
        fraction_s = float("0" + fields[1][6:])
    except ValueError:
        return None, False
    since_midnight = timedelta(hours=clock.hour, minutes=clock.minute, seconds=clock.second + fraction_s)
    return midnight + since_midnight, fields[2] == "A"

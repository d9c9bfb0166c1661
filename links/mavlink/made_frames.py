"""MAVLink frames made of values that another program logged, so that one decoder reads every autopilot.

The autopilot's time since boot starts a second before the first value. HEARTBEAT is sent once a second.

Source: https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import math
import struct
from collections import Counter
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

from flow.link import Record
from links.mavlink.transport.framing import dialect

TOPIC = "/autopilot/rx"
HEARTBEAT_NS = BEFORE_FIRST_NS = 1_000_000_000
OUT_OF_ORDER_NS = 1_000_000_000  # values logged later than others by less than this arrive with them
MAX_TIME_NS = 2**63 - 1
OUT_OF_RANGE = "values out of range"
ARDUPILOT, PX4, GENERIC = 3, 12, 0  # MAV_AUTOPILOT
_QUADROTOR, _ARMED, _ACTIVE, _STANDBY = 2, 128, 4, 3
_ALL_IMU_FIELDS = 0b111111  # accelerations and rates were updated


class Gnss(NamedTuple):
    """One GNSS fix; NaN where a value is not known."""

    fix_type: int  # GPS_FIX_TYPE: 3 is a 3D fix
    latitude_deg: float
    longitude_deg: float
    altitude_m: float  # above mean sea level
    satellites: int = 255  # not known
    hdop: float = math.nan
    speed_mps: float = math.nan
    course_deg: float = math.nan


class FrameMaker:
    """Frames of one autopilot, system 1, component 1. Vectors are in NED and FRD, angles in rad.

    Values that do not fit their field in MAVLink (damaged: NaN in an integer, a latitude of 1000 deg) give no frame and
    are counted in `skipped`.
    """

    def __init__(self, autopilot: int = GENERIC, skipped: Counter[str] | None = None) -> None:
        self._autopilot = autopilot
        self.skipped: Counter[str] = Counter() if skipped is None else skipped
        self._mavlink = dialect().MAVLink(None, srcSystem=1, srcComponent=1)
        self._boot_ns: int | None = None
        self._heartbeat_ns: int | None = None
        self._newest_ns = 0
        self.armed = False

    def imu(
        self, arrival_ns: int, stamp_ns: int, acceleration_mps2: Sequence[float], rates_radps: Sequence[float]
    ) -> Iterator[Record]:
        """HIGHRES_IMU, stamped as `links.mavlink` expects it: the values are older by `imu_stamps.DELAY_NS`."""
        values = (*acceleration_mps2, *rates_radps)
        yield from self._frames(
            arrival_ns,
            stamp_ns,
            lambda us: dialect().MAVLink_highres_imu_message(us, *values, *(0.0,) * 7, _ALL_IMU_FIELDS),
        )

    def attitude(
        self, arrival_ns: int, stamp_ns: int, rpy_rad: Sequence[float], rates_radps: Sequence[float]
    ) -> Iterator[Record]:
        """ATTITUDE."""
        values = (*rpy_rad, *rates_radps)
        yield from self._frames(
            arrival_ns, stamp_ns, lambda us: dialect().MAVLink_attitude_message(us // 1000, *values)
        )

    def local_position(
        self, arrival_ns: int, stamp_ns: int, position_m: Sequence[float], velocity_mps: Sequence[float]
    ) -> Iterator[Record]:
        """LOCAL_POSITION_NED."""
        values = (*position_m, *velocity_mps)
        yield from self._frames(
            arrival_ns, stamp_ns, lambda us: dialect().MAVLink_local_position_ned_message(us // 1000, *values)
        )

    def odometry(
        self,
        arrival_ns: int,
        stamp_ns: int,
        position_m: Sequence[float],
        wxyz: Sequence[float],
        velocity_body_mps: Sequence[float],
        rates_radps: Sequence[float],
    ) -> Iterator[Record]:
        """ODOMETRY in LOCAL_NED with velocities in the body frame; covariances not known."""
        unknown = [math.nan] + 20 * [0.0]
        yield from self._frames(
            arrival_ns,
            stamp_ns,
            lambda us: dialect().MAVLink_odometry_message(
                us, 1, 12, *position_m, list(wxyz), *velocity_body_mps, *rates_radps, unknown, unknown
            ),
        )

    def gnss(self, arrival_ns: int, stamp_ns: int, fix: Gnss) -> Iterator[Record]:
        """GPS_RAW_INT."""
        unknown = 65_535

        def scaled(value: float, unit: float) -> int:
            return min(round(value / unit), unknown - 1) if math.isfinite(value) and value >= 0 else unknown

        yield from self._frames(
            arrival_ns,
            stamp_ns,
            lambda us: dialect().MAVLink_gps_raw_int_message(
                us,
                fix.fix_type,
                round(1e7 * fix.latitude_deg),
                round(1e7 * fix.longitude_deg),
                round(1e3 * fix.altitude_m),
                scaled(fix.hdop, 0.01),
                unknown,
                scaled(fix.speed_mps, 0.01),
                scaled(fix.course_deg % 360, 0.01),
                fix.satellites,
            ),
        )

    def _frames(self, arrival_ns: int, stamp_ns: int, make: Any) -> Iterator[Record]:
        """The frame of `make(microseconds since boot)`, after a HEARTBEAT that is due; none for damaged values."""
        if self._newest_ns - OUT_OF_ORDER_NS < arrival_ns < self._newest_ns:  # their sequence numbers are in order
            arrival_ns = self._newest_ns
        boot_ns = stamp_ns - BEFORE_FIRST_NS if self._boot_ns is None else self._boot_ns
        due = self._heartbeat_ns is None or arrival_ns >= self._heartbeat_ns + HEARTBEAT_NS
        sequence_number = self._mavlink.seq
        try:
            if not 0 <= arrival_ns <= MAX_TIME_NS:
                raise OverflowError
            records = [self._record(arrival_ns, self._heartbeat())] if due else []
            records.append(self._record(arrival_ns, make(max((stamp_ns - boot_ns) // 1000, 0))))
        except (ValueError, OverflowError, struct.error):
            self._mavlink.seq = sequence_number
            self.skipped[OUT_OF_RANGE] += 1
            return
        self._newest_ns, self._boot_ns = arrival_ns, boot_ns
        self._heartbeat_ns = arrival_ns if due else self._heartbeat_ns
        yield from records

    def _heartbeat(self) -> Any:
        mode, state = (_ARMED, _ACTIVE) if self.armed else (0, _STANDBY)
        return dialect().MAVLink_heartbeat_message(_QUADROTOR, self._autopilot, mode, 0, state, 3)

    def _record(self, arrival_ns: int, message: Any) -> Record:
        data = bytes(message.pack(self._mavlink))
        self._mavlink.seq = (self._mavlink.seq + 1) % 256  # `send` would count
        return Record(TOPIC, arrival_ns, arrival_ns, data)

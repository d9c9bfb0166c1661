"""An ArduPilot dataflash log (.bin) as the MAVLink frames of its IMU, attitude, position and GNSS.

Of several IMUs and receivers the first is used. The log's time since boot becomes UTC by its GNSS time, as pymavlink
does; without GNSS it stays the time since boot. The rates of an attitude are those of the IMU before it.

IMU values are behind the same filters as in RAW_IMU and their frames HIGHRES_IMU, whose values `links.mavlink` takes as
younger: the frame is earlier by the difference, so that the decoded stamp is that of RAW_IMU.

Source: ArduPilot libraries/AP_Logger/LogStructure.h, https://ardupilot.org/copter/docs/logmessages.html;
`links/mavlink/streams/imu_stamps.py`.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from flow.link import LinkError, Record
from links.importing.imported_file import ImportedFile
from links.mavlink.made_frames import ARDUPILOT, FrameMaker, Gnss
from links.mavlink.streams.imu_stamps import DELAY_NS

FILTERED_NS = DELAY_NS["RAW_IMU"] - DELAY_NS["HIGHRES_IMU"]
EKF = ("XKF1", "NKF1", "EKF1")  # EKF3, EKF2 and the first one's
USED = ("IMU", "ATT", "GPS", "EV", "ARM", *EKF)
MAX_LINE = 300  # characters of a warning
_ARMED, _DISARMED = 10, 11  # EV


class _FirstLine(io.TextIOBase):
    """A text stream that keeps its first line and the number of lines."""

    def __init__(self) -> None:
        super().__init__()
        self.first = ""
        self.lines = 0

    def write(self, text: str, /) -> int:
        """See TextIOBase."""
        if self.lines == 0:
            self.first = (self.first + text.partition("\n")[0])[:MAX_LINE]
        self.lines += text.count("\n")
        return len(text)


class DataflashLog(ImportedFile):
    """One dataflash log."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._rates: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._percent = 0.0
        self._ekf: str | None = None  # the message that is used: of the first EKF that is in the log
        self._unused: Counter[str] = Counter()
        self._maker = FrameMaker(ARDUPILOT, self._unused)
        self._noise = _FirstLine()  # pymavlink prints what it skips
        self._end: str | None = None  # why the log was not read to its end

    def records(self) -> Iterator[Record]:
        """See ImportedFile."""
        for message in self.messages():
            kind, fields = message.get_type(), message
            at_ns = 1000 * round(1e6 * message._timestamp)
            try:
                yield from self._frames(kind, at_ns, fields)
            except (AttributeError, ValueError, TypeError, struct.error, OverflowError):
                self._unused[f"{kind} messages without the fields of an ArduPilot log"] += 1

    def messages(self) -> Iterator[Any]:
        """pymavlink's messages. LinkError for a file that it cannot read."""
        from pymavlink import DFReader

        try:
            with contextlib.redirect_stderr(self._noise), contextlib.redirect_stdout(self._noise):
                log = DFReader.DFReader_binary(str(self._source), zero_time_base=False)
        except Exception as error:  # noqa: BLE001  pymavlink raises it itself
            raise LinkError(f"{self._source}: no dataflash log: {error}") from None
        try:
            while True:
                with contextlib.redirect_stderr(self._noise), contextlib.redirect_stdout(self._noise):
                    message = log.recv_msg()
                if message is None:
                    return
                self._percent = log.percent
                yield message
        except Exception as error:  # noqa: BLE001
            self._end = f"{self._source}: ends at {log.percent:.0f} % of its bytes: {error}: the rest is missing"
        finally:
            log.close()

    def done_bytes(self) -> int:
        """See ImportedFile."""
        return round(0.01 * self._percent * self._source.stat().st_size)

    def skipped(self) -> dict[str, int]:
        """See ImportedFile."""
        return dict(self._unused)

    def warnings(self) -> list[str]:
        """See ImportedFile."""
        more = f" (and {self._noise.lines - 1} more)" if self._noise.lines > 1 else ""
        skipped = [f"{self._source}: {self._noise.first}{more}"] if self._noise.first else []
        return skipped if self._end is None else [self._end, *skipped]

    def nothing_found(self) -> str:
        """See ImportedFile."""
        return f"{self._source}: no IMU, attitude, position or GNSS in this dataflash log: check LOG_BITMASK"

    def _frames(self, kind: str, at_ns: int, m: Any) -> Iterator[Record]:
        if kind == "IMU" and getattr(m, "I", 0) == 0:
            self._rates = (m.GyrX, m.GyrY, m.GyrZ)
            earlier_ns = at_ns - FILTERED_NS
            yield from self._maker.imu(earlier_ns, earlier_ns, (m.AccX, m.AccY, m.AccZ), self._rates)
        elif kind == "ATT":
            rpy_rad = [math.radians(angle) for angle in (m.Roll, m.Pitch, m.Yaw)]
            yield from self._maker.attitude(at_ns, at_ns, rpy_rad, self._rates)
        elif kind == "GPS" and getattr(m, "I", 0) == 0:
            fix = Gnss(int(m.Status), m.Lat, m.Lng, m.Alt, int(m.NSats), m.HDop, m.Spd, m.GCrs)
            yield from self._maker.gnss(at_ns, at_ns, fix)
        elif kind in EKF and getattr(m, "C", 0) == 0 and kind == (self._ekf or kind):
            self._ekf = kind
            yield from self._maker.local_position(at_ns, at_ns, (m.PN, m.PE, m.PD), (m.VN, m.VE, m.VD))
        elif kind == "ARM":
            self._maker.armed = bool(m.ArmState)
        elif kind == "EV" and m.Id in (_ARMED, _DISARMED):
            self._maker.armed = m.Id == _ARMED

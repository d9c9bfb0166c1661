"""A PX4 ULog (.ulg) as the MAVLink frames of its IMU, attitude, position and GNSS.

The log's time since boot becomes UTC by the receiver's time; without GNSS it stays the time since boot. Needs the extra
`ulog` (the package pyulog).

Source: https://docs.px4.io/main/en/dev_log/ulog_file_format.html; PX4 msg/SensorCombined.msg, VehicleAttitude.msg,
VehicleLocalPosition.msg, SensorGps.msg, VehicleStatus.msg.
"""

from __future__ import annotations

import contextlib
import io
import math
import struct
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

from flow.link import LinkError, Record
from links.importing.imported_file import ImportedFile
from links.mavlink.made_frames import OUT_OF_RANGE, PX4, FrameMaker, Gnss
from links.mavlink.ned_frd import R_odom_drone_from_wxyz, rpy_from_R_odom_drone

IMU, ATTITUDE, POSITION, STATUS = "sensor_combined", "vehicle_attitude", "vehicle_local_position", "vehicle_status"
GNSS = ("vehicle_gps_position", "sensor_gps")  # the first that is in the log
TOPICS = [IMU, ATTITUDE, POSITION, STATUS, *GNSS]
_ARMED = 2  # VehicleStatus.ARMING_STATE_ARMED
_DAMAGE = (ValueError, LookupError, TypeError, AttributeError, ArithmeticError, MemoryError, struct.error, OSError)


def read_ulog(path: Path, topics: list[str] | None = None) -> Any:
    """pyulog's log with these topics (None: all). LinkError when it cannot be read."""
    try:
        import pyulog
        import pyulog.exceptions
    except ModuleNotFoundError:
        raise LinkError(
            f"{path} is a PX4 log: to read it install the extra ulog (pip install 'grd-pose[ulog]')"
        ) from None
    damage = (*_DAMAGE, pyulog.exceptions.ULogIncompatibleFlagException)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # it prints what it skips, and sets `file_corruption`
            return pyulog.ULog(str(path), topics, disable_str_exceptions=True)
    except damage as error:
        reason = (str(error) or repr(error)).splitlines()[0]
        raise LinkError(
            f"{path}: the log cannot be read: {reason}: copy it from the autopilot again, or import the telemetry log "
            "(.tlog) of this flight"
        ) from None


class UlogFile(ImportedFile):
    """One ULog."""

    def __init__(self, source: Path) -> None:
        self._source = source
        self._log = read_ulog(source, TOPICS)
        self._data = {
            data.name: data.data for data in self._log.data_list if data.multi_id == 0 and "timestamp" in data.data
        }
        self._gnss = next((name for name in GNSS if name in self._data), "")
        self._offset_ns = self._utc_offset_ns()
        self._maker = FrameMaker(PX4)
        self._rates: tuple[float, ...] = (0.0, 0.0, 0.0)
        self._done = 0.0

    def records(self) -> Iterator[Record]:
        """See ImportedFile."""
        readers: dict[str, Callable[[int, dict[str, Any], int], Iterator[Record]]] = {
            IMU: self._imu,
            ATTITUDE: self._attitude,
            POSITION: self._position,
            STATUS: self._status,
            self._gnss: self._fix,
        }
        there = [name for name in readers if name in self._data]
        times = [np.asarray(self._data[name]["timestamp"], np.int64) for name in there]
        if not times:
            return
        source = np.concatenate([np.full(len(t), k) for k, t in enumerate(times)])
        index = np.concatenate([np.arange(len(t)) for t in times])
        every = np.concatenate(times)
        for count, k in enumerate(np.argsort(every, kind="stable")):
            name = there[source[k]]
            at_ns = self._offset_ns + 1000 * int(every[k])
            self._done = count / len(every)
            try:
                yield from readers[name](at_ns, self._data[name], int(index[k]))
            except KeyError as missing:
                raise LinkError(
                    f"{self._source}: topic {name} has no field {missing}: it is no log of PX4, or of a version that "
                    "grd does not know: import the telemetry log (.tlog) of this flight instead"
                ) from None
            except (ValueError, OverflowError):
                self._maker.skipped[OUT_OF_RANGE] += 1

    def done_bytes(self) -> int:
        """See ImportedFile."""
        return round(self._done * self._source.stat().st_size)

    def skipped(self) -> dict[str, int]:
        """See ImportedFile."""
        return dict(self._maker.skipped)

    def warnings(self) -> list[str]:
        """See ImportedFile."""
        lost = sum(dropout.duration for dropout in self._log.dropouts)
        damaged = [f"{self._source}: the log is damaged: what follows a gap may be missing"]
        warnings = damaged if self._log.file_corruption else []
        if self._log.dropouts:
            warnings.append(f"{self._source}: {len(self._log.dropouts)} dropouts, {lost / 1000:.1f} s are missing")
        return warnings

    def nothing_found(self) -> str:
        """See ImportedFile."""
        return f"{self._source}: no IMU, attitude, position or GNSS in this log: check SDLOG_PROFILE"

    def _utc_offset_ns(self) -> int:
        """UTC less the time since boot, by the first message of the receiver that has UTC; 0: none has."""
        data = self._data.get(self._gnss, {})
        utc_us = np.asarray(data.get("time_utc_usec", ()), np.int64)
        known = np.flatnonzero(utc_us > 0)
        return 1000 * int(utc_us[known[0]] - int(data["timestamp"][known[0]])) if len(known) else 0

    def _imu(self, at_ns: int, data: dict[str, Any], k: int) -> Iterator[Record]:
        self._rates = tuple(float(data[f"gyro_rad[{axis}]"][k]) for axis in range(3))
        acceleration = [float(data[f"accelerometer_m_s2[{axis}]"][k]) for axis in range(3)]
        yield from self._maker.imu(at_ns, at_ns, acceleration, self._rates)

    def _attitude(self, at_ns: int, data: dict[str, Any], k: int) -> Iterator[Record]:
        wxyz = [float(data[f"q[{axis}]"][k]) for axis in range(4)]
        if abs(math.hypot(*wxyz) - 1.0) < 0.01:
            rpy_rad = rpy_from_R_odom_drone(R_odom_drone_from_wxyz(wxyz))
            yield from self._maker.attitude(at_ns, at_ns, rpy_rad, self._rates)

    def _position(self, at_ns: int, data: dict[str, Any], k: int) -> Iterator[Record]:
        values = [float(data[name][k]) for name in ("x", "y", "z", "vx", "vy", "vz")]
        if all(map(math.isfinite, values)) and data["xy_valid"][k] and data["z_valid"][k]:
            yield from self._maker.local_position(at_ns, at_ns, values[:3], values[3:])

    def _status(self, at_ns: int, data: dict[str, Any], k: int) -> Iterator[Record]:
        del at_ns
        self._maker.armed = int(data["arming_state"][k]) == _ARMED
        yield from ()

    def _fix(self, at_ns: int, data: dict[str, Any], k: int) -> Iterator[Record]:
        if "latitude_deg" in data:  # PX4 1.14 and later
            position = [float(data[name][k]) for name in ("latitude_deg", "longitude_deg", "altitude_msl_m")]
        else:
            position = [float(data[name][k]) * unit for name, unit in (("lat", 1e-7), ("lon", 1e-7), ("alt", 1e-3))]
        fix = Gnss(
            int(data["fix_type"][k]),
            *position,
            satellites=int(data["satellites_used"][k]),
            hdop=float(data["hdop"][k]) if "hdop" in data else math.nan,
            speed_mps=float(data["vel_m_s"][k]),
            course_deg=math.degrees(float(data["cog_rad"][k])),
        )
        yield from self._maker.gnss(at_ns, at_ns, fix)

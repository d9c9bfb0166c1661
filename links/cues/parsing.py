"""Cues from bytes: one JSON object, or NMEA sentences, per datagram. Everything is checked; nothing is repaired.

    {"vehicle_gnss": {"latitude_deg", "longitude_deg", "altitude_m"}}   optional: "sigma_m", "sigma_up_m",
                                                      "heading_deg" (clockwise from true north), "heading_sigma_deg"
    {"drone_gnss": {"latitude_deg", "longitude_deg", "altitude_m"}}     optional: "sigma_m", "sigma_up_m"
    {"uwb_range": {"range_m"}}                                          optional: "sigma_m"
    $GNGGA,... and $GNHDT,...                          position and heading of the vehicle

Also `age_s`, as for the vehicle's odometry. NMEA's altitude is that above mean sea level, as MAVLink's is.

Source: recordings/README.md (/cues); NMEA 0183 as in https://gpsd.gitlab.io/gpsd/NMEA.html (GGA, HDT, checksum).
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from collections.abc import Set as AbstractSet
from typing import Any, cast

from stages.messages import DroneGnss, UwbRange, VehicleGnss

MAX_BYTES = 2_000
MAX_RANGE_M = 1_000.0
MAX_SIGMA_M = 1_000.0
ALTITUDES_M = (-1_000.0, 20_000.0)
HEADING_NS = 1_000_000_000  # largest age of an HDT sentence against a GGA
MEASURED = frozenset("12345")  # quality of a GGA that a receiver measured; 6 to 8: dead reckoning, manual, simulated

Cue = VehicleGnss | DroneGnss | UwbRange


class CueParser:
    """Parses datagrams in order: the heading of an HDT sentence belongs to the next position."""

    def __init__(self) -> None:
        self._heading: tuple[int, float] | None = None  # stamp, yaw from east

    def parse(self, stamp_ns: int, data: bytes) -> tuple[list[Cue], list[str]]:
        """The cues of a datagram, and why it, or some of its sentences, are rejected."""
        if len(data) > MAX_BYTES:
            return [], ["longer than a cue"]
        if data.lstrip()[:1] == b"$":
            return self._nmea(stamp_ns, data)
        try:
            return _json_cues(stamp_ns, data), []
        except ValueError as error:
            return [], [str(error)]

    def _nmea(self, stamp_ns: int, data: bytes) -> tuple[list[Cue], list[str]]:
        found: list[Cue] = []
        rejected: list[str] = []
        for line in data.split(b"\n"):
            try:
                if line.strip() and (position := self._sentence(stamp_ns, line.strip())) is not None:
                    found.append(position)
            except ValueError as error:
                rejected.append(str(error))
        return found, rejected

    def _sentence(self, stamp_ns: int, line: bytes) -> VehicleGnss | None:
        """Position of a GGA sentence with a fix; the heading of an HDT sentence is kept for the next one."""
        fields = nmea_fields(line)
        if fields[0][2:] == "GGA":
            return self._gga(stamp_ns, fields)
        if fields[0][2:] == "HDT":
            self._heading = None
            if len(fields) < 2 or fields[1]:
                self._heading = stamp_ns, _yaw_enu(_within("the heading", _text_number(fields, 1), 0, 360))
        return None

    def _gga(self, stamp_ns: int, fields: list[str]) -> VehicleGnss | None:
        """Position of a GGA sentence; None without a fix."""
        if len(fields) < 11:
            raise ValueError("GGA is cut off")
        if fields[6] in ("", "0"):
            return None
        if fields[6] not in MEASURED:
            raise ValueError(f"GGA of quality {fields[6][:20]!r}: not measured")
        heading = self._heading
        known = heading is not None and abs(stamp_ns - heading[0]) <= HEADING_NS
        return VehicleGnss(
            stamp_ns=stamp_ns,
            latitude_rad=_angle(fields, 2, "NS", 90),
            longitude_rad=_angle(fields, 4, "EW", 180),
            altitude_m=_within("the altitude", _text_number(fields, 9), *ALTITUDES_M),
            sigma_m=None,
            sigma_up_m=None,
            yaw_enu_rad=heading[1] if heading is not None and known else None,
            yaw_sigma_rad=None,
        )


def nmea_fields(line: bytes) -> list[str]:
    """Fields of a sentence. ValueError: no sentence, or a wrong checksum."""
    body, star, checksum = line.strip().removeprefix(b"$").partition(b"*")
    total = 0
    for byte in body:
        total ^= byte
    try:
        if not line.startswith(b"$") or not star or int(checksum, 16) != total:
            raise ValueError
        return body.decode("ascii").split(",")
    except ValueError:
        raise ValueError("NMEA with a wrong checksum") from None


def _angle(fields: list[str], at: int, signs: str, limit: int) -> float:
    """An angle ddmm.mmmm with its hemisphere [rad]."""
    value = _text_number(fields, at)
    degrees = math.floor(value / 100)
    if fields[at + 1] not in tuple(signs):
        raise ValueError("NMEA without a hemisphere")
    sign = 1 if fields[at + 1] == signs[0] else -1
    return math.radians(sign * _within("the angle", degrees + (value - 100 * degrees) / 60, 0, limit))


def _text_number(fields: list[str], at: int) -> float:
    if at >= len(fields):
        raise ValueError("NMEA is cut off")
    try:
        value = float(fields[at])
    except ValueError:
        raise ValueError("NMEA without a number") from None
    return _within("a number", value, -1e6, 1e6)


def _within(name: str, value: float, low: float, high: float) -> float:
    if not low <= value <= high:  # NaN compares false
        raise ValueError(f"{name} is {str(value)[:20]}: not within {low:g} to {high:g}")
    return value


def _yaw_enu(heading_deg: float) -> float:
    """Counter-clockwise from east, of a heading clockwise from north."""
    return math.remainder(math.radians(90.0 - heading_deg), math.tau)


def _number(values: Any, name: str, low: float, high: float) -> float:
    value = values.get(name) if isinstance(values, dict) else None
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise ValueError(f"no number '{name}'")
    return float(_within(name, value, low, high))  # an integer may be too large for a float


def _optional(values: Any, name: str, low: float, high: float) -> float | None:
    return _number(values, name, low, high) if isinstance(values, dict) and values.get(name) is not None else None


def _json_cues(stamp_ns: int, data: bytes) -> list[Cue]:
    """The cues of a JSON object. ValueError: it is none, or one of them is invalid."""
    try:
        values: Any = json.loads(data)
    except (ValueError, RecursionError):
        raise ValueError("neither JSON nor NMEA") from None
    if not isinstance(values, dict):
        raise ValueError("no JSON object")
    fields = cast("dict[str, Any]", values)
    _check_fields(fields, {*_READERS, "age_s"})
    found: list[Cue] = []
    for name, (read, known) in _READERS.items():
        if name in fields:
            _check_fields(fields[name], known)
            found.append(read(stamp_ns, fields[name]))
    if not found:
        raise ValueError("no cue")
    return found


def _check_fields(values: Any, known: AbstractSet[str]) -> None:
    if isinstance(values, dict) and (unknown := [name for name in cast("dict[str, Any]", values) if name not in known]):
        raise ValueError(f"unknown field {unknown[0][:20]!r}")


def _position(values: Any) -> dict[str, Any]:
    return {
        "latitude_rad": math.radians(_number(values, "latitude_deg", -90, 90)),
        "longitude_rad": math.radians(_number(values, "longitude_deg", -180, 180)),
        "altitude_m": _number(values, "altitude_m", *ALTITUDES_M),
        "sigma_m": _optional(values, "sigma_m", 0, MAX_SIGMA_M),
        "sigma_up_m": _optional(values, "sigma_up_m", 0, MAX_SIGMA_M),
    }


def _vehicle_gnss(stamp_ns: int, values: Any) -> Cue:
    heading_deg = _optional(values, "heading_deg", -360, 360)
    sigma_deg = _optional(values, "heading_sigma_deg", 0, 180)
    if sigma_deg == 0.0:
        raise ValueError("heading_sigma_deg is 0: leave it out if it is unknown")
    return VehicleGnss(
        stamp_ns=stamp_ns,
        **_position(values),
        yaw_enu_rad=None if heading_deg is None else _yaw_enu(heading_deg),
        yaw_sigma_rad=None if heading_deg is None or sigma_deg is None else math.radians(sigma_deg),
    )


def _drone_gnss(stamp_ns: int, values: Any) -> Cue:
    return DroneGnss(stamp_ns=stamp_ns, **_position(values))


def _uwb_range(stamp_ns: int, values: Any) -> Cue:
    sigma_m = _optional(values, "sigma_m", 0, MAX_SIGMA_M)
    return UwbRange(stamp_ns=stamp_ns, range_m=_number(values, "range_m", 0, MAX_RANGE_M), sigma_m=sigma_m)


_GNSS_FIELDS = frozenset({"latitude_deg", "longitude_deg", "altitude_m", "sigma_m", "sigma_up_m"})
_READERS: dict[str, tuple[Callable[[int, Any], Cue], frozenset[str]]] = {
    "vehicle_gnss": (_vehicle_gnss, _GNSS_FIELDS | {"heading_deg", "heading_sigma_deg"}),
    "drone_gnss": (_drone_gnss, _GNSS_FIELDS),
    "uwb_range": (_uwb_range, frozenset({"range_m", "sigma_m"})),
}

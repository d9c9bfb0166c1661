"""The simulated cues: datagrams on /cues, and the autopilot's GNSS messages.

Source: ours; recording format in recordings/README.md (/cues); https://mavlink.io/en/messages/common.html.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega

from flow.link import Record
from links.simulated.cues.cue_errors import (
    BarometerSettings,
    CueSettings,
    RangingSettings,
    ReceiverSettings,
    SlowError,
    geographic,
    receiver_error,
)
from stages.geometry.frames import Array64

mavlink: Any = ardupilotmega
FIX_3D, UNKNOWN, SATELLITES = 3, 65_535, 14
ARRIVAL_NS = 2_000_000  # from the sending of a datagram to its arrival
Positions = Callable[[Array64], Array64]
"""Positions (n, 3) [m], world frame, at times (n,) [s]."""
Poses = Callable[[Array64], tuple[Array64, Array64]]
"""Rotations (n, 3, 3) and positions (n, 3) [m], world frame, at times (n,) [s]."""


class DroneReceiver:
    """The GNSS receiver and barometer of the drone, as messages of its autopilot."""

    def __init__(
        self,
        settings: ReceiverSettings,
        barometer: BarometerSettings | None,
        drones: tuple[Positions, ...],
        home_up_m: float,
        heading_of_world_x_deg: float,
        duration_s: float,
        seed: int,
    ) -> None:
        """`home_up_m`: height of home in the world frame; heading clockwise from north."""
        self.settings, self.barometer = settings, barometer
        self._drone, self._own = drones[settings.of_drone - 1], drones[0]
        self._home_up_m = home_up_m
        self._yaw_enu_rad = float(np.radians(90.0 - heading_of_world_x_deg))
        self._error = receiver_error(settings, duration_s, np.random.default_rng([seed, 71]))
        height = barometer or BarometerSettings()
        self._height_error = SlowError(
            np.array([height.drift_m]),
            height.drift_time_s,
            np.array([height.noise_m]),
            duration_s,
            np.random.default_rng([seed, 72]),
        )

    def gps_raw(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        """GPS_RAW_INT, sent at times (n,)."""
        return [
            mavlink.MAVLink_gps_raw_int_message(
                ns // 1000, FIX_3D, lat, lon, alt, UNKNOWN, UNKNOWN, UNKNOWN, UNKNOWN, SATELLITES
            )
            for ns, (lat, lon, alt) in zip(
                device_ns.tolist(), self._scaled(time_s - self.settings.latency_s), strict=True
            )
        ]

    def global_positions(self, time_s: Array64, device_ns: NDArray[np.int64]) -> list[Any]:
        """GLOBAL_POSITION_INT, sent at times (n,): the estimate at that time, with the errors of GNSS and barometer."""
        height = self.barometer or BarometerSettings()
        up_m = self._own(time_s)[:, 2] + self._height_error.at(time_s)[:, 0] - self._home_up_m + height.offset_m
        return [
            mavlink.MAVLink_global_position_int_message(
                ns // 1_000_000, lat, lon, alt, round(1e3 * up), 0, 0, 0, UNKNOWN
            )
            for ns, (lat, lon, alt), up in zip(device_ns.tolist(), self._scaled(time_s), up_m.tolist(), strict=True)
        ]

    def _scaled(self, time_s: Array64) -> list[tuple[int, int, int]]:
        """Latitude, longitude [1e-7 deg] and altitude [mm], measured at times (n,)."""
        measured_s = np.maximum(time_s, 0.0)
        xyz_m = self._drone(measured_s) + self._error.at(measured_s) + np.array(self.settings.offset_world_m)
        return [
            (
                round(1e7 * np.degrees(p.latitude_rad)),
                round(1e7 * np.degrees(p.longitude_rad)),
                round(1e3 * p.altitude_m),
            )
            for p in geographic(xyz_m, self._yaw_enu_rad)
        ]


class CueSensors:
    """The vehicle's receiver and the ranging radios, as datagrams in order of measurement."""

    def __init__(
        self,
        settings: CueSettings,
        vehicle: Poses,
        drones: tuple[Positions, ...],
        heading_of_world_x_deg: float,
        start_ns: int,
        duration_s: float,
        seed: int,
    ) -> None:
        self._start_ns, self._duration_s, self._vehicle = start_ns, duration_s, vehicle
        self._yaw_enu_rad = float(np.radians(90.0 - heading_of_world_x_deg))
        self._waiting: list[Record] = []
        if settings.vehicle is not None:
            self._plan_vehicle(settings.vehicle, np.random.default_rng([seed, 73]))
        if settings.ranging is not None and drones:
            drone = drones[settings.ranging.of_drone - 1]
            self._plan_ranging(settings.ranging, drone, np.random.default_rng([seed, 74]))
        self._waiting.sort(key=lambda record: record.arrival_ns, reverse=True)

    def records(self, until_ns: int) -> list[Record]:
        """Datagrams sent before `until_ns` that were not returned yet."""
        found: list[Record] = []
        while self._waiting and self._waiting[-1].stamp_ns < until_ns:
            found.append(self._waiting.pop())
        return found

    def _plan_vehicle(self, s: ReceiverSettings, rng: np.random.Generator) -> None:
        error = receiver_error(s, self._duration_s, rng)
        heading_error_deg = rng.standard_normal() * (s.heading_sigma_deg or 0.0)
        sent_s = np.arange(0.07, self._duration_s, 1 / s.rate_hz)
        measured_s = np.maximum(sent_s - s.latency_s, 0.0)
        rotations, positions = self._vehicle(measured_s)
        measured_m = positions + error.at(measured_s) + np.array(s.offset_world_m)
        yaw_rad = np.arctan2(rotations[:, 1, 0], rotations[:, 0, 0]) + self._yaw_enu_rad
        for at_s, position, yaw in zip(
            sent_s.tolist(), geographic(measured_m, self._yaw_enu_rad), yaw_rad, strict=True
        ):
            fields = {
                "latitude_deg": round(float(np.degrees(position.latitude_rad)), 9),
                "longitude_deg": round(float(np.degrees(position.longitude_rad)), 9),
                "altitude_m": round(position.altitude_m, 3),
            }
            if s.heading_sigma_deg is not None:
                fields["heading_deg"] = round((90.0 - float(np.degrees(yaw)) + heading_error_deg) % 360.0, 2)
                if s.heading_sigma_deg > 0.0:
                    fields["heading_sigma_deg"] = s.heading_sigma_deg
            self._put(at_s, {"vehicle_gnss": fields})

    def _plan_ranging(self, s: RangingSettings, drone: Positions, rng: np.random.Generator) -> None:
        sent_s = np.arange(0.03, self._duration_s, 1 / s.rate_hz)
        measured_s = np.maximum(sent_s - s.latency_s, 0.0)
        range_m = np.linalg.norm(drone(measured_s) - self._vehicle(measured_s)[1], axis=1)
        range_m += rng.normal(0.0, s.bias_m) + rng.normal(0.0, s.noise_m, len(sent_s)) + s.offset_m
        range_m += (rng.random(len(sent_s)) < s.reflected_share) * rng.exponential(s.reflected_m, len(sent_s))
        for at_s, metres in zip(sent_s.tolist(), np.maximum(range_m, 0.0).tolist(), strict=True):
            self._put(at_s, {"uwb_range": {"range_m": round(metres, 3), "sigma_m": s.noise_m}})

    def _put(self, sent_s: float, content: dict[str, Any]) -> None:
        sent_ns = self._start_ns + round(1e9 * sent_s)
        self._waiting.append(Record("/cues", sent_ns + ARRIVAL_NS, sent_ns, json.dumps(content).encode()))

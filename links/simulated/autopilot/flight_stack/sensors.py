"""GPS, compass and barometer of the drone, in the autopilot's north-aligned frame odom.

    GPS       position + Gauss-Markov bias + white noise, velocity + white noise, known `delay_s` after it was true
    compass   heading by the magnetometer (magnetometer.py)
    barometer height + Gauss-Markov bias + white noise

Source: ours; orders of magnitude of consumer parts (u-blox M8, MS5611).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from links.simulated.autopilot.flight_stack.magnetometer import Magnetometer
from links.simulated.autopilot.flight_stack.settings import FlightStackSettings
from links.simulated.autopilot.flight_stack.wander import Wander
from stages.geometry.frames import Array64

NS = 1_000_000_000
COMPASS_HZ, BARO_HZ = 10.0, 20.0


@dataclass(frozen=True, slots=True)
class GpsFix:
    """One fix; time_ns is the measurement time that the autopilot assumes, on its clock."""

    time_ns: int
    xyz_m: Array64
    velocity_mps: Array64


class Sensors:
    """Call `measure` once per tick with the true state; it returns what the autopilot receives now."""

    def __init__(self, settings: FlightStackSettings, seed: int) -> None:
        rng = np.random.default_rng([seed, 42])
        gps, baro = settings.gps, settings.baro
        self._settings = settings
        self._rng = rng
        self._gps_bias = Wander(gps.bias_m * np.array([1.0, 1.0, 1.5]), gps.bias_time_s, rng)
        self._baro_bias = Wander(np.array([baro.bias_m]), baro.bias_time_s, rng)
        self._baro_first = float(self._baro_bias.at(0.0)[0])  # calibrated at boot: height 0
        self.magnetometer = Magnetometer(settings.compass, seed)
        self.gps_fix: GpsFix | None = None
        """The newest fix; None: there is none any more, or not yet."""
        self._gps_waiting: deque[tuple[float, GpsFix]] = deque()
        self._next_s = {"gps": 0.0, "compass": 0.0, "baro": 0.0}

    def measure(
        self,
        time_s: float,
        device_ns: int,
        xyz_m: Array64,
        velocity_mps: Array64,
        R_odom_drone: Array64,
        thrust_g: float,
    ) -> tuple[list[GpsFix], list[float], list[float]]:
        """GPS fixes, compass yaws [rad] and heights [m] that arrive at a time. The state is that of now, frame odom.

        thrust_g: thrust over weight.
        """
        s, rng = self._settings, self._rng
        has_gps = s.gps_until_s is None or time_s < s.gps_until_s
        if has_gps and self._due("gps", time_s, s.gps.rate_hz):
            xyz = xyz_m + self._gps_bias.at(time_s) + s.gps.white_m * rng.standard_normal(3)
            velocity = velocity_mps + s.gps.velocity_mps * rng.standard_normal(3)
            arrives_ns = device_ns + round(NS * (s.gps.delay_s - s.gps.assumed_delay_s))
            self._gps_waiting.append((time_s + s.gps.delay_s, GpsFix(arrives_ns, xyz, velocity)))
        fixes: list[GpsFix] = []
        while self._gps_waiting and self._gps_waiting[0][0] <= time_s:
            fixes.append(self._gps_waiting.popleft()[1])
        self.gps_fix = (fixes[-1] if fixes else self.gps_fix) if has_gps else None
        self.magnetometer.sample(time_s, R_odom_drone, thrust_g)
        yaws: list[float] = []
        if self._due("compass", time_s, COMPASS_HZ):
            yaws.append(self.magnetometer.heading_rad(R_odom_drone))
        heights: list[float] = []
        if self._due("baro", time_s, BARO_HZ):
            bias = float(self._baro_bias.at(time_s)[0]) - self._baro_first
            heights.append(float(xyz_m[2]) + bias + s.baro.white_m * rng.standard_normal())
        return fixes, yaws, heights

    def _due(self, name: str, time_s: float, rate_hz: float) -> bool:
        if time_s < self._next_s[name] - 1e-9:
            return False
        self._next_s[name] += 1 / rate_hz
        return True

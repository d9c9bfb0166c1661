"""Magnetometer of the drone: the Earth's field in its axes, with the errors of a compass on a multicopter.

    field = R_drone_odom (B + slow changes) + hard iron + motor thrust / g + white noise

B is horizontal towards the north with a dip of 60 deg. The heading is that of the field with the tilt removed; the
autopilot corrects it for the delay (EKF3: 60 ms). What it reports in RAW_IMU is the mean since its last reading, at
READ_HZ, and is repeated until the next.

With the default errors the heading is wrong by some 5 to 10 deg, depends on the heading, changes with thrust, and
wanders by 1 deg.

Source: ours. Field: middle latitudes, https://www.ngdc.noaa.gov/geomag/WMM (48 uT, 60 deg). Errors: an external compass
in the log of a real flight is wrong by 2 to 22 deg depending on the heading and changes by 4 deg at take-off
(stages/odometry/drone/magnetic_gyro_bias.py); white noise: HMC5883L and IST8310 data sheets, 0.2 to 0.5 uT. Reading:
ArduPilot Copter::update_batt_compass and AP_Compass_Backend::drain_accumulated_samples.
"""

from __future__ import annotations

import math

import numpy as np

from links.simulated.autopilot.flight_stack.settings import CompassSettings
from links.simulated.autopilot.flight_stack.wander import Wander
from stages.geometry.frames import Array64, rotation_z

FIELD_UT = 48.0 * np.array([math.cos(math.radians(60.0)), 0.0, -math.sin(math.radians(60.0))])  # x north, z up
SAMPLE_HZ, READ_HZ = 75.0, 10.0


class Magnetometer:
    """Call `sample` once per tick."""

    def __init__(self, settings: CompassSettings, seed: int) -> None:
        rng = self._rng = np.random.default_rng([seed, 43])
        self._field = rotation_z(math.radians(settings.offset_deg)).T @ FIELD_UT
        self._hard_iron = settings.hard_iron_ut * rng.standard_normal(3)
        self._motor = settings.motor_ut * rng.standard_normal(3)
        self._slow = Wander(np.full(3, settings.slow_ut), settings.slow_s, rng)
        self._white_ut = settings.white_ut
        self._next_s = self._read_s = 0.0
        self._sample = np.zeros(3)  # the newest
        self._sum, self._samples = np.zeros(3), 0
        self.field_ut = np.zeros(3)  # (3,) as reported, drone axes

    def sample(self, time_s: float, R_odom_drone: Array64, thrust_g: float) -> None:
        """Measure; R_odom_drone: true attitude in north-aligned axes; thrust_g: thrust over weight."""
        if time_s < self._next_s - 1e-9:
            return
        self._next_s += 1.0 / SAMPLE_HZ
        outside = R_odom_drone.T @ (self._field + self._slow.at(time_s))
        self._sample = outside + self._hard_iron + thrust_g * self._motor
        self._sample += self._white_ut * self._rng.standard_normal(3)
        self._sum, self._samples = self._sum + self._sample, self._samples + 1
        if time_s >= self._read_s - 1e-9:
            self._read_s += 1.0 / READ_HZ
            self.field_ut = self._sum / self._samples
            self._sum, self._samples = np.zeros(3), 0

    def heading_rad(self, R_odom_drone: Array64) -> float:
        """The heading by the newest sample, its tilt removed with the true one: yaw in north-aligned axes."""
        x, y, _ = R_odom_drone @ self._sample
        return math.atan2(R_odom_drone[1, 0], R_odom_drone[0, 0]) - math.atan2(y, x)

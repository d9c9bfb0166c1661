"""Motion of the drone over each interval between two IMU samples, with the noise of the samples.

The one stage that reads the drone's motion from its autopilot: gaps, restarts and resets are resolved here, everybody
else reads its DroneMotion. The mean over an interval is that of its two samples (trapezoid). A single false sample is
left out (imu_outliers.py). A gap, and a clock that was set back, end a segment. Specific force, rate and the vertical
are the drone's own measurements; the autopilot's position, velocity and yaw are added only while they cannot contain a
pose that grd sent (`independent`). Of the magnetometer only the bias of the gyro is used (magnetic_gyro_bias.py).

A gyro whose scale is wrong by s measures a turn by the angle a wrong by s a. While the drone turns on, at the rate w,
the variance s^2 a^2 grows by 2 s^2 a w per second, which is added to the square of the rate's density; turning back
adds nothing. `a` is the turn of the last TURN_S, with exponential weights: what came before has been observed since.

The noise is a density, estimated from the samples (imu_noise.py): with a density d the variance of the velocity grows
by d^2 per second. Until it is known, samples with white noise s at intervals of dt have the density s sqrt(dt).

Source: ours; P V.B, V.E. Initial noise: ArduPilot EK3_ACC_P_NSE 0.35 m/s^2 and EK3_GYRO_P_NSE 0.015 rad/s; least noise:
MPU-6000 product specification 3.4, 6.1 and 6.2 (400 ug/sqrt(Hz), 0.005 deg/s/sqrt(Hz)). Scale: the same, within 3 %,
taken as two sigma; in the log of a flight (Pixhawk) two gyros differ by 1.6, 3.9 and 2.2 % in x, y and z.
"""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from flow.stage import Settings, Stage
from stages.geometry.frames import Array64
from stages.messages import DroneAttitude, DroneImu, DroneLocalPosition, DroneMotion, DroneOdometry, DroneTilt
from stages.odometry.drone.autopilot_estimate import AutopilotEstimate
from stages.odometry.drone.imu_noise import NoiseDensity
from stages.odometry.drone.imu_outliers import FalseSamples
from stages.odometry.drone.magnetic_gyro_bias import MagneticGyroBias

SLOW_BLOCKS = 2, 4  # durations, in noise_block_s, of the blocks for slow noise of the specific force
TURN_S = 30.0  # memory of a turn; by IMU alone the yaw is measured anew in some 20 s (median of a real flight)
CLOCK_SET_NS = 1_000_000_000  # a stamp that is earlier by more: the clock was set; by less: late or repeated


class InertialMotionSettings(Settings):
    """Settings of `InertialMotion`."""

    longest_gap_s: float = Field(0.25, gt=0, le=1)  # between two samples of a segment; 10 Hz with one sample lost
    noise_window_s: float = Field(0.44, gt=0, le=2)  # of the local fit to blocks; k times that for SLOW_BLOCKS
    noise_block_s: float = Field(0.05, gt=0, le=1)  # a block; tones above some 10 Hz average out
    noise_average_s: float = Field(2.0, gt=0, le=60)
    initial_force_mps2: float = Field(0.35, gt=0)  # noise of a sample, until it is estimated
    initial_rate_radps: float = Field(0.015, gt=0)
    gyro_scale: float = Field(0.015, ge=0, le=0.1)  # error of the scale, one sigma of each axis
    least_force_noise: float = Field(0.004, gt=0)  # density [m/s^2/sqrt(Hz)]
    least_rate_noise: float = Field(9e-5, gt=0)  # density [rad/s/sqrt(Hz)]
    autopilot_age_s: float = Field(0.25, gt=0, le=2)  # longest propagation of the autopilot's attitude and position


class InertialMotion(Stage[InertialMotionSettings]):
    """One DroneMotion per IMU interval. The autopilot's estimates are optional."""

    optional_inputs: ClassVar[frozenset[str]] = frozenset({"tilt", "attitude", "position", "odometry"})

    def __init__(self, settings: InertialMotionSettings | None = None, /, **values: Any) -> None:
        super().__init__(settings, **values)
        self._autopilot = AutopilotEstimate(self.settings.autopilot_age_s)
        s = self.settings
        self._noise, *self._slow_noise = (
            NoiseDensity(k * s.noise_block_s, k * s.noise_window_s, k * s.noise_average_s) for k in (1, *SLOW_BLOCKS)
        )
        self._false = FalseSamples()
        self._magnetic = MagneticGyroBias()
        self._last: DroneImu | None = None
        self._turn_rad = np.zeros(3)  # of the last TURN_S, drone axes
        self._segment = 0
        self._counts: Counter[str] = Counter()

    @property
    def counters(self) -> Mapping[str, int]:
        """Samples that were not used, segments and resets."""
        return dict(self._counts) | {"segments": self._segment + 1, "autopilot resets": self._autopilot.segment}

    def on_attitude(self, attitude: DroneAttitude) -> None:
        """Attitude of the autopilot, used only while it is independent."""
        self._autopilot.on_attitude(attitude)

    def on_tilt(self, tilt: DroneTilt) -> None:
        """Vertical by the autopilot's roll and pitch."""
        self._autopilot.on_tilt(tilt)

    def on_position(self, position: DroneLocalPosition) -> None:
        """Position and velocity of the autopilot."""
        self._autopilot.on_position(position)

    def on_odometry(self, odometry: DroneOdometry) -> None:
        """Pose and velocity of the autopilot."""
        self._autopilot.on_odometry(odometry)

    def on_imu(self, imu: DroneImu) -> DroneMotion | None:
        """The motion since the sample before; None for the first of a segment."""
        last = self._last
        if last is None:
            return self._begin(imu)
        dt_ns = imu.stamp_ns - last.stamp_ns
        if -CLOCK_SET_NS < dt_ns <= 0:
            self._counts["repeated or late samples"] += 1
            return None
        if not 0 < dt_ns <= 1e9 * self.settings.longest_gap_s:
            self._segment += 1
            return self._begin(imu)
        if self._add_to_outlier_check(imu):
            self._counts["false samples"] += 1
            return None
        force = 0.5 * (last.acceleration_drone_mps2 + imu.acceleration_drone_mps2)
        rate = 0.5 * (last.angular_velocity_drone_radps + imu.angular_velocity_drone_radps)
        self._add(imu)
        self._autopilot.on_imu(force, rate)
        self._turn_rad = math.exp(-dt_ns * 1e-9 / TURN_S) * self._turn_rad + dt_ns * 1e-9 * rate
        force_noise, rate_noise = self._noise_densities(dt_ns * 1e-9, rate)
        up = self._autopilot.up_drone(imu.stamp_ns)
        return DroneMotion(
            stamp_ns=imu.stamp_ns,
            start_ns=last.stamp_ns,
            segment=self._segment,
            specific_force_drone_mps2=force,
            angular_velocity_drone_radps=rate,
            specific_force_noise=force_noise,
            angular_velocity_noise=rate_noise,
            up_drone=up,
            autopilot=self._autopilot.at(imu.stamp_ns),
            gyro_bias=self._magnetic.add(dt_ns * 1e-9, rate, imu.magnetic_field_drone_ut, up),
        )

    def _begin(self, imu: DroneImu) -> None:
        for noise in (self._noise, *self._slow_noise):
            noise.new_segment()
        self._false.new_segment()
        self._magnetic.restart()
        self._turn_rad = np.zeros(3)
        self._add_to_outlier_check(imu)  # too few samples to be false
        self._add(imu)

    def _add_to_outlier_check(self, imu: DroneImu) -> bool:
        """Add a sample to the last ones. True: it is false."""
        return self._false.add(imu.stamp_ns, imu.acceleration_drone_mps2, imu.angular_velocity_drone_radps)

    def _add(self, imu: DroneImu) -> None:
        for noise in (self._noise, *self._slow_noise):
            noise.add(imu.stamp_ns, imu.acceleration_drone_mps2, imu.angular_velocity_drone_radps)
        self._last = imu

    def _noise_densities(self, dt_s: float, rate: Array64) -> Array64:
        """Noise densities (2, 3) of specific force and rate over an interval."""
        s = self.settings
        known = self._noise.density
        if known is None:
            known = np.outer([s.initial_force_mps2, s.initial_rate_radps], np.full(3, math.sqrt(dt_s)))
        densities = np.maximum(known, np.outer([s.least_force_noise, s.least_rate_noise], np.ones(3)))
        for noise in self._slow_noise:
            if noise.density is not None:
                densities[0] = np.maximum(densities[0], noise.density[0])
        densities[1] = np.sqrt(densities[1] ** 2 + 2 * s.gyro_scale**2 * np.maximum(self._turn_rad * rate, 0.0))
        return densities

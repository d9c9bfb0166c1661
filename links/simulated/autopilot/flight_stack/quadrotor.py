"""The airframe with wind and IMU: flies one tick at a time under the command of the flight stack.

Source: ours; equations in `links.simulated.kernels.airframe`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from links.simulated.autopilot.flight_stack.settings import FlightStackSettings, ImuSettings
from links.simulated.kernels.airframe import (
    CRASHED,
    GROUNDED,
    POSITION,
    QUATERNION,
    STATE_SIZE,
    THRUST,
    fly_steps,
    low_pass_sample,
)
from links.simulated.kernels.motion import GRAVITY_MPS2, STEP_S
from links.simulated.world.flown_motion import FlownMotion
from links.simulated.world.motion import gauss_markov
from stages.geometry.frames import Array64

STEPS = 4  # of STEP_S per tick
TICK_S = STEPS * STEP_S
ROTORS = 4
ROTOR_HZ = 65.0, 125.0  # 3900 to 7500 rpm: propellers of 15 to 9 inch in hover
SPREAD = (0.97, 1.01, 0.99, 1.03)  # rotation rates of the rotors relative to their mean


@dataclass(slots=True)
class FlownTick:
    """One tick flown: per step what the IMU reports (4, 6) and the estimate (4, 10); the IMU's sums (6,)."""

    samples: Array64
    estimates: Array64
    moved: Array64


class Quadrotor:
    """Truth of the airframe. `motion` is for the simulated sensors of the rig; `state` for those of the drone."""

    def __init__(
        self,
        settings: FlightStackSettings,
        position_m: Array64,
        yaw_rad: float,
        ground_m: float,
        duration_s: float,
        seed: int,
    ) -> None:
        """Start at rest, in the air or, if so set, on the ground below (with its height `ground_m`)."""
        rng = np.random.default_rng([seed, 40])
        self.ground_m = ground_m
        self.state = np.zeros(STATE_SIZE)
        self.state[POSITION] = position_m
        self.state[QUATERNION] = (0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad))
        self.state[THRUST] = 0.0 if settings.on_ground else GRAVITY_MPS2
        self.motion = FlownMotion(self.state)
        frame, wind = settings.airframe, settings.wind
        self._limits = np.array(
            [
                frame.attitude_gain_per_s,
                math.radians(frame.rate_limit_degps),
                math.radians(frame.yaw_rate_limit_degps),
                frame.rate_lag_s,
                frame.thrust_lag_s,
                math.tan(math.radians(frame.tilt_limit_deg)),
            ]
        )
        steps = STEPS * (math.ceil(duration_s / TICK_S) + 200)
        gusts = gauss_markov(
            rng.standard_normal((steps, 3)), wind.gust_mps * np.array([1.0, 1.0, 0.5]), wind.gust_time_s, STEP_S
        )
        self._wind = np.array(wind.mean_world_mps) + gusts
        self._rng = np.random.default_rng([seed, 41])
        further = np.random.default_rng([seed, 44])
        rotor_hz = settings.imu.rotor_hz or further.uniform(*ROTOR_HZ)
        scale = settings.imu.gyro_scale * further.standard_normal(3)
        self._imu = np.concatenate([imu_errors(settings.imu, rotor_hz, rng), scale, broadband(settings.imu)])
        self._coefficients = butterworth(settings.imu.filter_hz, 1 / STEP_S)
        self._filters = np.zeros((6, 2))
        rates_hz = rotor_hz * np.array(SPREAD)
        self._rotors = np.hstack(
            [rng.uniform(0, 2 * np.pi, (ROTORS, 1)), rates_hz[:, None], rng.uniform(0, 2 * np.pi, (ROTORS, 6))]
        )
        self._ticks = 0

    @property
    def gyro_bias(self) -> Array64:
        """True bias of the gyro [rad/s]."""
        return self._imu[0:3]

    @property
    def accelerometer_bias(self) -> Array64:
        """True bias of the accelerometer [m/s^2]."""
        return self._imu[3:6]

    @property
    def crashed(self) -> bool:
        """Whether it hit the ground."""
        return bool(self.state[CRASHED])

    @property
    def grounded(self) -> bool:
        """Whether it stands or lies on the ground."""
        return bool(self.state[GROUNDED])

    def crash(self) -> None:
        """It has hit an obstacle: it falls with stopped motors."""
        self.state[CRASHED] = 1.0

    def fly(self, estimate: Array64, command: Array64) -> FlownTick:
        """Fly one tick; `estimate` (16,) is propagated by the IMU. command (6,) as of `fly_steps` without ground."""
        first = STEPS * self._ticks
        wind = self._wind[first : first + STEPS]
        rows = np.empty((STEPS, STATE_SIZE))
        tick = FlownTick(np.empty((STEPS, 6)), np.empty((STEPS, 10)), np.empty(6))
        tick.moved = fly_steps(
            self.state,
            estimate,
            np.append(command, self.ground_m),
            wind,
            self._rng.standard_normal((STEPS, 6)),
            self._limits,
            self._imu,
            self._rotors,
            self._filters,
            self._coefficients,
            rows,
            tick.samples,
            tick.estimates,
        )
        self._ticks += 1
        self.motion.append(np.vstack([rows[1:], self.state]))
        return tick


def imu_errors(s: ImuSettings, rotor_hz: float, rng: np.random.Generator) -> Array64:
    """Biases (6), white noise of gyro and accelerometer, vibration amplitudes (6) for `fly_steps`.

    The vibration settings are RMS values after the low-pass. A rotor's tone and its harmonic add
    (|H(f)|^2 + |H(2 f)|^2 / 4) / 2 to the variance per squared amplitude.
    """
    h1, h2 = gain(s.filter_hz, rotor_hz, 1 / STEP_S), gain(s.filter_hz, 2 * rotor_hz, 1 / STEP_S)
    one = math.sqrt(ROTORS * 0.5 * (h1 * h1 + 0.25 * h2 * h2))
    gyro_bias = math.radians(s.gyro_bias_degps) * rng.standard_normal(3)
    accelerometer_bias = s.accelerometer_bias_mps2 * rng.standard_normal(3)
    white = [math.radians(s.gyro_white_degps), s.accelerometer_white_mps2]
    share = math.sqrt(s.tones) / one
    shake = [share * math.radians(s.vibration_degps)] * 3 + [share * s.vibration_mps2] * 3
    return np.concatenate([gyro_bias, accelerometer_bias, white, shake])


def broadband(s: ImuSettings) -> Array64:
    """(2,) broadband vibration of a sample before the low-pass: gyro [rad/s], accelerometer [m/s^2]."""
    rms = np.array([math.radians(s.vibration_degps), s.vibration_mps2])
    memory, coefficients = np.zeros(2), butterworth(s.filter_hz, 1 / STEP_S)
    response = [low_pass_sample(float(k == 0), memory, coefficients) for k in range(round(1 / STEP_S))]
    return rms * math.sqrt((1.0 - s.tones) / sum(h * h for h in response))


def butterworth(cutoff_hz: float, rate_hz: float) -> Array64:
    """b0, b1, b2, a1, a2 of a second-order Butterworth low-pass by the bilinear transform."""
    w = math.tan(math.pi * cutoff_hz / rate_hz)
    c = 1 + math.sqrt(2) * w + w * w
    b0 = w * w / c
    return np.array([b0, 2 * b0, b0, 2 * (w * w - 1) / c, (1 - math.sqrt(2) * w + w * w) / c])


def gain(cutoff_hz: float, at_hz: float, rate_hz: float) -> float:
    """|H| of `butterworth` at a frequency: 1 / sqrt(1 + (tan(pi f / fs) / tan(pi fc / fs))^4)."""
    ratio = math.tan(math.pi * (at_hz % rate_hz) / rate_hz) / math.tan(math.pi * cutoff_hz / rate_hz)
    return 1 / math.sqrt(1 + ratio**4)

"""One EKF core: the filter at a delayed horizon, buffers of measurements, and the output at the present time.

Measurements arrive late and are fused when the horizon reaches their time, as in EKF3 and EKF2. The output is the
filter's state propagated by the IMU from the horizon to now.

Source: ArduPilot AP_NavEKF3 (fusion time horizon, EKF_obs_buffer_t::recall, output predictor); PX4 EKF2 likewise.
"""

from __future__ import annotations

import math

import numpy as np

from links.simulated.autopilot.flight_stack.estimation.source_rules import FilterRules
from links.simulated.autopilot.flight_stack.quadrotor import TICK_S
from links.simulated.kernels.ekf import STATES, fuse, predict, propagated, reset_states, reset_yaw, yaw_and_jacobian
from stages.geometry.frames import Array64


class Lane:
    """State, covariance and horizon of one core. Frame odom: z up, x north, or the axes of an external source."""

    def __init__(self, rules: FilterRules, position_m: Array64, yaw_rad: float) -> None:
        """Start level at rest."""
        self.rules = rules
        self.x = np.zeros(16)
        self.x[0:3] = position_m
        self.x[6:10] = (0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad))
        sigma = [1.0] * 3 + [0.5] * 3 + [math.radians(3)] * 2 + [math.radians(10)]
        self.P = np.diag([s * s for s in [*sigma, *[math.radians(0.15)] * 3, *[0.1] * 3]])
        self.horizon_ns = 0
        self.resets: list[tuple[Array64, float]] = []  # jumps of position [m] and yaw [rad], until taken
        self.reset_count = 0
        self._noise = np.array(
            [
                rules.gyro_noise_radps,
                rules.accelerometer_noise_mps2,
                rules.gyro_bias_noise,
                rules.accelerometer_bias_noise,
            ]
        )
        self._length = round(rules.horizon_s / TICK_S)
        self._moved = np.zeros((self._length, 6))
        self._times_ns: list[int] = []
        self._H = np.zeros(STATES)

    def advance(self, time_ns: int, moved: Array64) -> bool:
        """Take the IMU's sums of the tick that ended now; True: the horizon has moved, and was predicted."""
        self._times_ns.append(time_ns)
        if len(self._times_ns) <= self._length:
            self._moved[len(self._times_ns) - 1] = moved
            return False
        predict(self.x, self.P, self._moved[0], TICK_S, self._noise)
        self._moved[:-1] = self._moved[1:]
        self._moved[-1] = moved
        self.horizon_ns = self._times_ns.pop(0)
        return True

    def output(self) -> Array64:
        """The state now (16,)."""
        return propagated(self.x, self._moved[: len(self._times_ns)], TICK_S)

    @property
    def yaw_rad(self) -> float:
        """Yaw at the horizon."""
        return yaw_and_jacobian(self.x, self._H)

    def ratio(self, states: slice, innovation: Array64, variance: float, gate: float) -> float:
        """Innovation test ratio of several states together: sum of squares over gate^2 times the sum of variances."""
        S = float(np.diagonal(self.P)[states].sum()) + variance * len(innovation)
        return float(innovation @ innovation) / (gate * gate * S)

    def fuse_states(self, first: int, innovation: Array64, variance: float) -> None:
        """Fuse measured states from `first` on, one after the other."""
        before = self.x[first : first + len(innovation)].copy()
        measured = before + innovation
        for i in range(len(innovation)):
            self._H[:] = 0.0
            self._H[first + i] = 1.0
            fuse(self.x, self.P, self._H, measured[i] - self.x[first + i], variance)

    def yaw_ratio(self, yaw_rad: float, variance: float, gate: float) -> tuple[float, float]:
        """(test ratio, innovation) of a measured yaw."""
        innovation = math.remainder(yaw_rad - yaw_and_jacobian(self.x, self._H), math.tau)
        S = float(self._H @ self.P @ self._H) + variance
        return innovation * innovation / (gate * gate * S), innovation

    def fuse_yaw(self, innovation: float, variance: float) -> None:
        """Fuse the yaw whose ratio was computed last."""
        fuse(self.x, self.P, self._H, innovation, variance)

    def reset(self, first: int, values: Array64, variance: float) -> None:
        """Set position (first 0) or velocity (first 3) states, or the height (first 2)."""
        jump = np.zeros(3)
        if first < 3:
            jump[first : first + len(values)] = values - self.x[first : first + len(values)]
        reset_states(self.x, self.P, first, np.asarray(values, dtype=np.float64), variance)
        if first < 3:
            self._note_reset(jump, 0.0)

    def reset_yaw(self, yaw_rad: float, variance: float) -> None:
        """Set the yaw."""
        change = reset_yaw(self.x, self.P, yaw_rad, variance)
        self._note_reset(np.zeros(3), change)

    def _note_reset(self, jump: Array64, yaw_change: float) -> None:
        self.resets.append((jump, yaw_change))
        self.reset_count += 1

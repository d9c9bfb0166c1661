"""Path of the drone by its IMU alone, in a level frame of any yaw, with an unknown velocity at its start.

    R <- exp(k (R up) x z) R exp(w dt),    a = R f - g,    v <- v + a dt,    x <- x + v dt + a dt^2 / 2

The vertical is corrected by the autopilot's roll and pitch, k = (time since the last correction) / TILT_S. Its yaw,
position and velocity are not used, so that the path never contains a pose that was sent to it. A detector compares its
acceleration with that of a candidate (stages/detect/motion_log_ratios.py).

Source: ours; Titterton, Weston, Strapdown Inertial Navigation Technology (2004), 3.5.
"""

from __future__ import annotations

import numpy as np

from stages.geometry.frames import Array64, level_axes
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import DroneMotion
from stages.odometry.drone.autopilot_estimate import GRAVITY_MPS2
from stages.odometry.drone.telemetry import DroneTelemetry

TILT_S = 1.0  # time constant of the correction: gyro drift is slow, errors of the vertical last for seconds
UP = np.array([0.0, 0.0, 1.0])


class InertialPath:
    """Integrates DroneMotion; `path` has the positions of the newest segment."""

    def __init__(self) -> None:
        self.path = DroneTelemetry()
        self._segment: int | None = None
        self._R_level_drone: Array64 | None = None
        self._levelled_ns = 0  # its newest correction
        self._xyz_m, self._velocity_mps = np.zeros(3), np.zeros(3)

    def add(self, motion: DroneMotion) -> None:
        """Add an interval; a new segment starts a new path, once its vertical is known."""
        if motion.segment != self._segment:
            self._segment, self._R_level_drone, self.path = motion.segment, None, DroneTelemetry()
            self._xyz_m, self._velocity_mps = np.zeros(3), np.zeros(3)
        if self._R_level_drone is None:
            self._R_level_drone = None if motion.up_drone is None else level_axes(motion.up_drone).T
            self._levelled_ns = motion.stamp_ns
            return
        dt = (motion.stamp_ns - motion.start_ns) * 1e-9
        half = exp_rotation(0.5 * dt * motion.angular_velocity_drone_radps)
        middle = self._R_level_drone @ half
        acceleration_mps2 = middle @ motion.specific_force_drone_mps2 - GRAVITY_MPS2 * UP
        self._R_level_drone = middle @ half
        if motion.up_drone is not None:
            x, y, _ = self._R_level_drone @ motion.up_drone
            share = min((motion.stamp_ns - self._levelled_ns) * 1e-9 / TILT_S, 1.0)
            self._R_level_drone, self._levelled_ns = (
                exp_rotation(share * np.array([y, -x, 0.0])) @ self._R_level_drone,
                motion.stamp_ns,
            )
        self._xyz_m = self._xyz_m + dt * (self._velocity_mps + 0.5 * dt * acceleration_mps2)
        self._velocity_mps = self._velocity_mps + dt * acceleration_mps2
        self.path.add(motion.stamp_ns, self._xyz_m, self._velocity_mps)

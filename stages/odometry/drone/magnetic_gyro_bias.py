"""Bias of the gyroscope about the vertical, by the direction of the magnetic field over windows of 8 s.

The heading of a compass may be wrong by any angle and is used nowhere. Its change is another matter: while the drone
keeps its heading, place and thrust, the error of the compass is nearly constant, so the horizontal field turns by the
drone's yaw alone. Over a window the field, rotated to the axes of the window's start by the gyroscope, turns by

    phi(t) = (u . b) t + change of the compass error,   u: the vertical, b: the bias of the gyroscope, drone axes

The slope of phi is a measurement of u . b. Its variance is the larger of two:

- That of a random walk of the compass error, whose density q is measured in the window: about its straight line a
  random walk has the variance q T / 15. An error that only fluctuates, as by gusts and white noise, is stated too large
  by this. q is the mean of the last windows, and at least that of this one. A random walk has few degrees of freedom in
  a window: with n windows the variance is larger by (n + 1) / n.
- That of the last slopes, because an error that drifts for many seconds is a straight line in one window. FIRST_SLOPE
  counts as FIRST_COUNTS slopes: the autopilot's vertical moves by 1 deg in a window, at a dip of 60 deg.

A drift that is steady for all SLOPES windows (64 s) is taken for a bias.

The error also depends on the heading. A window in which the drone turns by more than MOST_TURN_RAD is not used. For a
smaller turn the variance contains that of IRON times the turn, SLOPES times: consecutive windows may turn alike.

A sample that repeats the last one says nothing new: a magnetometer that has stopped measures no bias.

In the log of a flight (Pixhawk, ArduCopter 3, two compasses, against its own yaw by GPS) the error of the external
compass changes by 3 deg/sqrt(s) in manoeuvres and by 10 deg for each radian turned, and on the ground by 0.6 deg in
160 s (0.05 deg/sqrt(s)); the internal compass is 10 to 40 deg wrong while its motors run. LEAST_WALK is three times
the walk on the ground.

Source: ours; a random walk with the density q over T: its least-squares slope has the variance 6 q / (5 T).
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import GyroBias
from stages.sums import sum_in_order

WINDOW_S, BLOCKS = 8.0, 8  # a window, and the parts of it whose means the line is fitted to
WALKS, SLOPES = 4, 8  # remembered windows
FIRST_SLOPE, FIRST_COUNTS = math.radians(1.0) * math.tan(math.radians(60.0)) / WINDOW_S, 2.0  # [rad/s]
LEAST_FIELD_UT = 5.0  # horizontal; more than 10 except near the magnetic poles (World Magnetic Model)
MOST_TURN_RAD = math.radians(10.0)  # of the drone in a window
IRON = math.radians(10.0)  # change of the compass error in a turn [rad/rad], of the log above
LEAST_WALK = math.radians(0.15)  # of the compass error [rad/sqrt(s)]


class MagneticGyroBias:
    """Call `add` for each IMU sample; it returns a measurement of the bias at the end of a window."""

    def __init__(self) -> None:
        self._walks = deque[float](maxlen=WALKS)  # densities q [rad^2/s]
        self._slopes = deque[float](maxlen=SLOPES)  # [rad/s]
        self._field = np.zeros(3)
        self.restart()

    def restart(self) -> None:
        """Begin a window, as after a gap. What the last windows say of the compass is kept."""
        self._R_start_now, self._seconds, self._turn_rad = np.eye(3), 0.0, 0.0
        self._start: tuple[Array64, Array64] | None = None  # two horizontal axes, drone axes of the start
        self._up, self._sum_up, self._samples = np.zeros(3), np.zeros(3), list[tuple[float, float]]()

    def add(
        self, step_s: float, rate_radps: Array64, field: Array64 | None, up_drone: Array64 | None
    ) -> GyroBias | None:
        """An IMU interval, its mean rate (3,), and at its end the field (3,) [uT] and the vertical (3,)."""
        self._R_start_now = self._R_start_now @ exp_rotation(step_s * rate_radps)
        self._seconds += step_s
        self._up = self._up if up_drone is None else up_drone
        self._turn_rad += step_s * float(rate_radps @ self._up)
        if abs(self._turn_rad) > MOST_TURN_RAD:
            self.restart()
        if field is not None and up_drone is not None and (field != self._field).any():
            self._field = field
            self._add_level(field - (field @ up_drone) * up_drone, up_drone)
        return self._close() if self._seconds >= WINDOW_S else None

    def _add_level(self, level: Array64, up_drone: Array64) -> None:
        """The horizontal field, drone axes."""
        size_ut = np.linalg.norm(level)
        if not LEAST_FIELD_UT < size_ut < np.inf:  # NaN compares false
            return
        if self._start is None:
            self.restart()
            self._start, self._up = (level / size_ut, np.cross(up_drone, level / size_ut)), up_drone
        along, across = self._start
        now = self._R_start_now @ level
        self._samples.append((self._seconds, math.atan2(float(across @ now), float(along @ now))))
        self._sum_up += up_drone

    def _close(self) -> GyroBias | None:
        samples, up = np.array(self._samples).reshape(-1, 2), self._sum_up
        seconds, turn_rad = self._seconds, self._turn_rad
        self.restart()
        block = np.minimum(samples[:, 0] * (BLOCKS / seconds), BLOCKS - 1).astype(int)
        count = np.bincount(block, minlength=BLOCKS)
        if not count.all():
            return None
        t, phi = (np.bincount(block, column) / count for column in samples.T)
        t -= t.mean()
        slope = float(t @ phi / (t @ t))
        residual = phi - phi.mean() - slope * t
        self._walks.append(15.0 * float(residual @ residual) / (BLOCKS - 2) / seconds)
        self._slopes.append(slope)
        variance = max(self._walk_variance(seconds), self._slope_variance())
        variance += SLOPES * (IRON * turn_rad / seconds) ** 2
        return GyroBias(up_drone=up / np.linalg.norm(up), bias_radps=slope, sigma_radps=math.sqrt(variance))

    def _walk_variance(self, seconds: float) -> float:
        """Variance of the slope over some seconds, of the random walk."""
        n = len(self._walks)
        walk = max(self._walks[-1], sum_in_order(self._walks) / n, LEAST_WALK**2)
        return (1.0 + 1.0 / n) * 6.0 / 5.0 * walk / seconds

    def _slope_variance(self) -> float:
        """Variance of the last slopes."""
        n = len(self._slopes)
        mean = sum_in_order(self._slopes) / n
        squares = sum_in_order((slope - mean) ** 2 for slope in self._slopes)
        return (FIRST_COUNTS * FIRST_SLOPE**2 + squares) / (FIRST_COUNTS + n - 1)

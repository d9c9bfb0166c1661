"""Bias of the gyroscope about the vertical, by the direction of the magnetic field over a few seconds.

The heading of a compass may be wrong by any angle and is used nowhere. Its change is another matter: while the drone
keeps its heading, place and thrust, the error of the compass is nearly constant, so the horizontal field turns by the
drone's yaw alone. Over a window the field, rotated to the axes of the window's start by the gyroscope, turns by

    phi(t) = (u . b) t + change of the compass error,   u: the vertical, b: the bias of the gyroscope, drone axes

The slope of phi is a measurement of u . b. The changes of the compass error are taken as a random walk of the heading;
independent slopes of consecutive windows then carry the information of the whole. The variance is estimated from the
slopes themselves: half the mean squared difference of two consecutive ones, of windows and of LONG windows together;
the larger one counts, because a compass that drifts over many seconds has alike slopes in two short windows.

The error also depends on the heading. A window with a turn is not used. In a slower one the sigma contains IRON times
the turn, since a steady turn has alike slopes.

In the log of a flight (Pixhawk, ArduCopter 3, two compasses, against its own yaw by GPS) the error of the external
compass changes by 3 deg/sqrt(s) in manoeuvres and by 10 deg for each radian turned, and on the ground by 0.6 deg in
160 s (0.05 deg/sqrt(s)); the internal compass is 10 to 40 deg wrong while its motors run. LEAST_WALK is three times
the walk on the ground.

Source: ours; slope of a random walk: its least-squares slope over T has the variance 6 q / (5 T).
"""

from __future__ import annotations

import math

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.geometry.so3 import exp_rotation
from stages.messages import GyroBias
from stages.sums import sum_in_order

WINDOW_S, LONG = 2.0, 4  # one window; the number of them in a long one
LEAST_SAMPLES = 5  # of the field, in a window
MOST_TURN_RAD = math.radians(10.0)  # of the drone in a window
IRON = math.radians(10.0)  # change of the compass error in a turn [rad/rad], of the log above
LEAST_WALK = math.radians(0.15)  # of the compass error [rad/sqrt(s)]
FIRST_WALK = math.radians(1.5)  # until the slopes show it: between hovering and manoeuvres
FIRST_COUNTS = 2.0  # differences of slopes that the first value counts as
REMEMBERED = 15.0  # differences that the average extends over


class _SlopeVariance:
    """Variance of slopes, by the differences of consecutive ones."""

    def __init__(self, variance: float, counts: float) -> None:
        """A first value, and the number of differences that it counts as."""
        self.variance, self._count = variance, counts
        self._last: float | None = None

    def add(self, slope: float) -> None:
        last, self._last = self._last, slope
        if last is not None:
            self._count = min(self._count + 1.0, REMEMBERED)
            self.variance += (0.5 * (slope - last) ** 2 - self.variance) / self._count


class MagneticGyroBias:
    """Call `add` for each IMU sample; it returns a measurement of the bias at the end of a window."""

    def __init__(self) -> None:
        self._short = _SlopeVariance(_walk_variance(FIRST_WALK, WINDOW_S), FIRST_COUNTS)
        self._long = _SlopeVariance(0.0, 0.0)
        self._slopes: list[float] = []  # of the open long window
        self.restart()

    def restart(self) -> None:
        """After a gap: begin a window."""
        self._R_start_now, self._seconds, self._turn_rad = np.eye(3), 0.0, 0.0
        self._start: tuple[Array64, Array64] | None = None  # two horizontal axes, drone axes of the start
        self._up, self._samples = np.zeros(3), list[tuple[float, float]]()

    def add(
        self, step_s: float, rate_radps: Array64, field: Array64 | None, up_drone: Array64 | None
    ) -> GyroBias | None:
        """An IMU interval, its mean rate (3,), and at its end the field (3,) [uT] and the vertical (3,)."""
        self._R_start_now = self._R_start_now @ exp_rotation(step_s * rate_radps)
        self._seconds += step_s
        if field is None or up_drone is None:
            if self._seconds > WINDOW_S:
                self._interrupt()
            return None
        self._turn_rad += step_s * float(rate_radps @ up_drone)
        level = field - (field @ up_drone) * up_drone
        if self._start is None:
            if not np.linalg.norm(level) > 0.0:
                return None
            self.restart()
            first = level / np.linalg.norm(level)
            self._start = first, np.cross(up_drone, first)
        along, across = self._start
        now = self._R_start_now @ level
        self._samples.append((self._seconds, math.atan2(float(across @ now), float(along @ now))))
        self._up += up_drone
        return self._close() if self._seconds >= WINDOW_S else None

    def _interrupt(self) -> None:
        self._slopes.clear()
        self.restart()

    def _close(self) -> GyroBias | None:
        samples, seconds, turn_rad = np.array(self._samples), self._seconds, self._turn_rad
        if len(samples) < LEAST_SAMPLES or abs(turn_rad) > MOST_TURN_RAD:
            self._interrupt()
            return None
        up = self._up / np.linalg.norm(self._up)
        self.restart()
        t = samples[:, 0] - samples[:, 0].mean()
        slope = float(t @ samples[:, 1] / (t @ t))
        self._short.add(slope)
        self._slopes.append(slope)
        if len(self._slopes) == LONG:
            self._long.add(sum_in_order(self._slopes) / LONG)
            self._slopes.clear()
        variance = max(self._short.variance, LONG * self._long.variance, _walk_variance(LEAST_WALK, seconds))
        variance += (IRON * turn_rad / seconds) ** 2
        return GyroBias(up_drone=up, bias_radps=slope, sigma_radps=math.sqrt(variance))


def _walk_variance(walk: float, seconds: float) -> float:
    """Variance of the slope over some seconds of a random walk [rad/sqrt(s)]."""
    return 6.0 / 5.0 * walk**2 / seconds

"""How a candidate flies: speed, turn, whether it moves at all, and whether a bird can fly like that.

Source: ours. Birds: Alerstam et al., PLoS Biology 5 (2007) e197 (7 to 14 m/s); a circling bird is slow for a moment.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64

BIRD_TURN_S = 1.4  # of speed over acceleration: a turn in 9 s
CALM_MPS = 6.5  # a bird is faster, including the speed that a turn hides
SLOW_MPS = 2.0
RECENT_NS = 1_200_000_000
PAUSE_S = 0.45  # without an observation
LAMP_RANGE_M, LAMP_SWAY_M = (25.0, 28.0), (0.0, 1.5)
WIRE_RANGE_M, WIRE_SWAY_M = (16.0, 19.0), (1.5, 0.0)
SUPPORT_RANGE_M, SUPPORT_M = (15.0, 25.0), (0.25, 1.5)
"""Displacement over which it must be observed, over range: a beam also moves along a lamp's arm."""


def lamp_sway_m(range_m: float) -> float:
    """Apparent displacement of a lamp between scan passes, where its support is invisible; 0 where it is visible."""
    return float(np.interp(range_m, LAMP_RANGE_M, LAMP_SWAY_M))


def wire_sway_m(range_m: float) -> float:
    """Apparent displacement of an object with single returns; 0 beyond a wire's range."""
    return float(np.interp(range_m, WIRE_RANGE_M, WIRE_SWAY_M))


class Motion(NamedTuple):
    """Recent motion of a candidate."""

    speed_mps: float
    speed_sigma_mps: float  # an axis
    acceleration_mps2: float
    acceleration_sigma_mps2: float  # an axis

    @property
    def top_sigma_mps(self) -> float:
        """One sigma of `top_mps`."""
        return math.hypot(self.speed_sigma_mps, BIRD_TURN_S * self.acceleration_sigma_mps2)

    @property
    def top_mps(self) -> float:
        """Speed that it will reach: a circling bird is slow for a moment only, and turns hard then."""
        return math.hypot(self.speed_mps, BIRD_TURN_S * self.acceleration_mps2)

    @property
    def calm(self) -> bool:
        """Whether no bird flies like that: slowly, and not as just before or after a turn."""
        slow = self.speed_mps + 1.5 * self.speed_sigma_mps < SLOW_MPS
        return slow or self.top_mps + self.top_sigma_mps < CALM_MPS


def scatter_m(range_m: float) -> float:
    """Scatter of observations about a drone's middle, one sigma an axis.

    In simulated flights with a dithering beam: 0.03 m along the line of sight, 0.05 to 0.08 m across, at 10 to 30 m.
    """
    return 0.05 + 0.0015 * range_m


def path_sigma_m(range_m: float) -> float:
    """The same of a path that is compared with another sensor's, with the errors of the vehicle's pose."""
    return 0.03 + scatter_m(range_m)


def fit_motion(path_ns: list[int], paths_m: Sequence[list[Array64]], range_m: float) -> list[Motion] | None:
    """Parabola x + v t + a t^2 / 2 through the observations of the last 1.2 s, for each path; None: too few.

    The paths have the same times. Least squares with a prior of 8 m/s and 6 m/s^2, which dominates short paths.
    """
    first = bisect_left(path_ns, path_ns[-1] - RECENT_NS)
    if len(path_ns) - first < 3 or (path_ns[first] - path_ns[-1]) * 1e-9 > -0.15:
        return None
    t = (np.array(path_ns[first:]) - path_ns[-1]) * 1e-9
    A = np.column_stack([np.ones(len(t)), t, t * t / 2])
    sigma = scatter_m(range_m)
    information = A.T @ A / sigma**2 + np.diag([0.0, 1 / 8.0**2, 1 / 6.0**2])
    covariance = np.linalg.inv(information)
    at = t.mean()
    speed_sigma = math.sqrt(covariance[1, 1] + 2 * at * covariance[1, 2] + at**2 * covariance[2, 2])
    motions: list[Motion] = []
    for path_m in paths_m:
        fit = covariance @ (A.T @ np.array(path_m[first:])) / sigma**2
        motions.append(
            Motion(
                speed_mps=float(np.linalg.norm(fit[1] + at * fit[2])),
                speed_sigma_mps=speed_sigma,
                acceleration_mps2=float(np.linalg.norm(fit[2])),
                acceleration_sigma_mps2=math.sqrt(covariance[2, 2]),
            )
        )
    return motions


def moves(path_ns: list[int], path_m: list[Array64], range_m: float, motion_known: bool) -> bool:
    """Whether it has significantly moved in the map frame.

    Either steadily while observed without a pause, or farther between two passes than one lamp is long. A long object
    is observed at other positions as the fan passes over it, so a single pass proves nothing. Without known vehicle
    motion static objects may seem to move, so only vertical motion counts.
    """
    if len(path_ns) < 5:
        return False
    t = (np.array(path_ns) - path_ns[-1]) * 1e-9
    pauses = np.nonzero(np.diff(t) > PAUSE_S)[0]
    first = int(pauses[-1]) + 1 if len(pauses) else 0
    x = np.array(path_m)[:, slice(0, 3) if motion_known else slice(2, 3)]
    speed, sigma, duration_s = _straight(t[first:], x[first:], range_m)
    arm_m = float(np.interp(range_m, SUPPORT_RANGE_M, SUPPORT_M))
    if len(t) - first >= 6 and duration_s > 0.6 and speed > 4.0 * sigma and speed * duration_s > arm_m:
        return True
    speed, sigma, duration_s = _straight(t, x, range_m)
    return duration_s > 1.0 and speed > 4.0 * sigma and speed * duration_s > 1.5


def straight_flight(path_ns: list[int], path_m: list[Array64], range_m: float) -> tuple[float, float]:
    """(speed [m/s], the same in sigmas) of a straight line through a path; NaN: under three positions."""
    if len(path_ns) < 3 or path_ns[-1] == path_ns[0]:
        return math.nan, math.nan
    speed, sigma, _ = _straight((np.array(path_ns) - path_ns[-1]) * 1e-9, np.array(path_m), range_m)
    return speed, speed / sigma


def _straight(t: Array64, x: Array64, range_m: float) -> tuple[float, float, float]:
    """Speed of a straight line through observations (n, k) at times (n,), its sigma, and their duration."""
    if len(t) < 3:
        return 0.0, math.inf, 0.0
    since = t - t.mean()
    spread = float(since @ since)
    velocity = since @ x / spread
    left = x - x.mean(axis=0) - np.outer(since, velocity)
    scatter = float(np.linalg.norm(left)) / math.sqrt(left.size)
    sigma = max(0.15 + 0.004 * range_m, scatter) / math.sqrt(spread)
    return float(np.linalg.norm(velocity)), sigma, float(np.ptp(t))

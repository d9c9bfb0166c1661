"""How a candidate flies, from its sightings: speed, turn, whether it moves at all, and for how long as no bird does.

Source: ours. Birds: Alerstam et al., PLoS Biology 5 (2007) e197 (7 to 14 m/s); one that wheels is slow for a moment.
"""

from __future__ import annotations

import math
from bisect import bisect_left
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stages.geometry.frames import Array64

BIRD_TURN_S = 1.4  # of speed over acceleration: a turn in 9 s
CALM_MPS = 6.5  # slower, with what a turn would add, no bird stays
SLOW_MPS = 2.0
STEADY_MPS2 = 2.0
RECENT_NS = 1_200_000_000
PAUSE_S = 0.45  # without a sighting
LAMP_RANGE_M, LAMP_M = (25.0, 28.0), (0.0, 1.5)
WIRE_RANGE_M, WIRE_M = (16.0, 19.0), (1.5, 0.0)
HELD_RANGE_M, HELD_M = (15.0, 25.0), (0.25, 1.5)
"""How far it must have been followed, over range: a beam walks along a lamp's arm, too; nearby its pole is seen."""


def lamp_m(range_m: float) -> float:
    """How far a lamp may seem to swing from look to look, where what holds it is not seen; nearer 0: it is."""
    return float(np.interp(range_m, LAMP_RANGE_M, LAMP_M))


def wire_m(range_m: float) -> float:
    """How far what returns single pulses may seem to swing: looks wander along a wire; farther off drones do, too."""
    return float(np.interp(range_m, WIRE_RANGE_M, WIRE_M))


class Motion(NamedTuple):
    """How a candidate flew lately."""

    speed_mps: float
    speed_sigma_mps: float  # an axis
    acceleration_mps2: float
    acceleration_sigma_mps2: float  # an axis
    spread_m: float  # of its sightings about the parabola

    @property
    def top_sigma_mps(self) -> float:
        """One sigma of `top_mps`."""
        return math.hypot(self.speed_sigma_mps, BIRD_TURN_S * self.acceleration_sigma_mps2)

    @property
    def top_mps(self) -> float:
        """How fast it will be: a bird that wheels is slow for a moment only, and turns hard then."""
        return math.hypot(self.speed_mps, BIRD_TURN_S * self.acceleration_mps2)

    @property
    def calm(self) -> bool:
        """Whether no bird flies so: slowly, and not as just before or after a turn."""
        slow = self.speed_mps + 1.5 * self.speed_sigma_mps < SLOW_MPS
        return slow or self.top_mps + self.top_sigma_mps < CALM_MPS

    @property
    def steady(self) -> bool:
        """Whether it clearly flies straight on."""
        return self.acceleration_mps2 + self.acceleration_sigma_mps2 < STEADY_MPS2


def scatter_m(range_m: float) -> float:
    """How far sightings of a drone lie about its middle, one sigma an axis.

    In simulated flights, seen by a dithering beam: .03 m along the line of sight, .05 to .08 m across, at 10 to 30 m.
    """
    return 0.05 + 0.0015 * range_m


def fit_motion(path_ns: list[int], paths_m: Sequence[list[Array64]], range_m: float) -> list[Motion] | None:
    """A parabola x + v t + a t^2 / 2 through the sightings of the last 1.2 s, of each path; None with too few.

    The paths have the same times. Least squares with a prior of 8 m/s and 6 m/s^2, so that a short path says little
    and not nonsense.
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
        x = np.array(path_m[first:])
        fit = covariance @ (A.T @ x) / sigma**2
        motions.append(
            Motion(
                speed_mps=float(np.linalg.norm(fit[1] + at * fit[2])),
                speed_sigma_mps=speed_sigma,
                acceleration_mps2=float(np.linalg.norm(fit[2])),
                acceleration_sigma_mps2=math.sqrt(covariance[2, 2]),
                spread_m=float(np.linalg.norm(x - A @ fit)) / math.sqrt(len(t)),
            )
        )
    return motions


def moves(path_ns: list[int], path_m: list[Array64], range_m: float, motion_known: bool) -> bool:
    """Whether it has clearly moved in the world.

    Steadily while it was looked at without a pause; or farther between two passes than one lamp is long. Something long
    is met elsewhere as the fan passes over it, so a single passing proves nothing. When the vehicle does not tell how
    it moves, what stands may seem to go by: then only going up or down counts.
    """
    if len(path_ns) < 5:
        return False
    t = (np.array(path_ns) - path_ns[-1]) * 1e-9
    pauses = np.nonzero(np.diff(t) > PAUSE_S)[0]
    first = int(pauses[-1]) + 1 if len(pauses) else 0
    x = np.array(path_m)[:, slice(0, 3) if motion_known else slice(2, 3)]
    speed, sigma, lasted = _straight(t[first:], x[first:], range_m)
    arm_m = float(np.interp(range_m, HELD_RANGE_M, HELD_M))
    if len(t) - first >= 6 and lasted > 0.6 and speed > 4.0 * sigma and speed * lasted > arm_m:
        return True
    speed, sigma, lasted = _straight(t, x, range_m)
    return lasted > 1.0 and speed > 4.0 * sigma and speed * lasted > 1.5


def _straight(t: Array64, x: Array64, range_m: float) -> tuple[float, float, float]:
    """Speed of a straight line through sightings (n, k) at times (n,), its sigma, and how long they lasted."""
    if len(t) < 3:
        return 0.0, math.inf, 0.0
    since = t - t.mean()
    spread = float(since @ since)
    velocity = since @ x / spread
    left = x - x.mean(axis=0) - np.outer(since, velocity)
    scatter = float(np.linalg.norm(left)) / math.sqrt(left.size)
    sigma = max(0.15 + 0.004 * range_m, scatter) / math.sqrt(spread)
    return float(np.linalg.norm(velocity)), sigma, float(np.ptp(t))

"""Fusion of a pair of images with the prediction of tilt and yaw by dead reckoning.

    yaw     mean of the measured and the predicted one, weighed by their variances. The variance of the measured one is
            at least the scatter of recent images; where both differ by more than both allow, either may be wrong, and
            the spread between them is added
    tilt    the measured one; where it contradicts dead reckoning its covariance covers the difference

With few straight lines, other edges among them bias the yaw of an image by a degree or two, each image differently; the
scatter of the next ones shows it. Leaves and cars have verticals of their own: one image that contradicts dead
reckoning does not replace it, two do.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from stages.align.dead_reckoning import DeadReckonedYaw, DeadReckoning
from stages.align.refine import Refined
from stages.align.spectra import quarter_difference
from stages.align.yaw_tracker import YawTracker
from stages.geometry.frames import Array64

GATE_FLOOR_RAD = math.radians(0.3)  # beyond the tilts' own errors
GATE_SIGMAS = 3.0  # sigmas
MAX_TURN_RAD2 = math.radians(1.0) ** 2  # of the turns felt between two images: worse ones contradict nobody
SCATTER_S = 2.0  # over which the images' scatter is taken
APART_NS = 180_000_000  # between two that are compared: sooner after one another they err alike
MOST_RAD2 = math.radians(5.0) ** 2  # of one image's scatter


class InnovationGate:
    """Lays each pair of images beside dead reckoning, which takes their tilts over."""

    def __init__(self, dead_reckoning: DeadReckoning, tracker: YawTracker) -> None:
        self._dead_reckoning, self._tracker = dead_reckoning, tracker
        self._tilted_before = False  # the images before contradicted the turns felt
        self._scatter_rad2 = 0.0  # of the images' yaws, each beside an earlier one
        self._scatter_s = 0.0  # over how long, SCATTER_S at most
        self._before: tuple[int, float] | None = None  # the image to compare with: stamp, `_off_rad`

    def with_scatter(self, refined: Refined, dead_reckoned: DeadReckonedYaw) -> Refined:
        """A yaw no surer than the last images scattered about the turns felt."""
        tracker = self._tracker
        if tracker.offset_rad is None or tracker.reacquired:
            self._before = None  # it was laid beside another offset
        elif tracker.variance_rad2 < MAX_TURN_RAD2:
            self._compare(dead_reckoned.stamp_ns, self._off_rad(refined, dead_reckoned))
        covariance = refined.covariance.copy()
        covariance[4, 4] = max(covariance[4, 4], self._scatter_rad2)
        return replace(refined, covariance=covariance)

    def _compare(self, stamp_ns: int, off_rad: float) -> None:
        if self._before is not None and stamp_ns - self._before[0] < APART_NS:
            return
        if self._before is not None:
            since_s = min((stamp_ns - self._before[0]) * 1e-9, SCATTER_S)
            self._scatter_s = min(self._scatter_s + since_s, SCATTER_S)
            apart_rad2 = min(0.5 * (off_rad - self._before[1]) ** 2, MOST_RAD2)
            self._scatter_rad2 += (apart_rad2 - self._scatter_rad2) * since_s / self._scatter_s
        self._before = stamp_ns, off_rad

    def weigh_yaw(self, refined: Refined, dead_reckoned: DeadReckonedYaw) -> Refined:
        """With the yaw that the turns felt carry on. To be asked before the lock takes the image's."""
        tracker = self._tracker
        if tracker.offset_rad is None or tracker.reacquired or not tracker.variance_rad2 < MAX_TURN_RAD2:
            return refined
        off_rad = self._off_rad(refined, dead_reckoned)
        own, known = refined.yaw_sigma_rad**2, tracker.variance_rad2
        gain = own / (own + known)
        keep = np.diag([1.0, 1.0, 1.0, 1.0, 1.0 - gain])
        covariance = keep @ refined.covariance @ keep
        at_odds = gain * (1.0 - gain) * max(off_rad**2 - own - known, 0.0)  # one of the two is wrong, and which?
        covariance[4, 4] += gain**2 * known + at_odds
        return replace(refined, yaw_rad=refined.yaw_rad + gain * off_rad, covariance=covariance)

    def _off_rad(self, refined: Refined, dead_reckoned: DeadReckonedYaw) -> float:
        """What was known less the image's yaw."""
        return quarter_difference(dead_reckoned.yaw_rad + (self._tracker.offset_rad or 0.0) - refined.yaw_rad)

    def tilt_off_rad(self, vehicle_ns: int, refined: Refined, dead_reckoned: DeadReckonedYaw) -> Array64:
        """(3,) by which the images contradict the turns felt since the last ones, the drone's axes; zero mostly."""
        off = self._dead_reckoning.tilt_off(vehicle_ns, refined, dead_reckoned.yaw_rad)
        tilts = float(np.trace(refined.covariance[:4, :4])) / 2 + dead_reckoned.variance_rad2
        rejected = float(np.linalg.norm(off)) > GATE_SIGMAS * math.sqrt(tilts) + GATE_FLOOR_RAD
        if not rejected or self._tilted_before or not dead_reckoned.variance_rad2 < MAX_TURN_RAD2:
            self._dead_reckoning.correct(vehicle_ns, refined, dead_reckoned.yaw_rad)
        self._tilted_before = rejected
        return off if rejected and dead_reckoned.variance_rad2 < MAX_TURN_RAD2 else np.zeros(3)

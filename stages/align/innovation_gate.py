"""Fusion of a pair of images with the prediction of tilt and yaw by dead reckoning.

    yaw     mean of the measured and the predicted one, weighted by their variances. The variance of the measured one is
            at least the scatter of recent images. Where both differ by more than their variances explain, either may be
            wrong, and the squared difference inflates the variance of the result
    tilt    the measured one; where it contradicts dead reckoning its covariance covers the difference

Where few lines follow a street, other edges bias the yaw by a degree or two, differently in each image; the scatter
from image to image measures this error. Leaves and cars give false verticals, so one image whose tilt contradicts dead
reckoning does not replace it; two consecutive ones do.

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

GATE_FLOOR_RAD = math.radians(0.3)  # added to the gate on tilt
GATE_SIGMAS = 3.0  # gate on tilt
MAX_TURN_RAD2 = math.radians(1.0) ** 2  # largest variance of a prediction that can contradict an image
SCATTER_S = 2.0  # time over which the scatter of the images is averaged
MIN_SEPARATION_NS = 180_000_000  # between two compared images: the errors of closer ones are correlated
MAX_SCATTER_RAD2 = math.radians(5.0) ** 2  # contribution of one image


class InnovationGate:
    """Compares each pair of images with dead reckoning, and corrects its roll and pitch by them."""

    def __init__(self, dead_reckoning: DeadReckoning, tracker: YawTracker) -> None:
        self._dead_reckoning, self._tracker = dead_reckoning, tracker
        self._rejected_before = False  # the tilt of the previous pair contradicted the prediction
        self._scatter_rad2 = 0.0  # variance of the yaws of the images about dead reckoning
        self._scatter_s = 0.0  # averaging time so far, at most SCATTER_S
        self._previous: tuple[int, float] | None = None  # image to compare with: stamp, `_innovation_rad`

    def with_scatter(self, refined: Refined, dead_reckoned: DeadReckonedYaw) -> Refined:
        """The measurement with a yaw variance of at least the scatter of recent images about dead reckoning."""
        tracker = self._tracker
        if tracker.offset_rad is None or tracker.reacquired:
            self._previous = None  # it was compared with another offset
        elif tracker.variance_rad2 < MAX_TURN_RAD2:
            self._compare(dead_reckoned.stamp_ns, self._innovation_rad(refined, dead_reckoned))
        covariance = refined.covariance.copy()
        covariance[4, 4] = max(covariance[4, 4], self._scatter_rad2)
        return replace(refined, covariance=covariance)

    def _compare(self, stamp_ns: int, off_rad: float) -> None:
        if self._previous is not None and stamp_ns - self._previous[0] < MIN_SEPARATION_NS:
            return
        if self._previous is not None:
            since_s = min((stamp_ns - self._previous[0]) * 1e-9, SCATTER_S)
            self._scatter_s = min(self._scatter_s + since_s, SCATTER_S)
            scatter_rad2 = min(0.5 * (off_rad - self._previous[1]) ** 2, MAX_SCATTER_RAD2)
            self._scatter_rad2 += (scatter_rad2 - self._scatter_rad2) * since_s / self._scatter_s
        self._previous = stamp_ns, off_rad

    def weigh_yaw(self, refined: Refined, dead_reckoned: DeadReckonedYaw) -> Refined:
        """The measurement fused with the predicted yaw. Call it before the tracker accepts the yaw of the image."""
        tracker = self._tracker
        if tracker.offset_rad is None or tracker.reacquired or not tracker.variance_rad2 < MAX_TURN_RAD2:
            return refined
        off_rad = self._innovation_rad(refined, dead_reckoned)
        own, known = refined.yaw_sigma_rad**2, tracker.variance_rad2
        gain = own / (own + known)
        keep = np.diag([1.0, 1.0, 1.0, 1.0, 1.0 - gain])
        covariance = keep @ refined.covariance @ keep
        disagreement = (
            gain * (1.0 - gain) * max(off_rad**2 - own - known, 0.0)
        )  # one of the two is wrong, it is unknown which
        covariance[4, 4] += gain**2 * known + disagreement
        return replace(refined, yaw_rad=refined.yaw_rad + gain * off_rad, covariance=covariance)

    def _innovation_rad(self, refined: Refined, dead_reckoned: DeadReckonedYaw) -> float:
        """Predicted yaw less the yaw of the image, modulo 90 deg [rad]."""
        return quarter_difference(dead_reckoned.yaw_rad + (self._tracker.offset_rad or 0.0) - refined.yaw_rad)

    def tilt_innovation_rad(self, vehicle_ns: int, refined: Refined, dead_reckoned: DeadReckonedYaw) -> Array64:
        """Difference (3,) [rad] of the measured tilts from dead reckoning, drone axes, if rejected; else zero."""
        off = self._dead_reckoning.tilt_off(vehicle_ns, refined, dead_reckoned.yaw_rad)
        tilts = float(np.trace(refined.covariance[:4, :4])) / 2 + dead_reckoned.variance_rad2
        rejected = float(np.linalg.norm(off)) > GATE_SIGMAS * math.sqrt(tilts) + GATE_FLOOR_RAD
        if not rejected or self._rejected_before or not dead_reckoned.variance_rad2 < MAX_TURN_RAD2:
            self._dead_reckoning.correct(vehicle_ns, refined, dead_reckoned.yaw_rad)
        self._rejected_before = rejected
        return off if rejected and dead_reckoned.variance_rad2 < MAX_TURN_RAD2 else np.zeros(3)

"""Whether the vehicle's reported motion contradicts what stands still in the LiDAR, over some seconds.

Single velocity errors (static_scan.py) have outliers of 1 m/s, where an object that moves or no plane was taken for a
wall. So the motion is contradicted

    at once     by GROSS_ESTIMATES in succession within GROSS_NS, each beyond GROSS_MPS
    slowly      by the median of the newest estimates: |median| > max(LEAST_MPS, SCALE v) + 3 sigma / sqrt(n)

with the estimates' scatter sigma, by their median absolute deviation. A scale error of SCALE is ordinary for wheels.
The motion counts as confirmed again once the median is within half of that bound.

Source: ours; 1.4826 and 1.253: sigma of a normal distribution by its median absolute deviation, of a median by a mean.
"""

from __future__ import annotations

import math
from collections import deque

import numpy as np

from stages.odometry.vehicle.static_scan import VelocityError

GROSS_ESTIMATES, GROSS_NS, GROSS_MPS = 2, 500_000_000, 2.0
LEAST_ESTIMATES, MOST_ESTIMATES = 8, 40
KEPT_NS = 15_000_000_000
LEAST_MPS, SCALE = 0.15, 0.03
LEAST_SIGMA_MPS = 0.08


class LidarConsistency:
    """Collects velocity errors. `contradicted` changes with `add`."""

    def __init__(self) -> None:
        self._errors: deque[VelocityError] = deque(maxlen=MOST_ESTIMATES)
        self.contradicted = False

    def add(self, error: VelocityError) -> bool:
        """Add an estimate. True: the motion is contradicted from now on."""
        errors = self._errors
        errors.append(error)
        while error.stamp_ns - errors[0].stamp_ns > KEPT_NS:
            errors.popleft()
        before = self.contradicted
        if not before and (self._is_gross() or self._median_ratio() > 1.0):
            self.contradicted = True
        elif before and not self._is_gross() and 0.0 <= self._median_ratio() < 0.5:
            self.contradicted = False
        if self.contradicted != before:
            errors.clear()  # the next decision needs new estimates
        return self.contradicted and not before

    def _is_gross(self) -> bool:
        newest = list(self._errors)[-GROSS_ESTIMATES:]
        if len(newest) < GROSS_ESTIMATES or newest[-1].stamp_ns - newest[0].stamp_ns > GROSS_NS:
            return False
        return all(abs(e.error_mps) > GROSS_MPS and e.error_mps * newest[0].error_mps > 0 for e in newest)

    def _median_ratio(self) -> float:
        """|median| relative to its bound; negative: too few estimates."""
        if len(self._errors) < LEAST_ESTIMATES:
            return -1.0
        values = np.array([e.error_mps for e in self._errors])
        median = float(np.median(values))
        scatter = max(1.4826 * float(np.median(np.abs(values - median))), LEAST_SIGMA_MPS)
        speed = float(np.median([e.speed_mps for e in self._errors]))
        bound = max(LEAST_MPS, SCALE * (speed + abs(median))) + 3.0 * 1.253 * scatter / math.sqrt(len(values))
        return abs(median) / bound

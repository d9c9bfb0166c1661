"""Compute times in a histogram of fixed size: percentiles over hours of data.

Source: ours; bins grow by 2^(1/8), so a percentile is within 9 % of the true one.
"""

from __future__ import annotations

import math
from array import array
from bisect import bisect_right

import numpy as np

BINS_PER_OCTAVE = 8
_BINS = 40 * BINS_PER_OCTAVE  # 1 ns .. 1000 s
# The last bin has none. Whole numbers: durations are, too, and comparing them with floats takes twice the time.
_UPPER_EDGES_NS = [math.ceil(2 ** (edge / BINS_PER_OCTAVE)) for edge in range(1, _BINS)]


class Latency:
    """A histogram of durations [ns]."""

    __slots__ = ("_bins", "count", "max_ns", "total_ns")

    def __init__(self) -> None:
        self._bins = array("q", bytes(8 * _BINS))
        self.count = self.total_ns = self.max_ns = 0

    def add(self, duration_ns: int) -> None:
        """Add one duration [ns]."""
        self.count += 1
        self.total_ns += duration_ns
        if duration_ns > self.max_ns:
            self.max_ns = duration_ns
        self._bins[bisect_right(_UPPER_EDGES_NS, duration_ns)] += 1

    def percentile_ns(self, percent: float) -> float:
        """Upper edge of the bin that holds the percentile, at most the maximum; 0 without data."""
        if not self.count:
            return 0.0
        up_to = np.cumsum(np.frombuffer(self._bins, np.int64))
        index = int(np.searchsorted(up_to, max(self.count * percent / 100, 1)))
        return float(min(2 ** ((index + 1) / BINS_PER_OCTAVE), self.max_ns))

    def to_list(self) -> list[int]:
        """All counts as plain numbers, for `of_list`."""
        return [self.count, self.total_ns, self.max_ns, *self._bins]

    @staticmethod
    def of_list(counts: list[int]) -> Latency:
        """The histogram that `to_list` wrote."""
        latency = Latency()
        latency.count, latency.total_ns, latency.max_ns = counts[:3]
        latency._bins = array("q", counts[3:])
        return latency

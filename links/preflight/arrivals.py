"""When the records of one topic came: how many, how big, how often, with which gaps, how old.

Source: ours.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from flow.link import Record


@dataclass(slots=True)
class Arrivals:
    """Counts over records in the order of arrival."""

    count: int = 0
    data_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_gap_ns: int = 0
    least_age_ns: int = 0  # arrival - stamp
    most_age_ns: int = 0

    def take(self, record: Record) -> None:
        """One record more."""
        age_ns = record.arrival_ns - record.stamp_ns
        if self.count == 0:
            self.first_ns, self.least_age_ns, self.most_age_ns = record.arrival_ns, age_ns, age_ns
        else:
            self.longest_gap_ns = max(self.longest_gap_ns, record.arrival_ns - self.last_ns)
        self.least_age_ns, self.most_age_ns = min(self.least_age_ns, age_ns), max(self.most_age_ns, age_ns)
        self.last_ns = record.arrival_ns
        self.data_bytes += len(record.data)
        self.count += 1

    @property
    def rate_hz(self) -> float:
        """Records a second from the first to the last; NaN with fewer than two."""
        if self.count < 2 or self.last_ns <= self.first_ns:
            return math.nan
        return (self.count - 1) * 1e9 / (self.last_ns - self.first_ns)

    def longest_silence_s(self, end_ns: int) -> float:
        """The longest time without a record, up to the end of listening."""
        return 1e-9 * max(self.longest_gap_ns, end_ns - self.last_ns)

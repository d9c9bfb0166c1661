"""Arrival statistics of the records of one topic: count, size, rate, gaps, age."""

from __future__ import annotations

import math
from dataclasses import dataclass

from flow.link import Record


@dataclass(slots=True)
class RecordStatistics:
    """Counts over records in the order of arrival."""

    count: int = 0
    data_bytes: int = 0
    first_ns: int = 0
    last_ns: int = 0
    longest_gap_ns: int = 0
    min_age_ns: int = 0  # arrival - stamp
    max_age_ns: int = 0

    def add(self, record: Record) -> None:
        """Count one record."""
        age_ns = record.arrival_ns - record.stamp_ns
        if self.count == 0:
            self.first_ns, self.min_age_ns, self.max_age_ns = record.arrival_ns, age_ns, age_ns
        else:
            self.longest_gap_ns = max(self.longest_gap_ns, record.arrival_ns - self.last_ns)
        self.min_age_ns, self.max_age_ns = min(self.min_age_ns, age_ns), max(self.max_age_ns, age_ns)
        self.last_ns = record.arrival_ns
        self.data_bytes += len(record.data)
        self.count += 1

    @property
    def rate_hz(self) -> float:
        """Records per second between the first and the last; NaN with fewer than two."""
        if self.count < 2 or self.last_ns <= self.first_ns:
            return math.nan
        return (self.count - 1) * 1e9 / (self.last_ns - self.first_ns)

    @property
    def data_gb_per_hour(self) -> float | None:
        """Payload rate between the first record and the last [GB/h]; None with fewer than two."""
        span_ns = self.last_ns - self.first_ns
        if self.count < 2 or span_ns <= 0:
            return None
        return self.data_bytes * (self.count - 1) / self.count / 1e9 * 3600e9 / span_ns

    def longest_silence_s(self, end_ns: int) -> float:
        """Longest time without a record [s], including the time from the last record to `end_ns`."""
        return 1e-9 * max(self.longest_gap_ns, end_ns - self.last_ns)

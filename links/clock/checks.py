"""Preflight checks of the host's clock: ticks arrive at their rate, which shows whether the host is too busy.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator

from links.clock.clock import Clock
from links.preflight.check_result import CheckResult, fail, ok, warning
from links.preflight.link_checks import LinkChecks
from links.preflight.observations import Observations, ObservedSource

MAX_MISSED_SHARE = 0.01  # of the ticks
MAX_LATE_MS = 100.0  # a pose is sent as late as its tick


class ClockChecks(LinkChecks):
    """Checks of the host's clock. A recording without ticks is no fault: its flight may have had no clock."""

    link_class = Clock

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        records = source.observation.records
        if not records.count:
            yield (fail if source.live else warning)(source.name, source.no_data_reason)
            return
        missed, late_ms = source.counters.get("missed", 0), 1e-6 * records.max_age_ns
        text = f"{records.count} ticks, at most {late_ms:.0f} ms late, {missed} missed"
        if missed > MAX_MISSED_SHARE * (records.count + missed) or late_ms > MAX_LATE_MS:
            yield warning(source.name, f"{text}: is this host too busy?")
        else:
            yield ok(source.name, text)

"""Preflight checks of cues: they arrive, and they are valid. A cue that is missing is a warning: all are optional.

Source: ours.
"""

from __future__ import annotations

from collections.abc import Iterator

from links.cues.cues import Cues
from links.preflight.check_result import CheckResult, ok, warning
from links.preflight.link_checks import LinkChecks
from links.preflight.observations import Observations, ObservedSource

OLD_MS = 1_000.0  # age at which the detector does not use a cue; latency of the sensor not included


class CuesChecks(LinkChecks):
    """Checks of cues by UDP."""

    link_class = Cues

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        assert isinstance(source.link, Cues)
        records = source.observation.records
        if not records.count:
            yield warning(source.name, f"{source.no_data_reason}: the search goes on without cues")
            return
        rejected, age_ms = sum(source.counters.rejected.values()), 1e-6 * records.max_age_ns
        text = f"{records.rate_hz:.0f} datagrams/s, at most {age_ms:.0f} ms old"
        if rejected:
            why = ", ".join(f"{count} x '{reason}'" for reason, count in source.counters.rejected.items())
            yield warning(source.name, f"{text}; rejected: {why}")
        elif age_ms > OLD_MS:
            yield warning(source.name, f"{text}: older than 1 s, they are not used; check age_s")
        else:
            yield ok(source.name, text)

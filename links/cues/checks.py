"""Preflight checks of cues: they arrive, and they are valid. A cue that is missing is a warning: all are optional.

Source: ours.
"""

from __future__ import annotations

import math
from collections.abc import Iterator

from links.cues.cues import Cues
from links.preflight.check_result import CheckResult, ok, warning
from links.preflight.link_checks import LinkChecks
from links.preflight.observations import Observations, ObservedSource
from links.udp import MAX_AGE_S, WRONG_AGE


class CuesChecks(LinkChecks):
    """Checks of cues by UDP."""

    link_class = Cues

    def check_source(self, source: ObservedSource, observations: Observations) -> Iterator[CheckResult]:
        """See LinkChecks."""
        assert isinstance(source.link, Cues)
        topics = [source.observation.topics[topic] for topic in source.link.replay_topics]
        topics = [records for records in topics if records.count]
        problems: list[str] = []
        if wrong := source.counters.get(WRONG_AGE, 0):
            above = f"invalid or above {MAX_AGE_S:.0f} s: check age_s and the sender's clock"
            problems.append(f"{wrong} datagrams with an age_s that is {above}")
        if source.counters.rejected:
            why = ", ".join(f"{count} x '{reason}'" for reason, count in source.counters.rejected.items())
            problems.append(f"rejected: {why}")
        if not topics:
            reason = "; ".join(problems) or source.no_data_reason
            yield warning(source.name, f"{reason}: the search goes on without cues")
            return
        rate_hz = sum(records.rate_hz for records in topics if not math.isnan(records.rate_hz))
        age_ms = 1e-6 * max(records.max_age_ns for records in topics)
        text = f"{rate_hz:.0f} datagrams/s, at most {age_ms:.0f} ms old"
        yield warning(source.name, "; ".join([text, *problems])) if problems else ok(source.name, text)

"""Observations of one source made by hand, and the results of its checks by name."""

from __future__ import annotations

from flow.counters import Counters
from links.preflight.collect import ObservationTap
from links.preflight.observations import ObservedSource

BEGIN_NS = 1_748_773_230_000_000_000


def observe(link, records, *, counters=None, rejected=None, status=None, live=True, end_ns=None) -> ObservedSource:
    """What a preflight observes of one link named "it" after these records, each decoded."""
    tap = ObservationTap()
    tap.attach({"it": link})
    for record in records:
        tap.record(record)
        link.decode(record)
    last_ns = records[-1].arrival_ns if records else 0
    own = Counters.of(link.counters)
    all_counters = Counters(own.totals | (counters or {}), own.rejected | (rejected or {}))
    return ObservedSource(
        "it", link, tap.observation("it"), all_counters, status, last_ns if end_ns is None else end_ns, live
    )


def by_name(results):
    """Results by the check's name without the node's."""
    return {result.name.removeprefix("it "): result for result in results}


def levels(results):
    """Levels by the check's name."""
    return {name: result.level.value for name, result in by_name(results).items()}

"""Preflight checks of cues: datagrams of both topics count, and what was rejected is named."""

from __future__ import annotations

import pytest

from flow.link import Record
from links.cues import Cues
from links.cues.checks import CuesChecks
from links.preflight.observations import Observations
from tests.links.preflight.observed import BEGIN_NS, observe


def record(k: int, topic: str = "/cues", age_ms: int = 20) -> Record:
    at_ns = BEGIN_NS + k * 100_000_000
    return Record(topic, at_ns, at_ns - age_ms * 1_000_000, b"")


def check(*records: Record, **observed):
    source = observe(Cues(), list(records), **observed)
    (result,) = CuesChecks().check_source(source, Observations((source,), {}, True))
    return result.level.value, result.sentence


def test_datagrams_of_both_topics_count():
    level, text = check(*(record(k) for k in range(11)), *(record(k, "/cues/nmea", 40) for k in range(11)))
    assert (level, text) == ("ok", "20 datagrams/s, at most 40 ms old")
    assert check(*(record(k, "/cues/nmea") for k in range(11))) == ("ok", "10 datagrams/s, at most 20 ms old")


def test_without_datagrams_the_search_goes_on():
    level, text = check()
    assert level == "warning"
    assert "nothing came" in text


@pytest.mark.parametrize("records", [(), (record(0), record(1))])
def test_datagrams_that_are_too_old_are_a_warning_that_names_the_clock(records):
    level, text = check(*records, counters={"age_s invalid or too large": 7})
    assert level == "warning"
    assert "7 datagrams with an age_s that is invalid or above 1 s: check age_s and the sender's clock" in text


def test_rejected_cues_are_named():
    level, text = check(record(0), record(1), rejected={"no cue": 3})
    assert level == "warning"
    assert "rejected: 3 x 'no cue'" in text

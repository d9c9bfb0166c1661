"""Preflight checks of the host's clock on ticks made by hand."""

from __future__ import annotations

from flow.link import Record
from links.clock import Clock
from links.clock.checks import ClockChecks
from links.preflight.devices import checks_for
from links.preflight.observations import Observations
from tests.links.preflight.observed import BEGIN_NS, observe


def levels(records, **given):
    source = observe(Clock(rate_hz=50), records, **given)
    checks = checks_for(source.link)
    assert isinstance(checks, ClockChecks)
    return [(r.level.value, r.sentence) for r in checks.check_source(source, Observations((source,), {}, source.live))]


def ticks(late_ms, count=100):
    due_ns = [BEGIN_NS + k * 20_000_000 for k in range(count)]
    return [Record("/clock", due + round(1e6 * late_ms), due, b"") for due in due_ns]


def test_ticks_in_time_are_ok():
    assert levels(ticks(2.0)) == [("ok", "100 ticks, at most 2 ms late, 0 missed")]


def test_late_or_missed_ticks_are_a_warning():
    assert levels(ticks(150.0)) == [("warning", "100 ticks, at most 150 ms late, 0 missed: is this host too busy?")]
    assert levels(ticks(2.0), counters={"missed": 5})[0][0] == "warning"
    assert levels(ticks(2.0), counters={"missed": 1})[0][0] == "ok", "one of 101"


def test_a_silent_clock_fails_live_only():
    assert levels([]) == [("fail", "nothing came")]
    assert levels([], live=False) == [("warning", "the recording holds nothing on /clock")]

"""Ticks of the host's clock."""

from __future__ import annotations

import threading
from itertools import pairwise

import pytest
from pydantic import ValidationError

from flow.link import Record
from links.clock import Clock, host_time


def test_ticks_lie_evenly_in_time_and_are_never_early():
    clock = Clock(rate_hz=200)
    start_ns = host_time.now_ns()
    with clock.listen() as records:
        ticks = [next(records) for _ in range(20)]
    assert {tick.stamp_ns % 5_000_000 for tick in ticks} == {0}, "on whole periods; a missed one is skipped"
    assert all(a.stamp_ns < b.stamp_ns for a, b in pairwise(ticks))
    assert all(start_ns < tick.stamp_ns <= tick.arrival_ns <= host_time.now_ns() for tick in ticks)
    assert {(tick.topic, tick.data) for tick in ticks} == {("/clock", b"")}


def test_after_a_standstill_the_newest_tick_comes_and_the_missed_ones_are_counted(monkeypatch):
    times = iter([0, 20, 20, 1007, 1007])  # ms: start; wait, tick; wait, tick after a standstill
    monkeypatch.setattr(host_time, "now_ns", lambda: next(times) * 1_000_000)
    clock = Clock(rate_hz=50)
    with clock.listen() as records:
        ticks = [next(records) for _ in range(2)]
    assert [tick.stamp_ns for tick in ticks] == [20_000_000, 1_000_000_000]
    assert ticks[1].arrival_ns == 1_007_000_000
    assert clock.counters == {"missed": 48}


def test_a_recorded_tick_is_decoded_to_its_time():
    assert Clock().decode(Record("/clock", 9, 7, b"")).stamp_ns == 7


def test_leaving_the_context_ends_a_waiting_listener():
    ended = threading.Event()

    def read(records):
        for _ in records:
            pass
        ended.set()

    with Clock(rate_hz=0.1).listen() as records:
        reader = threading.Thread(target=read, args=(records,), daemon=True)
        reader.start()
    assert ended.wait(60)


@pytest.mark.parametrize("rate_hz", [0, -1, 5000, "often"])
def test_impossible_rates_are_errors(rate_hz):
    with pytest.raises(ValidationError):
        Clock(rate_hz=rate_hz)
